"""MAVSDK (C++) in a process of its own, as the other end of a link."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import sys
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

WITHIN_S = 20.0
"""far above what anything here takes; it bounds a test that fails"""


class Peer:
    """What the other process says."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.heard: list[dict[str, Any]] = []

    async def until(self, condition: Callable[[list[dict[str, Any]]], Any]) -> Any:
        assert self._process.stdout
        async with asyncio.timeout(WITHIN_S):
            while not (found := condition(self.heard)):
                line = await self._process.stdout.readline()
                assert line, "the peer has ended"
                self.heard.append(json.loads(line))
        return found

    def messages(self, name: str) -> list[dict[str, Any]]:
        return [message for message in self.heard if message.get("name") == name]


def mavsdk(role: str, url: str, *xml: str) -> AbstractAsyncContextManager[Peer]:
    """MAVSDK that listens: `mavlink/mavsdk_peer.py`."""
    return _script("mavsdk_peer.py", role, url, *xml)


def operator(url: str) -> AbstractAsyncContextManager[Peer]:
    """MAVSDK that sets parameters and commands: `mavlink/mavsdk_operator.py`."""
    return _script("mavsdk_operator.py", url)


@asynccontextmanager
async def _script(name: str, *arguments: str) -> AsyncIterator[Peer]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(Path(__file__).parent / "mavlink" / name),
        *arguments,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    peer = Peer(process)
    try:
        await peer.until(lambda heard: heard and heard[0].get("open"))
        yield peer
    finally:
        assert process.stdin
        process.stdin.close()
        try:
            await asyncio.wait_for(process.wait(), 2.0)
        except TimeoutError:
            process.kill()
            await process.wait()


@asynccontextmanager
async def null_modem() -> AsyncIterator[tuple[str, str]]:
    """Two serial devices with a cable between them."""
    ends = [os.openpty(), os.openpty()]
    loop = asyncio.get_running_loop()

    def carry(source: int, sink: int) -> None:
        with contextlib.suppress(OSError):  # nobody reads there, or has opened it yet
            os.write(sink, os.read(source, 4096))

    for (master, slave), (other, _) in zip(ends, reversed(ends), strict=True):
        tty.setraw(slave)
        os.set_blocking(master, False)
        loop.add_reader(master, carry, master, other)
    try:
        yield os.ttyname(ends[0][1]), os.ttyname(ends[1][1])
    finally:
        for master, slave in ends:
            loop.remove_reader(master)
            os.close(slave)
            os.close(master)


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
