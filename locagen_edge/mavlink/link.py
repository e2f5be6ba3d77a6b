"""The road for MAVLink bytes: UDP, TCP or a UART, kept open on asyncio.

The daemon has to go on hearing whatever happens here, so nothing in this file blocks, raises or queues
without bound: a frame that cannot go now is dropped and counted, because a bearing is worth nothing late.
A road that fails is opened again with exponential back-off and some jitter, for ever; the log gets one
line when it fails and one when it holds again, not one per attempt.

pymavlink's own `mavutil` would be shorter; it blocks, and it takes 186 ms and 31 MB to import.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import math
import os
import random
import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from locagen_edge.errors import LinkError
from locagen_edge.mavlink.resolver import Resolver

OPEN_S = 2.0
"""longest an attempt to open may take: TCP alone would try for two minutes, ever more seldom"""
CLOSE_S = 0.3
"""longest we wait for a closed road to be gone"""
FIRST_WAIT_S = 0.2
"""first wait before opening again; doubled each time"""
STEADY_S = 1.0
"""a road counts as holding again (log, back-off) when it has lasted this long: some open and fail at once"""
PEER_S = 30.0
"""udpin: how long a peer that fell silent is still sent to"""
PEERS = 8
"""udpin: most peers at a time"""
BUFFERED = 4096
"""tcp, serial: bytes that may wait in our own buffer: 0.7 s at 57600 baud"""
KERNEL_BUFFER = 16384
"""tcp: bytes that may wait in the kernel's; its default grows to megabytes of old bearings"""
PEER_GONE_MS = 10_000
"""tcp: a peer that acknowledges nothing for so long is gone (pulled cable); the default is 15 minutes"""

BYTES_PER_S = 150_000
"""most that is read of a link, 2000 messages of 75 bytes; what a flood brings beyond is dropped, counted"""
BURST = 300_000
"""what may come at once: more than one read from a socket gives"""

_MAGIC = (0xFD, 0xFE)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Spec:
    """A link as the settings name it."""

    scheme: str
    target: str
    """host or device"""
    number: int
    """port or baud rate"""

    def __str__(self) -> str:
        return f"{self.scheme}:{self.target}:{self.number}"


def parse(text: str) -> Spec:
    """`udpout:HOST:PORT`, `udpin:HOST:PORT`, `tcp:HOST:PORT`, `tcpin:HOST:PORT` or `serial:DEVICE:BAUD`.

    Raises `LinkError` with one line that says what is wrong.
    """
    scheme, _, rest = text.partition(":")
    target, _, digits = rest.rpartition(":")  # a device may have colons: /dev/serial/by-path/...
    if scheme not in OPENERS:
        raise LinkError(f"mavlink.link: {text!r}: begins with none of {', '.join(OPENERS)}")
    noun, most = ("baud rate", 10_000_000) if scheme == "serial" else ("port", 65535)
    if not target:
        raise LinkError(f"mavlink.link: {text!r}: is not {scheme}:NAME:NUMBER")
    if not (digits.isascii() and digits.isdigit()) or not 1 <= int(digits[:9]) <= most:
        raise LinkError(f"mavlink.link: {text!r}: {noun} {digits!r} is not a number from 1 to {most}")
    return Spec(scheme, target, int(digits))


