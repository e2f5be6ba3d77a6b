"""Laws of the link, on real sockets and a real terminal: it holds, comes back, and makes nobody wait."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import socket
import time
import tty
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.errors import LinkError
from locagen_edge.mavlink import link as road
from locagen_edge.mavlink.link import Link, Spec, parse
from locagen_edge.settings import MavlinkSettings, Settings

FRAME = b"\xfd\x09\x00\x00\x00\x01\xbf\x00\x00\x00" + bytes(11)
WITHIN_S = 8.0  # far above what anything here takes; it bounds a test that fails


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(3 * WITHIN_S):
            await test()

    asyncio.run(bounded())


async def until(condition: Callable[[], Any]) -> None:
    """Waits until something holds, and fails when it takes too long."""
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline, "did not happen in time"
        await asyncio.sleep(0.005)


@asynccontextmanager
async def running(text: str, backoff_s: float = 0.05) -> AsyncIterator[tuple[Link, bytearray]]:
    """A link at work, with what it has received; at the end it must close at once."""
    received = bytearray()
    link = Link(parse(text), backoff_s=backoff_s, on_bytes=received.extend)
    task = asyncio.create_task(link.run())
    try:
        yield link, received
    finally:
        began = time.monotonic()
        task.cancel()
        await asyncio.wait({task})
        assert task.cancelled(), "run() ends by being cancelled, and by nothing else"
        assert time.monotonic() - began < 1.0  # milliseconds; the rest is for a busy computer
        assert not link.up
        gc.collect()  # a socket left open shows as a ResourceWarning here, which is an error


def udp() -> socket.socket:
    peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    peer.bind(("127.0.0.1", 0))
    peer.setblocking(False)
    return peer


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def datagram(peer: socket.socket) -> bytes:
    async with asyncio.timeout(WITHIN_S):
        return await asyncio.get_running_loop().sock_recv(peer, 2000)


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


# --- what the settings may say ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("udpout:127.0.0.1:14550", Spec("udpout", "127.0.0.1", 14550)),
        ("udpin:0.0.0.0:14550", Spec("udpin", "0.0.0.0", 14550)),
        ("tcp:ground.local:5760", Spec("tcp", "ground.local", 5760)),
        ("tcpin:0.0.0.0:5760", Spec("tcpin", "0.0.0.0", 5760)),
        ("serial:/dev/ttyAMA0:921600", Spec("serial", "/dev/ttyAMA0", 921600)),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:57600",
            Spec("serial", "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0", 57600),
        ),
    ],
)
def test_a_link_is_read_and_shown_as_the_settings_write_it(text: str, spec: Spec) -> None:
    Settings(mavlink=MavlinkSettings(link=(text,)))
    assert parse(text) == spec
    assert str(spec) == text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "begins with none of udpout, udpin, tcp, tcpin, serial"),
        ("udp:127.0.0.1:14550", "begins with none of"),
        ("udpout", "is not udpout:NAME:NUMBER"),
        ("udpout::14550", "is not udpout:NAME:NUMBER"),
        ("tcp:host:0", "port '0' is not a number from 1 to 65535"),
        ("tcp:host:99999", "port '99999' is not"),
        ("tcp:host:5e3", "port '5e3' is not"),
        ("tcp:host:٥٧٦٠", "port"),
        ("udpin:host:-1", "port '-1' is not"),
        ("serial:/dev/ttyAMA0", "is not serial:NAME:NUMBER"),
        ("serial:/dev/ttyAMA0:0", "baud rate '0' is not"),
    ],
)
def test_a_bad_link_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(LinkError) as refused:
        parse(text)
    message = str(refused.value)
    assert message.startswith(f"mavlink.link: {text!r}: ")
    assert words in message
    assert "\n" not in message


# --- UDP ----------------------------------------------------------------------------------------------


def test_udpout_sends_there_and_hears_the_answer() -> None:
    async def test() -> None:
        with closing(udp()) as peer:
            async with running(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as (link, received):
                await until(lambda: link.up)
                assert link.send(FRAME)
                data, address = peer.recvfrom(2000)
                assert data == FRAME
                peer.sendto(b"answer", address)
                await until(lambda: received == b"answer")
                assert (link.dropped, link.refused) == (0, 0)

    run(test)


def test_udpout_with_nobody_there_yet_goes_on_in_silence(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with running(f"udpout:127.0.0.1:{port}") as (link, _):
            await until(lambda: link.up)
            opened = link._port
            for _ in range(50):
                assert link.send(FRAME)
                await asyncio.sleep(0)
            await until(lambda: link.refused)
            assert link.up
            with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as late:
                late.bind(("127.0.0.1", port))
                late.setblocking(False)
                link.send(FRAME)  # may still fetch the refusal of the one before
                link.send(FRAME)
                assert await datagram(late) == FRAME
            assert link._port is opened

    caplog.set_level(logging.INFO)
    run(test)
    assert len(lines(caplog)) <= 1


def test_udpout_without_a_route_says_so_once_and_keeps_trying(caplog: pytest.LogCaptureFixture) -> None:
    """Broadcast without the right to broadcast: the system refuses it like a missing route."""

    async def test() -> None:
        async with running("udpout:255.255.255.255:14550") as (link, _):
            await until(lambda: link.last_error)
            first = link.last_error
            await asyncio.sleep(0.2)
            assert not link.up
            assert not link.send(FRAME)
            assert link.dropped == 1
            assert first in {"Permission denied", "Network is unreachable"}

    run(test)
    assert len(lines(caplog)) == 1


def test_udpout_is_reopened_when_its_socket_fails() -> None:
    async def test() -> None:
        with closing(udp()) as peer:
            async with running(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as (link, _):
                await until(lambda: link.up)
                port = link._port
                assert isinstance(port, road._UdpOut)
                port.error_received(OSError(105, "no buffer space"))  # passing: the socket stays
                assert link.up
                port.error_received(OSError(101, "network is unreachable"))
                assert not link.up
                await until(lambda: link.up)
                assert link._port is not port
                assert link.last_error == "Network is unreachable"
                link.send(FRAME)
                assert await datagram(peer) == FRAME

    run(test)


def test_udpin_sends_to_those_it_heard_from() -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with running(f"udpin:127.0.0.1:{port}") as (link, received):
            await until(lambda: link._port)
            assert not link.up, "nobody to send to"
            assert not link.send(FRAME)
            with closing(udp()) as one, closing(udp()) as two, closing(udp()) as scan:
                scan.sendto(b"GET / HTTP/1.1", ("127.0.0.1", port))
                one.sendto(FRAME, ("127.0.0.1", port))
                two.sendto(FRAME, ("127.0.0.1", port))
                await until(lambda: received.count(FRAME) == 2)
                assert link.up
                assert link.send(FRAME)
                assert await datagram(one) == await datagram(two) == FRAME
                with pytest.raises(BlockingIOError):
                    scan.recv(2000)
            assert link.dropped == 1

    run(test)


def test_udpin_forgets_the_silent_and_bounds_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with running(f"udpin:127.0.0.1:{port}") as (link, received):
            await until(lambda: link._port)
            crowd = [udp() for _ in range(road.PEERS + 3)]
            for peer in crowd:
                peer.sendto(FRAME, ("127.0.0.1", port))
            await until(lambda: len(received) == len(crowd) * len(FRAME))
            assert isinstance(link._port, road._UdpIn)
            assert len(link._port._peers) == road.PEERS
            monkeypatch.setattr(road, "PEER_S", 0.0)
            await asyncio.sleep(0.001)
            assert not link.up
            assert link._port._peers == {}
            for peer in crowd:
                peer.close()

    run(test)


def test_udpin_on_a_taken_port_says_so_and_gets_it_later(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        holder = udp()
        port = holder.getsockname()[1]
        async with running(f"udpin:127.0.0.1:{port}") as (link, _):
            await until(lambda: link.last_error)
            await asyncio.sleep(0.15)
            assert link.last_error == "Address already in use"
            assert lines(caplog) == [
                f"mavlink link udpin:127.0.0.1:{port}: down: Address already in use; "
                "trying again at least every 0.05 s"
            ]
            holder.close()
            await until(lambda: link._port)

    run(test)


# --- TCP ----------------------------------------------------------------------------------------------


class Server:
    """A ground station's TCP port that can go away and come back."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.received = bytearray()
        self.writers: list[asyncio.StreamWriter] = []

    async def open(self, read: bool = True) -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.writers.append(writer)
            while read and (data := await reader.read(1000)):
                self.received += data

        self._server = await asyncio.start_server(serve, "127.0.0.1", self.port, limit=1024)

    async def close(self) -> None:
        self._server.close()
        for writer in self.writers:
            writer.transport.abort()
        self.writers.clear()
        await asyncio.sleep(0.02)


