"""Laws of host names: a name server that does not answer holds up no other link, and no shutdown."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from test_link import FRAME, WITHIN_S, Server, datagram, free_port, run, running, udp, until

from locagen_edge.mavlink import resolver

NAME = "ground.invalid"


class NameServer:
    """Answers once it is released, with these addresses; counts who waits."""

    def __init__(self, *found: tuple[Any, ...]) -> None:
        self.found = list(found)
        self.released = threading.Event()
        self.asked = 0
        self.waiting = 0
        self.most_waiting = 0

    def getaddrinfo(self, host: str, *_: Any, **__: Any) -> list[tuple[Any, ...]]:
        assert host == NAME, "an address in figures is looked up by nobody"
        self.asked += 1
        self.waiting += 1
        self.most_waiting = max(self.most_waiting, self.waiting)
        self.released.wait(10 * WITHIN_S)
        self.waiting -= 1
        if not self.found:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return [(socket.AF_INET6 if len(at) == 4 else socket.AF_INET, 1, 6, "", at) for at in self.found]


@pytest.fixture
def name_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[NameServer]:
    server = NameServer(("127.0.0.1", 0))
    monkeypatch.setattr(socket, "getaddrinfo", server.getaddrinfo)
    monkeypatch.setattr(resolver, "WAIT_S", 0.02)
    yield server
    server.released.set()


@pytest.mark.parametrize("scheme", ["udpout", "udpin", "tcp", "tcpin"])
def test_one_lookup_at_a_time_however_often_it_is_tried(scheme: str, name_server: NameServer) -> None:
    async def test() -> None:
        async with running(f"{scheme}:{NAME}:{free_port(socket.SOCK_STREAM)}", 0.01) as (link, _):
            await until(lambda: link.last_error)
            assert link.last_error == f"{NAME}: still being looked up"
            await asyncio.sleep(0.5)  # more than ten attempts
            assert (name_server.asked, name_server.most_waiting) == (1, 1)
            name_server.released.set()
            if scheme == "tcp":
                await until(lambda: link.last_error == "Connection refused")
            else:
                await until(lambda: link._port)
            assert name_server.most_waiting == 1

    run(test)


def test_neither_another_link_nor_the_shared_threads_are_held_up(name_server: NameServer) -> None:
    async def test() -> None:
        with closing(udp()) as peer:
            names = [f"tcp:{NAME}:{port}" for port in (5760, 5761, 5762)]
            async with (
                running(names[0], 0.01) as (one, _),
                running(names[1], 0.01) as (two, _),
                running(names[2], 0.01) as (three, _),
            ):
                await until(lambda: one.last_error and two.last_error and three.last_error)
                await asyncio.sleep(0.3)
                async with running(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as (link, _):
                    await until(lambda: link.up)
                    assert link.send(FRAME)
                    assert await datagram(peer) == FRAME
                async with asyncio.timeout(WITHIN_S):
                    await asyncio.gather(*[asyncio.to_thread(int) for _ in range(40)])
                assert name_server.asked == name_server.waiting == 3
        name_server.released.set()

    run(test)


def test_an_answer_that_comes_late_is_used_and_the_next_one_asked_for(name_server: NameServer) -> None:
    """Addresses change; a link that has failed does not go on with an old one."""

    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        await server.open()
        async with running(f"tcp:{NAME}:{server.port}") as (link, _):
            await until(lambda: link.last_error)
            name_server.released.set()
            await until(lambda: link.up)
            assert name_server.asked == 1
            await server.close()
            await until(lambda: name_server.asked > 1)

    run(test)


def test_all_addresses_of_a_name_are_tried_in_their_order(name_server: NameServer) -> None:
    """A computer on the field may have an address of IPv6 that its program does not listen at."""
    name_server.released.set()
    name_server.found = [("::1", 0, 0, 0), ("127.0.0.1", 0)]

    async def test() -> None:
        server = Server(free_port(socket.SOCK_STREAM))
        await server.open()
        async with running(f"tcp:{NAME}:{server.port}") as (link, _):
            await until(lambda: link.up)
            assert link._port.transport.get_extra_info("peername")[0] == "127.0.0.1"  # type: ignore[union-attr]
        await server.close()

    run(test)


def test_a_link_local_address_keeps_its_interface(name_server: NameServer) -> None:
    name_server.released.set()
    name_server.found = [("fe80::1", 0, 0, 3), ("2001:db8::1", 0, 0, 0), ("192.0.2.1", 0)]
    found = asyncio.run(resolver.Resolver(NAME).addresses())
    assert found == ["fe80::1%3", "2001:db8::1", "192.0.2.1"]


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0", "::1", "fe80::1"])
def test_an_address_in_figures_needs_no_thread(
    address: str, name_server: NameServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading.Thread, "start", lambda _: pytest.fail("a thread"))
    assert asyncio.run(resolver.Resolver(address).addresses()) == [address]


def test_a_failure_is_told_and_the_name_is_asked_for_again(name_server: NameServer) -> None:
    name_server.released.set()
    name_server.found = []

    async def test() -> None:
        async with running(f"udpout:{NAME}:14550") as (link, _):
            await until(lambda: name_server.asked > 2)
            assert link.last_error == "Temporary failure in name resolution"
            assert name_server.most_waiting == 1

    run(test)


NEVER = f"""
import asyncio, socket, threading
from locagen_edge.mavlink.link import Link, parse

socket.getaddrinfo = lambda *_, **__: threading.Event().wait()  # no name server ever answers

async def main():
    link = Link(parse("tcp:{NAME}:5760"), backoff_s=0.05, on_bytes=lambda _: None)
    task = asyncio.create_task(link.run())
    while not link.last_error:
        await asyncio.sleep(0.01)
    task.cancel()
    await asyncio.wait({{task}})

asyncio.run(main())
print("ended")
"""


def test_the_process_ends_while_a_name_is_looked_up() -> None:
    """Whoever waited for the lookup would wait for ever."""
    done = subprocess.run(
        [sys.executable, "-c", NEVER], capture_output=True, text=True, timeout=5 * WITHIN_S, check=False
    )
    assert (done.returncode, done.stdout) == (0, "ended\n"), done.stderr
