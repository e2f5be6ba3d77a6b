"""What befalls links and clocks in flight: the daemon hears on, and its log lacks no bearing.

How fast a link is back follows from `links.BACKOFF_S` (`test_links.py`); what a flood may cost, from the
bytes and changes that are let in (`test_link.py`, `test_commands.py`).
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import socket
import time
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager, closing
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common
from test_daemon import running, steady, until
from test_link import Server, Uart, free_port, udp
from test_twins import TAKEN, Other

from locagen_edge.daemon import Daemon
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.link import BURST
from locagen_edge.settings import Settings, from_table
from locagen_edge.store.journal import records
from locagen_edge.types import Frame

HALF = 17
"""bytes of a heartbeat after which it is cut"""


def packed(message: Any, system: int = 7, component: int = 1) -> bytes:
    return bytes(message.pack(common.MAVLink(None, system, component)))


HEARTBEAT = packed(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))


async def calls(settings: Settings) -> AsyncGenerator[Frame, None]:
    """A call without end, two and a half times as fast as it sounds."""
    loud = steady(settings)
    for number in count():
        samples = loud[number % len(loud)].samples
        yield Frame(samples, 10_000.0, time.monotonic_ns() - 102_400_000, number * settings.audio.hop)
        await asyncio.sleep(0.02)


@asynccontextmanager
async def flying(link: str, folder: Path, **mavlink: Any) -> AsyncIterator[Daemon]:
    """A daemon with its log; at the end all that it has estimated has to be in there."""
    settings = from_table(
        {
            "mavlink": {"link": link, "state_directory": str(folder), **mavlink},
            "detection": {"snr_db": -20},
            "bearing": {"estimator": "far-field"},
            "log": {"directory": str(folder / "log")},
        }
    )
    estimated: list[int] = []

    def note(_: Frame, estimate: Any) -> None:
        if estimate.detection.call or estimate.tracks:
            estimated.append(estimate.start)

    async with running(settings, sources=calls, on_estimate=note) as daemon:
        await until(lambda: len(estimated) > 10)
        yield daemon
        then = len(estimated)
        await until(lambda: len(estimated) > then + 5)  # it hears on
        assert daemon.hearing
        assert daemon.black_box is not None
    kept = [r for r in records(folder / "log") if r["type"] == "bearing"]
    assert daemon.black_box.lost == 0
    heard = [r["start"] for r in kept if r["detection"]["call"] or r["tracks"]]
    assert heard == estimated, "no bearing is lost from the log"
    times = [r["t_ns"] for r in kept]
    assert times == sorted(times)


def names(data: bytes) -> Counter[str]:
    return Counter(dialect.decode(packet.raw).get_type() for packet in Framer().feed(data))


def test_a_link_that_is_cut_in_mid_message_again_and_again(tmp_path: Path) -> None:
    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        async with flying(f"tcp:127.0.0.1:{server.port}", tmp_path) as daemon:
            for visit in range(3):
                await server.open()
                await until(lambda: server.writers)
                server.received.clear()
                await until(lambda: names(server.received)["HEARTBEAT"])
                assert names(server.received)["LOCAGEN_BEARING"] or visit == 0
                framer = daemon.component.received[0]
                before = framer.frames
                server.writers[0].write(HEARTBEAT + HEARTBEAT[:HALF])
                await until(lambda: framer.frames > before and framer.waiting == HALF)  # noqa: B023
                await server.close()
                await until(lambda: not daemon.links.up)
            await server.open()
            await until(lambda: server.writers)
            before = daemon.component.received[0].frames
            server.writers[0].write(HEARTBEAT * 2)
            await until(lambda: daemon.component.received[0].frames > before)
        await server.close()

    asyncio.run(test())


def test_a_serial_line_that_is_pulled_out_in_mid_message(tmp_path: Path) -> None:
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        async with flying(f"serial:{uart.path}:57600", tmp_path) as daemon:
            for _ in range(2):
                await until(lambda: daemon.links.up)
                os.write(uart.master, HEARTBEAT[:HALF])
                uart.unplug()
                await until(lambda: not daemon.links.up)
                uart.plug()
                got = bytearray()
                await until(lambda: got.extend(uart.read()) or names(got)["HEARTBEAT"])  # noqa: B023
        uart.unplug()

    asyncio.run(test())


def test_a_peer_that_starts_anew_at_the_same_place_is_told_what_holds(tmp_path: Path) -> None:
    """Over UDP nothing tells of its going; a ground station that reconnects asks for the parameters again."""

    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with flying(f"udpout:127.0.0.1:{port}", tmp_path) as daemon:
            for _ in range(2):
                with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as peer:
                    peer.bind(("127.0.0.1", port))
                    peer.setblocking(False)
                    got = bytearray()
                    await until(lambda: got.extend(read(peer)) or names(got)["HEARTBEAT"])  # noqa: B023
                    ours = daemon.links.links[0]._port.transport.get_extra_info("sockname")
                    asked = common.MAVLink_param_request_read_message(1, 191, b"LG_RATE", -1)
                    peer.sendto(packed(asked, 255, 190), ours)
                    await until(lambda: got.extend(read(peer)) or names(got)["PARAM_VALUE"])  # noqa: B023
                await asyncio.sleep(0.1)  # nobody there: each datagram comes back as refused
            assert daemon.links.refused

    asyncio.run(test())


def read(peer: socket.socket) -> bytes:
    data = b""
    try:
        while True:
            data += peer.recv(4096)
    except BlockingIOError:
        return data


def flood() -> list[bytes]:
    """A second's 2000 messages: streams, other vehicles, questions, changes, noise."""
    kinds = [
        *[common.MAVLink_attitude_quaternion_message(k, 1, 0, 0, 0, 0, 0, 0) for k in range(6)],
        common.MAVLink_global_position_int_message(1, 470_000_000, 80_000_000, 0, 20_000, 0, 0, 0, 0),
        common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3),
        common.MAVLink_param_request_list_message(7, 191),
        common.MAVLink_param_set_message(7, 191, b"LG_TRK_COAST", 3.0, 9),
        common.MAVLink_param_set_message(7, 191, b"LG_TRK_COAST", 4.0, 9),
        common.MAVLink_ping_message(1, 1, 0, 0),
        common.MAVLink_timesync_message(0, 1),
        common.MAVLink_command_long_message(7, 191, 512, 0, 148, 0, 0, 0, 0, 0, 0),
        common.MAVLink_statustext_message(6, b"x" * 50),
    ]
    return [packed(message) for message in itertools.islice(itertools.cycle(kinds), 2000)]