class Link:
    """One link. `run` keeps it open, `send` gives it a frame, `on_bytes` gets what comes in."""

    def __init__(self, spec: Spec, *, backoff_s: float, on_bytes: Callable[[bytes], None]) -> None:
        self.spec = spec
        self._backoff_s = backoff_s
        self._on_bytes = on_bytes
        self.addresses = Resolver(spec.target).addresses
        self._port: _Port | None = None
        self._told_up: bool | None = None
        self.dropped = 0
        """frames that did not go: link down, nobody to send to, or too much waiting"""
        self.flooded_bytes = 0
        """bytes dropped unread, because too much came"""
        self._allowance = float(BURST)
        self._taken_s = -math.inf
        self.refused = 0
        """udpout: times that the other end said nobody listens there; normal while it starts"""
        self.last_error = ""

    @property
    def up(self) -> bool:
        """Whether a frame sent now has somewhere to go."""
        return self._port is not None and self._port.ready

    def send(self, frame: bytes) -> bool:
        """Sends one frame, or drops and counts it. Never waits. True: it is on its way."""
        if self._port is None or not self._port.write(frame):
            self.dropped += 1
            return False
        return True

    def take(self, data: bytes) -> None:
        """For the port: bytes have come."""
        now_s = time.monotonic()
        self._allowance = min(self._allowance + (now_s - self._taken_s) * BYTES_PER_S, BURST)
        self._taken_s = now_s
        if len(data) > self._allowance:
            self.flooded_bytes += len(data)
            return
        self._allowance -= len(data)
        self._on_bytes(data)

    async def run(self) -> None:
        """Opens the link and keeps it open until cancelled."""
        wait_s = FIRST_WAIT_S
        while True:
            if await self._once():
                wait_s = FIRST_WAIT_S
            wait_s = min(wait_s, self._backoff_s)
            await asyncio.sleep(wait_s * random.uniform(0.75, 1.0))  # not all drones in one beat
            wait_s *= 2

    async def _once(self) -> bool:
        """Opens the link, and returns when it has failed: whether it had held for a while."""
        steady = False
        try:
            async with asyncio.timeout(OPEN_S):
                self._port = port = await OPENERS[self.spec.scheme](self)
        except (OSError, ValueError) as error:  # ValueError: a baud rate or host name that cannot be
            self._tell_down(error)
            return False
        try:
            await asyncio.wait({port.lost}, timeout=STEADY_S)
            steady = not port.lost.done()
            if steady:
                self._tell_up()
            self._tell_down(await asyncio.shield(port.lost))
        finally:
            self._port = None
            port.abort()
            await asyncio.wait({port.lost}, timeout=CLOSE_S)
        return steady

    def _tell_up(self) -> None:
        if self._told_up is not True:
            _log.info("mavlink link %s: up", self.spec)
        self._told_up = True

    def _tell_down(self, error: Exception | None) -> None:
        self.last_error = _in_words(error)
        if self._told_up is not False:
            _log.warning(
                "mavlink link %s: down: %s; trying again at least every %g s",
                self.spec,
                self.last_error,
                self._backoff_s,
            )
        self._told_up = False


def _in_words(error: Exception | None) -> str:
    """Why a link is down, for people."""
    if error is None:
        return "closed by the other end"
    if isinstance(error, TimeoutError) and not error.errno:
        return f"no answer within {OPEN_S:g} s"
    if (
        isinstance(error, OSError)
        and error.errno
        and type(error).__module__ == "builtins"  # the resolver's and pyserial's say it better themselves
    ):
        return os.strerror(error.errno)  # asyncio's own text names the address again instead of the reason
    return str(getattr(error, "strerror", None) or error)


# --- ports: one open road each ------------------------------------------------------------------------


class _Port(asyncio.BaseProtocol):
    """What all have in common. `lost` ends, with the reason or None, when the road is gone."""

    transport: Any

    def __init__(self, link: Link) -> None:
        self.link = link
        self.lost: asyncio.Future[Exception | None] = asyncio.get_running_loop().create_future()
        self._reason: Exception | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def connection_lost(self, error: Exception | None) -> None:
        if not self.lost.done():
            self.lost.set_result(self._reason or error)

    def abort(self) -> None:
        if not self.transport.is_closing():
            self.transport.abort()

    @property
    def ready(self) -> bool:
        return not self.transport.is_closing()

    def write(self, frame: bytes) -> bool:
        raise NotImplementedError


class _Stream(_Port, asyncio.Protocol):
    """tcp and serial."""

    def data_received(self, data: bytes) -> None:
        self.link.take(data)

    def write(self, frame: bytes) -> bool:
        if not self.ready or self.transport.get_write_buffer_size() + len(frame) > BUFFERED:
            return False
        self.transport.write(frame)
        return True


class _TcpIn(_Port):
    """Listens; one client at a time, the latest: who connects again has lost the connection before."""

    server: asyncio.Server

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._client: _Accepted | None = None

    @property
    def ready(self) -> bool:
        return self._client is not None and self._client.ready

    def accept(self, client: _Accepted) -> None:
        if self._client is not None:
            self._client.abort()
        self._client = client

    def lose(self, client: _Accepted) -> None:
        if self._client is client:
            self._client = None
        if self._client is None and not self.server.is_serving():
            self.connection_lost(None)

    def write(self, frame: bytes) -> bool:
        return self._client is not None and self._client.write(frame)

    def abort(self) -> None:
        self.server.close()
        if self._client is None:
            self.connection_lost(None)
        else:
            self._client.abort()


class _Accepted(_Stream):
    """A client of ours."""

    def __init__(self, listener: _TcpIn) -> None:
        super().__init__(listener.link)
        self._listener = listener

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        _bound_waiting(transport)
        self._listener.accept(self)

    def connection_lost(self, error: Exception | None) -> None:
        super().connection_lost(error)
        self._listener.lose(self)


