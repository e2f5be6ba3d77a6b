"""An independent implementation, MAVSDK (C++), reads what we send and is heard by us, over real sockets."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import math
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.link import Link, parse
from locagen_edge.settings import MavlinkSettings
from locagen_edge.types import Track

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None, reason="needs the mavsdk package (extra: dev)"
)

WITHIN_S = 20.0  # far above what anything here takes; it bounds a test that fails
QUIET = Status(hearing=True, track=None, snr_db=0.0, faults=())
CALLING = Status(
    hearing=True,
    track=Track(math.radians(-72.25), math.radians(3.25), math.radians(-20.0), 0.1, 0.6, 0.0, 0.875),
    snr_db=6.5,
    faults=(),
    heading_rad=math.radians(100.0),
)
WANTED = {"LG_AZB": 287.75, "LG_AZ": 27.75, "LG_EL": -20.0, "LG_SIG": 3.25, "LG_CONF": 0.875, "LG_SNR": 6.5}


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


@asynccontextmanager
async def mavsdk(role: str, url: str) -> AsyncIterator[Peer]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        str(Path(__file__).with_name("mavsdk_peer.py")),
        role,
        url,
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


class Daemon:
    """Link and component as the daemon joins them, with a status that the test sets."""

    def __init__(self, text: str) -> None:
        self.status = QUIET
        self.component = Component(MavlinkSettings(link=text))
        self.link = Link(
            parse(text),
            backoff_s=0.1,
            on_bytes=lambda data: self.component.receive(data, time.monotonic()),
        )

    async def run(self) -> None:
        was_up = False
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.link.run())
            while True:
                if self.link.up and not was_up:
                    self.component.say_again()
                if was_up := self.link.up:
                    for frame in self.component.due(time.monotonic(), self.status):
                        self.link.send(frame)
                await asyncio.sleep(0.02)


@asynccontextmanager
async def daemon(text: str) -> AsyncIterator[Daemon]:
    one = Daemon(text)
    task = asyncio.create_task(one.run())
    try:
        yield one
    finally:
        task.cancel()
        await asyncio.wait({task})


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def check(ground: Peer, daemon: Daemon, system: int) -> None:
    """The whole profile, as the ground station decodes it."""
    seen = await ground.until(lambda heard: [h for h in heard if h.get("subscribed")])
    assert (seen[0]["system"], seen[0]["components"]) == (system, [191])

    daemon.status = CALLING
    await ground.until(
        lambda _: {m["fields"]["name"] for m in ground.messages("NAMED_VALUE_FLOAT")} >= {*WANTED}
    )
    assert {
        m["fields"]["name"]: m["fields"]["value"] for m in ground.messages("NAMED_VALUE_FLOAT")
    } == pytest.approx(WANTED, rel=1e-6)  # float32
    await ground.until(lambda _: ground.messages("STATUSTEXT"))
    (call,) = ground.messages("STATUSTEXT")
    assert (call["fields"]["severity"], call["fields"]["text"]) == (
        5,
        "Call heard: 028 deg true, 288 from nose, +-3 deg",
    )

    daemon.status = replace(CALLING, faults=("microphone 2 is silent",))
    await ground.until(lambda _: len(ground.messages("STATUSTEXT")) == 2)
    fault = ground.messages("STATUSTEXT")[1]["fields"]
    assert (fault["severity"], fault["text"]) == (4, "microphone 2 is silent")
    await ground.until(
        lambda _: [m for m in ground.messages("HEARTBEAT") if m["fields"]["system_status"] == 5]
    )
    for beat in ground.messages("HEARTBEAT"):
        assert beat["fields"] | {"system_status": 0} == {
            "message_id": 0,
            "message_name": "HEARTBEAT",
            "type": 18,
            "autopilot": 8,
            "base_mode": 0,
            "custom_mode": 0,
            "mavlink_version": 3,
            "system_status": 0,
        }
    said = [message for message in ground.heard if "name" in message]
    assert {(m["system"], m["component"]) for m in said} == {(system, 191)}
    assert {m["name"] for m in said} == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT"}


@pytest.mark.parametrize(
    ("ours", "theirs", "kind"),
    [
        ("udpout:127.0.0.1:{}", "udpin://127.0.0.1:{}", socket.SOCK_DGRAM),
        ("udpin:127.0.0.1:{}", "udpout://127.0.0.1:{}", socket.SOCK_DGRAM),
        ("tcp:127.0.0.1:{}", "tcpin://127.0.0.1:{}", socket.SOCK_STREAM),
    ],
)
def test_a_ground_station_reads_all_that_we_say(ours: str, theirs: str, kind: socket.SocketKind) -> None:
    async def test() -> None:
        port = free_port(kind)
        async with daemon(ours.format(port)) as one, mavsdk("ground", theirs.format(port)) as ground:
            await check(ground, one, system=1)
            assert one.component.received.frames >= 1  # and we read it: its heartbeats at least

    asyncio.run(test())


def test_an_autopilot_teaches_us_its_system_id_before_the_ground_station_sees_us() -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with daemon(f"udpin:127.0.0.1:{port}") as one:
            deadline = time.monotonic() + WITHIN_S
            async with mavsdk("autopilot", f"udpout://127.0.0.1:{port}"):
                while one.component.autopilot_heard_s is None:
                    assert time.monotonic() < deadline
                    await asyncio.sleep(0.01)
                async with mavsdk("ground", f"udpout://127.0.0.1:{port}") as ground:
                    await check(ground, one, system=42)

    asyncio.run(test())