def test_a_flood_of_2000_messages_a_second(tmp_path: Path) -> None:
    async def test() -> None:
        with closing(udp()) as peer:
            async with flying(f"udpout:127.0.0.1:{peer.getsockname()[1]}", tmp_path) as daemon:
                await until(lambda: daemon.links.up)
                ours = daemon.links.links[0]._port.transport.get_extra_info("sockname")
                peer.sendto(HEARTBEAT, ours)
                await until(lambda: daemon.component.system_id == 7)
                before = daemon.counters.estimates
                messages = flood()
                for start in range(0, len(messages), 20):
                    for message in messages[start : start + 20]:
                        peer.sendto(message, ours)
                    await asyncio.sleep(0.01)
                assert daemon.counters.estimates > before + 10, "it heard on meanwhile"
                assert daemon.component.received[0].frames > 1000
                held_back = daemon.component.changes.held_back
                assert held_back > 50
                assert f"{held_back} commands or parameters held back" in daemon._in_words()
                assert "of a flood not read" not in daemon._in_words()
                read(peer)
                peer.sendto(packed(common.MAVLink_ping_message(7, 99, 0, 0), 255, 190), ours)
                got = bytearray()
                await until(lambda: got.extend(read(peer)) or names(got)["PING"])

    asyncio.run(test())


def test_what_is_not_read_of_a_flood_is_told(tmp_path: Path) -> None:
    """In the status line and in the log."""

    def logged() -> list[Any]:
        return [r for r in records(tmp_path / "log") if r["type"] == "losses" and r["flooded_bytes"]]

    async def test() -> None:
        with closing(udp()) as peer:
            async with flying(f"udpout:127.0.0.1:{peer.getsockname()[1]}", tmp_path) as daemon:
                (link,) = daemon.links.links
                link.take(bytes(BURST))  # nothing but noise
                link.take(bytes(50_000))
                assert "50000 bytes of a flood not read" in daemon._in_words()
                await until(logged)

    asyncio.run(test())
    assert (logged()[0]["flooded_bytes"], logged()[0]["held_back"]) == (50_000, 0)


def test_the_wall_clock_that_steps(tmp_path: Path) -> None:
    """A computer without a clock learns the date in flight; another one is set back by a day."""
    (tmp_path / "key").write_text("a passphrase")
    (tmp_path / "key").chmod(0o600)
    now, now_ns = time.time, time.time_ns

    async def test() -> None:
        with closing(udp()) as peer, pytest.MonkeyPatch.context() as patch:
            link = f"udpout:127.0.0.1:{peer.getsockname()[1]}"
            key = str(tmp_path / "key")
            async with flying(link, tmp_path, signing_key=key) as daemon:
                stamps = []
                for step_s in (0.0, -86_400.0, 40_000_000.0, -3600.0):
                    patch.setattr(time, "time", lambda step_s=step_s: now() + step_s)
                    patch.setattr(time, "time_ns", lambda step_s=step_s: now_ns() + round(step_s * 1e9))
                    then = daemon.component.sent["LOCAGEN_BEARING"]
                    await until(lambda: daemon.component.sent["LOCAGEN_BEARING"] > then + 1)  # noqa: B023
                    found = [p for p in Framer().feed(read(peer)) if p.signed]
                    assert found
                    stamps += [int.from_bytes(p.raw[-12:-6], "little") for p in found]
                assert stamps == sorted(set(stamps)), "signatures never go back: nobody would hear us"
                assert daemon.hearing

    asyncio.run(test())


def test_another_component_under_our_ids_is_told_once_and_bearings_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def test() -> None:
        with closing(udp()) as peer:
            async with flying(f"udpout:127.0.0.1:{peer.getsockname()[1]}", tmp_path) as daemon:
                await until(lambda: daemon.links.up)
                ours = daemon.links.links[0]._port.transport.get_extra_info("sockname")
                other = Other(begins=100)
                for _ in range(5):
                    peer.sendto(other.heartbeat(), ours)
                await until(lambda: TAKEN in daemon._in_words())
                then = daemon.component.sent["LG_AZB"]
                await until(lambda: daemon.component.sent["LG_AZB"] > then + 1)
                for _ in range(5):
                    peer.sendto(other.heartbeat(), ours)
                await until(lambda: daemon.component.sent["HEARTBEAT"] > 2)
                texts = [
                    m.text
                    for m in (dialect.decode(p.raw) for p in Framer().feed(read(peer)))
                    if m.get_type() == "STATUSTEXT"
                ]
                assert texts.count(TAKEN) == 1

    caplog.set_level(logging.WARNING)
    asyncio.run(test())
    assert sum(TAKEN in record.getMessage() for record in caplog.records) == 1