def test_tcp_comes_back_when_the_other_end_does(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(road, "STEADY_S", 0.05)

    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        async with running(f"tcp:127.0.0.1:{server.port}") as (link, received):
            await until(lambda: link.last_error)
            await asyncio.sleep(0.2)
            assert link.last_error == "Connection refused"
            for _ in range(3):
                await server.open()
                await until(lambda: link.up and server.writers)
                assert len(server.writers) == 1
                assert link.send(FRAME)
                await until(lambda: bytes(server.received).endswith(FRAME))
                server.received.clear()
                server.writers[0].write(b"hello")
                await until(lambda: received == b"hello")
                received.clear()
                await asyncio.sleep(0.1)  # it counts as steady
                await server.close()
                await until(lambda: not link.up)

    caplog.set_level(logging.INFO)
    run(test)
    states = [line.split(": ")[1] for line in lines(caplog)]
    assert states == ["down", "up"] * 3 + ["down"]


def test_a_refused_port_is_one_line_however_often_it_is_tried(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_STREAM)
        async with running(f"tcp:127.0.0.1:{port}", backoff_s=0.01) as (link, _):
            await asyncio.sleep(0.3)
            assert not link.up
        assert lines(caplog) == [
            f"mavlink link tcp:127.0.0.1:{port}: down: Connection refused; trying again at least every 0.01 s"
        ]

    run(test)


def test_a_name_that_is_none_is_one_line(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_such_name(*_: Any, **__: Any) -> Any:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    async def test() -> None:
        monkeypatch.setattr(socket, "getaddrinfo", no_such_name)
        async with running("tcp:no-such-host.invalid:5760") as (link, _):
            await until(lambda: link.last_error)
            assert link.last_error == "Name or service not known"

    run(test)
    assert len(lines(caplog)) == 1


@pytest.mark.parametrize("host", ["a" * 70 + ".invalid", "bad..dots"])
def test_a_host_name_that_cannot_be_ends_nothing(host: str) -> None:
    async def test() -> None:
        async with running(f"tcp:{host}:5760") as (link, _):
            await until(lambda: link.last_error)

    run(test)


def test_an_answer_that_never_comes_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    async def for_ever(link: Link) -> Any:
        await asyncio.Event().wait()

    async def test() -> None:
        monkeypatch.setattr(road, "OPEN_S", 0.05)
        monkeypatch.setattr(road, "OPENERS", {"tcp": for_ever})
        link = Link(Spec("tcp", "127.0.0.1", 1), backoff_s=0.05, on_bytes=lambda _: None)
        task = asyncio.create_task(link.run())
        await until(lambda: link.last_error)
        assert link.last_error == "no answer within 0.05 s"
        task.cancel()
        await asyncio.wait({task})

    run(test)


def test_the_wait_grows_to_its_bound_and_no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 12:
            raise asyncio.CancelledError

    async def refuse(link: Link) -> Any:
        raise ConnectionRefusedError(111, "refused")

    async def test() -> None:
        monkeypatch.setattr(asyncio, "sleep", sleep)
        monkeypatch.setattr(road, "OPENERS", {"tcp": refuse})
        with pytest.raises(asyncio.CancelledError):
            await Link(Spec("tcp", "127.0.0.1", 1), backoff_s=10.0, on_bytes=lambda _: None).run()

    run(test)
    wanted = [min(0.2 * 2**k, 10.0) for k in range(12)]
    assert all(0.75 * most <= wait <= most for wait, most in zip(waits, wanted, strict=True))
    assert len(set(waits)) == 12, "jitter"


def test_a_peer_that_does_not_read_costs_frames_and_no_time() -> None:
    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        await server.open(read=False)
        async with running(f"tcp:127.0.0.1:{server.port}") as (link, _):
            await until(lambda: link.up and server.writers)
            server.writers[0].transport.pause_reading()
            sent, longest_s = 0, 0.0
            for k in range(60_000):
                began = time.perf_counter()
                sent += link.send(bytes(280))
                longest_s = max(longest_s, time.perf_counter() - began)
                if k % 100 == 0:
                    await asyncio.sleep(0)
                if link.dropped > 1000:
                    break
            assert link.dropped > 1000
            assert sent + link.dropped == k + 1
            assert longest_s < 0.25  # microseconds; the rest is for a busy computer
            assert link._port.transport.get_write_buffer_size() <= road.BUFFERED  # type: ignore[union-attr]
            assert link.up
        await server.close()

    run(test)


def test_tcpin_lets_one_connect_and_the_latest_wins() -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_STREAM)
        async with running(f"tcpin:127.0.0.1:{port}") as (link, received):
            await until(lambda: link._port)
            listener = link._port
            assert not link.up, "nobody to send to"
            assert not link.send(FRAME)
            for visit in range(3):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(b"hello")
                await until(lambda: received == b"hello")
                received.clear()
                assert link.up
                assert link.send(FRAME)
                async with asyncio.timeout(WITHIN_S):
                    assert await reader.readexactly(len(FRAME)) == FRAME
                    if visit == 0:  # a second one while the first is there
                        late, later = await asyncio.open_connection("127.0.0.1", port)
                        assert await reader.read() == b"", "the first one is let go"
                        later.write(b"here")
                        await until(lambda: received == b"here")
                        received.clear()
                        assert link.send(FRAME)
                        assert await late.readexactly(len(FRAME)) == FRAME
                        later.close()
                writer.close()
                await until(lambda: not link.up)
            assert link._port is listener

    run(test)


def test_tcpin_on_a_taken_port_says_so_and_gets_it_later(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        await server.open()
        async with running(f"tcpin:127.0.0.1:{server.port}") as (link, _):
            await until(lambda: link.last_error)
            assert "in use" in link.last_error
            await server.close()
            await until(lambda: link._port)

    run(test)
    assert len(lines(caplog)) == 1


# --- a flood ------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.floats(0, 3), st.integers(1, 200_000)), max_size=60))
def test_of_a_flood_only_so_much_is_read(arrivals: list[tuple[float, int]]) -> None:
    """In any span no more than BURST and BYTES_PER_S over it; the rest is counted; calm is never cut."""
    now_s, taken, read = 100.0, 0, []

    def clock() -> float:
        return now_s

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(road.time, "monotonic", clock)
        link = Link(Spec("udpin", "", 1), backoff_s=1.0, on_bytes=lambda d: read.append((now_s, len(d))))
        for pause_s, size in arrivals:
            now_s += pause_s
            link.take(bytes(size))
            taken += size
    assert sum(size for _, size in read) + link.flooded_bytes == taken
    for first, (begin_s, _) in enumerate(read):
        total = 0
        for t_s, size in read[first:]:
            total += size
            assert total <= road.BURST + road.BYTES_PER_S * (t_s - begin_s) + 1e-3
    if all(size <= pause_s * road.BYTES_PER_S for pause_s, size in arrivals):
        assert link.flooded_bytes == 0


# --- serial -------------------------------------------------------------------------------------------


class Uart:
    """A pseudo-terminal under a path that stays, as udev gives a UART one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(self.master)
        os.set_blocking(self.master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self) -> None:
        os.close(self._slave)
        os.close(self.master)

    def read(self) -> bytes:
        try:
            return os.read(self.master, 4096)
        except BlockingIOError:
            return b""


def test_serial_is_reopened_when_it_was_unplugged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        async with running(f"serial:{uart.path}:57600") as (link, received):
            for _ in range(3):
                await until(lambda: link.up)
                assert link.send(FRAME)
                got = bytearray()
                await until(lambda: got.extend(uart.read()) or got == FRAME)  # noqa: B023
                os.write(uart.master, b"\xfd\x00\r\n\x03\x11\x13")
                await until(lambda: received == b"\xfd\x00\r\n\x03\x11\x13")  # raw: nothing translated
                received.clear()
                uart.unplug()
                await until(lambda: not link.up)
                uart.plug()
            await until(lambda: link.up)
        uart.unplug()

    run(test)
    assert not [record for record in caplog.records if record.exc_info], "no traceback"


def test_serial_pulled_out_while_writing_is_no_traceback(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        async with running(f"serial:{uart.path}:57600") as (link, _):
            await until(lambda: link.up)
            uart.unplug()
            link.send(FRAME)  # the write fails before anyone has read the end
            assert not link.up
            assert not link.send(FRAME)
            await until(lambda: link.last_error)

    run(test)
    assert [record.exc_info for record in caplog.records] == [None]
    assert len(lines(caplog)) == 1


def test_serial_that_does_not_drain_costs_frames_and_no_time(tmp_path: Path) -> None:
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        async with running(f"serial:{uart.path}:57600") as (link, _):
            await until(lambda: link.up)
            began = time.monotonic()
            for _ in range(1000):
                link.send(bytes(280))
                await asyncio.sleep(0)
            assert time.monotonic() - began < 2.0
            assert link.dropped > 500
            assert link.up
            await asyncio.sleep(0.01)
        uart.unplug()

    run(test)


def test_serial_that_another_program_holds_is_refused_in_words(tmp_path: Path) -> None:
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        text = f"serial:{uart.path}:57600"
        async with running(text) as (first, _), running(text) as (second, _):
            await until(lambda: first.up or second.up)
            await until(lambda: first.last_error or second.last_error)
            assert "Could not exclusively lock port" in first.last_error + second.last_error
        uart.unplug()

    run(test)


@pytest.mark.parametrize("device", ["/dev/no-such-uart", "/dev/null", "/"])
def test_a_device_that_is_no_uart_is_one_line(device: str, caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        async with running(f"serial:{device}:57600") as (link, _):
            await until(lambda: link.last_error)
            assert "port" in link.last_error
            assert not link.up

    run(test)
    (line,) = lines(caplog)
    assert "\n" not in line
