"""MAVSDK (C++) in a process of its own, as the other end of a link."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
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


def mavsdk(role: str, url: str) -> AbstractAsyncContextManager[Peer]:
    """MAVSDK that listens: `mavlink/mavsdk_peer.py`."""
    return _script("mavsdk_peer.py", role, url)


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


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
