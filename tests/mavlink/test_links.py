"""Laws of several links: all are told, who asks is answered, nothing is passed on, none waits for another."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common
from test_link import Server, Uart, free_port, udp, until

from locagen_edge.daemon import TICK_S
from locagen_edge.mavlink import dialect, links
from locagen_edge.mavlink.component import ANSWERS_AT_ONCE, ANSWERS_WAITING, HEARTBEAT_S, Component, Status
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.link import parse
from locagen_edge.mavlink.links import Links
from locagen_edge.mavlink.signing import Guard
from locagen_edge.settings import MavlinkSettings

QUIET = Status(hearing=True, track=None, snr_db=0.0, faults=())
BOUND_S = 20.0  # far above what anything here takes; it bounds a test that fails


def autopilot(message: Any) -> bytes:
    return bytes(message.pack(common.MAVLink(None, 7, 1)))


HEARTBEAT = autopilot(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
PING = autopilot(common.MAVLink_ping_message(12345, 6, 0, 0))


class Node:
    """A component on its links, as the daemon holds them."""

    def __init__(self, specs: list[str], guard: Guard | None = None) -> None:
        self.component = Component(MavlinkSettings(send_records=False, send_tunnel=False), guard=guard)
        self.heard_bytes = 0
        self.links = Links([parse(s) for s in specs], backoff_s=10.0, on_bytes=self.receive, guard=guard)

    def receive(self, number: int, data: bytes) -> None:
        self.heard_bytes += len(data)
        self.component.receive(data, time.monotonic(), number)
        for frame in self.component.answers(number):
            self.links.answer(number, frame)

    @property
    def heartbeats(self) -> int:
        return sum(framer.frames for framer in self.component.received.values())


@asynccontextmanager
async def running(*specs: str, guard: Guard | None = None) -> AsyncIterator[Node]:
    node = Node(list(specs), guard)
    task = asyncio.create_task(node.links.run())
    try:
        yield node
    finally:
        task.cancel()
        await asyncio.wait({task})
        assert task.cancelled()


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(BOUND_S):
            await test()

    asyncio.run(bounded())


def arrived(peer: socket.socket) -> list[Any]:
    framer, found = Framer(), []
    try:
        while True:
            found += [dialect.decode(packet.raw) for packet in framer.feed(peer.recv(2000))]
    except BlockingIOError:
        return found


def names(found: list[Any]) -> list[str]:
    return [message.get_type() for message in found]


def test_all_are_told_and_only_who_asks_is_answered():
    async def test() -> None:
        with closing(udp()) as one, closing(udp()) as two:
            specs = [f"udpout:127.0.0.1:{peer.getsockname()[1]}" for peer in (one, two)]
            async with running(*specs) as node:
                await until(lambda: node.links.up == 2)
                for frame in node.component.due(0.0, QUIET):
                    node.links.send(frame)
                assert names(arrived(one)) == names(arrived(two)) == ["HEARTBEAT"]
                back = [link._port.transport.get_extra_info("sockname") for link in node.links.links]
                two.sendto(HEARTBEAT + PING, back[1])
                await until(lambda: node.component.sent["PING"])
                (answer,) = arrived(two)
                assert (answer.seq, answer.time_usec) == (6, 12345)
                assert (answer.target_system, answer.target_component) == (7, 1)
                assert arrived(one) == [], "neither the answer nor what came in goes to another link"

    run(test)


def test_a_ping_for_somebody_else_is_not_answered():
    component = Component(MavlinkSettings())
    for system, target in ((7, 1), (1, 191), (0, 1)):
        component.receive(autopilot(common.MAVLink_ping_message(1, 1, system, target)), 0.0)
    assert component.answers(0) == []


def test_answers_are_paced_and_bounded():
    component = Component(MavlinkSettings())
    for _ in range(200):
        component.receive(PING, 0.0, 3)
    assert component.answers(0) == []
    rounds = [len(component.answers(3)) for _ in range(20)]
    assert max(rounds) == ANSWERS_AT_ONCE
    assert sum(rounds) == ANSWERS_WAITING


def test_a_dead_link_holds_up_no_other():
    async def test() -> None:
        dead = f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        with closing(udp()) as peer:
            alive = f"udpout:127.0.0.1:{peer.getsockname()[1]}"
            async with running(dead, alive, "serial:/dev/no-such-uart:57600") as node:
                await until(lambda: node.links.up == 1 and node.links.last_error.count(";") == 1)
                for frame in node.component.due(0.0, QUIET):
                    node.links.send(frame)
                assert names(arrived(peer)) == ["HEARTBEAT"]
                assert node.links.dropped == 0, "a link that is down is not asked"
                assert f"{dead}: Connection refused" in node.links.last_error
                assert "no-such-uart" in node.links.last_error
                assert alive not in node.links.last_error

    run(test)


def test_each_link_signs_under_its_own_id():
    """Streams of one id on two roads of different length would overtake each other, and be refused."""
    guard = Guard(bytes(32), link_id=4, timestamp=10**13)

    async def test() -> None:
        with closing(udp()) as one, closing(udp()) as two:
            specs = [f"udpout:127.0.0.1:{peer.getsockname()[1]}" for peer in (one, two)]
            async with running(*specs, guard=guard) as node:
                await until(lambda: node.links.up == 2)
                for frame in node.component.due(0.0, QUIET):
                    node.links.send(frame)
                ids = [peer.recv(2000)[-13] for peer in (one, two)]
                assert ids == [4, 5]

    run(test)


def test_attempts_are_never_farther_apart_than_a_peers_return_allows():
    node = Node(["tcp:127.0.0.1:1", "udpin:127.0.0.1:1"])
    assert [link._backoff_s for link in node.links.links] == [links.BACKOFF_S] * 2
    # and who is back has a heartbeat within 2 s, even where another link keeps the beat
    assert links.BACKOFF_S + TICK_S + HEARTBEAT_S <= 2.0


@pytest.mark.parametrize("kept", range(1, len(HEARTBEAT), 6))
def test_a_cut_in_mid_message_costs_that_message_alone(kept: int):
    """The connection goes within a frame; the next one begins with a whole one."""

    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        await server.open()
        async with running(f"tcp:127.0.0.1:{server.port}") as node:
            await until(lambda: server.writers)
            server.writers[0].write(HEARTBEAT + HEARTBEAT[:kept])
            await until(lambda: node.heard_bytes == len(HEARTBEAT) + kept)
            await server.close()  # the peer restarts
            await until(lambda: not node.links.up)
            await server.open()
            await until(lambda: server.writers)
            server.writers[0].write(HEARTBEAT * 3)
            # as many as the cut frame was long may be held back until more comes; then all are there
            await until(lambda: node.heartbeats >= 3)
            server.writers[0].write(HEARTBEAT)
            await until(lambda: node.heartbeats == 5)
        await server.close()

    run(test)


def test_a_terminal_that_is_closed_in_mid_message_is_heard_again(tmp_path: Path):
    async def test() -> None:
        uart = Uart(tmp_path / "uart")
        async with running(f"serial:{uart.path}:57600") as node:
            await until(lambda: node.links.up)
            os.write(uart.master, HEARTBEAT[:9])
            await until(lambda: node.heard_bytes == 9)
            uart.unplug()
            await until(lambda: not node.links.up)
            uart.plug()
            await until(lambda: node.links.up)
            os.write(uart.master, HEARTBEAT * 2)
            await until(lambda: node.heartbeats == 2)
        uart.unplug()

    run(test)