class _UdpOut(_Port, asyncio.DatagramProtocol):
    """A connected UDP socket: it hears of ICMP errors, and only its peer can answer."""

    def datagram_received(self, data: bytes, addr: Any) -> None:  # noqa: ARG002
        self.link.take(data)

    def error_received(self, error: Exception) -> None:
        if isinstance(error, ConnectionRefusedError):
            self.link.refused += 1
            return
        if getattr(error, "errno", None) == errno.ENOBUFS:
            return  # the interface's queue is full: this frame is lost, the socket is well
        # No route, no interface, an address that is no longer ours: only a new socket will do.
        self._reason = error
        self.abort()

    def write(self, frame: bytes) -> bool:
        if not self.ready or self.transport.get_write_buffer_size() > BUFFERED:
            return False
        self.transport.sendto(frame)
        return super().ready  # an error just now has closed it


class _UdpIn(_UdpOut):
    """Listens, and sends to all that were heard of late."""

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._peers: dict[Any, float] = {}  # address: when last heard

    @property
    def ready(self) -> bool:
        return super().ready and bool(self._fresh())

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if data[:1] and data[0] in _MAGIC:  # a port scan is no peer
            peers = self._fresh()
            if addr in peers or len(peers) < PEERS:
                peers[addr] = asyncio.get_running_loop().time()
        self.link.take(data)

    def error_received(self, error: Exception) -> None:
        self.link.last_error = _in_words(error)  # about one peer of several: the socket stays

    def write(self, frame: bytes) -> bool:
        if not self.ready or self.transport.get_write_buffer_size() > BUFFERED:
            return False
        for peer in self._peers:
            self.transport.sendto(frame, peer)
        return True

    def _fresh(self) -> dict[Any, float]:
        oldest = asyncio.get_running_loop().time() - PEER_S
        for peer in [peer for peer, heard in self._peers.items() if heard < oldest]:
            del self._peers[peer]
        return self._peers


# --- openers ------------------------------------------------------------------------------------------


async def _at_first(link: Link, opened: Callable[[tuple[str, int]], Awaitable[_Port]]) -> _Port:
    """The port at the first of the host's addresses where one can be opened."""
    *others, last = await link.addresses()
    for address in others:
        with contextlib.suppress(OSError):
            return await opened((address, link.spec.number))
    return await opened((last, link.spec.number))


async def _open_udpout(link: Link) -> _Port:
    loop = asyncio.get_running_loop()

    async def opened(address: tuple[str, int]) -> _Port:
        return (await loop.create_datagram_endpoint(lambda: _UdpOut(link), remote_addr=address))[1]

    return await _at_first(link, opened)


async def _open_udpin(link: Link) -> _Port:
    loop = asyncio.get_running_loop()

    async def opened(address: tuple[str, int]) -> _Port:
        return (await loop.create_datagram_endpoint(lambda: _UdpIn(link), local_addr=address))[1]

    return await _at_first(link, opened)


async def _open_tcp(link: Link) -> _Port:
    loop = asyncio.get_running_loop()

    async def opened(address: tuple[str, int]) -> _Port:
        transport, port = await loop.create_connection(lambda: _Stream(link), *address)
        _bound_waiting(transport)
        return port

    return await _at_first(link, opened)


async def _open_tcpin(link: Link) -> _Port:
    addresses = await link.addresses()
    port = _TcpIn(link)
    loop = asyncio.get_running_loop()
    port.server = await loop.create_server(lambda: _Accepted(port), addresses, link.spec.number, backlog=1)
    return port


def _bound_waiting(transport: asyncio.BaseTransport) -> None:
    """Little may wait in the kernel, and not for long."""
    connection = transport.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BUFFER)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, PEER_GONE_MS)


async def _open_serial(link: Link) -> _Port:
    from locagen_edge.mavlink import uart  # pyserial is for those who have a serial port

    # Opening a USB adapter takes tens of milliseconds: not on the loop that carries sound.
    device = await asyncio.to_thread(uart.opened, link.spec.target, link.spec.number)
    port = _Stream(link)
    # The transport calls connection_made too, but only in the loop's next round.
    port.connection_made(uart.Transport(asyncio.get_running_loop(), port, device))
    return port


OPENERS: Mapping[str, Callable[[Link], Awaitable[_Port]]] = MappingProxyType(
    {
        "udpout": _open_udpout,
        "udpin": _open_udpin,
        "tcp": _open_tcp,
        "tcpin": _open_tcpin,
        "serial": _open_serial,
    }
)
