"""Ground stations that others wrote, MAVSDK and MAVProxy, list and set our parameters and command us."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import shutil
import socket
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from autopilot import PILOTS, met
from conftest import ROOT
from peers import WITHIN_S, free_port, null_modem, operator
from test_daemon import running, steady, until

from locagen_edge.daemon import Daemon
from locagen_edge.mavlink.parameters import NAMES, value_of
from locagen_edge.settings import Settings, from_table
from locagen_edge.types import Frame

_PATH = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
MAVPROXY = shutil.which("mavproxy.py", path=_PATH)


async def calls(settings: Settings) -> AsyncIterator[Frame]:
    """A second of a call, two of quiet, and so on, a little faster than real time."""
    loud = steady(settings)
    quiet = 1e-4 * np.random.default_rng(0).standard_normal((3, 1024)).astype(np.float32)
    for number in count():
        samples = quiet if number % 60 < 40 else loud[number % len(loud)].samples
        yield Frame(samples, 10_000.0, time.monotonic_ns() - 102_400_000, number * 512)
        await asyncio.sleep(0.03)


LINKS = ["udp", "tcp", "serial", *PILOTS]


@asynccontextmanager
async def road(kind: str) -> AsyncIterator[tuple[str, str, str]]:
    """A link of that kind, or through an autopilot, as we name it, as MAVSDK does and as MAVProxy does."""
    if kind == "serial":
        async with null_modem() as (near, far):
            yield f"serial:{near}:57600", f"serial://{far}:57600", far
        return
    if kind in ("stand-in", "simulator"):
        async with met(kind) as ends:
            at = "{}:{}".format(*ends.ground)
            yield ends.companion, f"tcpout://{at}", f"tcp:{at}"
        return
    at = f"127.0.0.1:{free_port(socket.SOCK_DGRAM if kind == 'udp' else socket.SOCK_STREAM)}"
    yield {
        "udp": (f"udpout:{at}", f"udpin://{at}", f"udpin:{at}"),
        "tcp": (f"tcpin:{at}", f"tcpout://{at}", f"tcp:{at}"),
    }[kind]


@asynccontextmanager
async def daemon_at(link: str, state: Path) -> AsyncIterator[Daemon]:
    mavlink = {"link": link, "state_directory": str(state)}
    settings = from_table({"mavlink": mavlink, "bearing": {"estimator": "far-field"}})
    async with running(settings, sources=calls) as daemon:
        yield daemon


@pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None, reason="needs the mavsdk package (extra: dev)"
)
@pytest.mark.parametrize("kind", LINKS)
def test_mavsdk_lists_sets_and_commands(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with (
            road(kind) as (ours, theirs, _),
            daemon_at(ours, tmp_path) as daemon,
            operator(theirs) as peer,
        ):
            await peer.until(lambda heard: [h for h in heard if "done" in h])
            told = {key: value for line in peer.heard for key, value in line.items() if key != "result"}
            assert told["listed"] == pytest.approx({n: value_of(Settings(), n) for n in NAMES}, rel=1e-6)
            assert told["integers"] == 0, "all are floats"
            assert told["set"] == told["after"] == 4.25
            assert daemon.settings.track.coast_s == 4.25
            results = {(h["command"], h["param1"]): h["result"] for h in peer.heard if "command" in h}
            accepted, denied, unsupported = 0, 2, 3
            assert results == {
                (31010, 0): accepted,
                (31010, 1): accepted,
                (31011, 0): accepted,
                (31010, 9): denied,
                (400, 1): unsupported,
                (512, 148): accepted,
            }

    asyncio.run(test())


class Console:
    """MAVProxy's, without its graphics."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.text = ""

    def say(self, line: str) -> None:
        assert self._process.stdin
        self._process.stdin.write(f"{line}\n".encode())

    async def until(self, condition: Callable[[str], object]) -> None:
        assert self._process.stdout
        async with asyncio.timeout(2 * WITHIN_S):
            while not condition(self.text):  # a test that fails shows what was said
                data = await self._process.stdout.read(4096)
                assert data, f"MAVProxy has ended:\n{self.text}"
                self.text += data.decode(errors="replace")


@asynccontextmanager
async def mavproxy(master: str, home: Path) -> AsyncIterator[Console]:
    assert MAVPROXY
    process = await asyncio.create_subprocess_exec(
        MAVPROXY,
        f"--master={master}",
        "--baudrate=57600",
        "--target-system=1",
        "--target-component=191",
        "--no-state",
        "--nowait",
        "--default-modules=param,ftp,cmdlong,misc",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        cwd=home,
        env={**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(home), "PYTHONUNBUFFERED": "1"},
    )
    try:
        yield Console(process)
    finally:
        process.kill()
        await process.wait()


@pytest.mark.skipif(MAVPROXY is None, reason="needs MAVProxy (extra: dev)")
@pytest.mark.parametrize("kind", LINKS)
def test_mavproxy_lists_sets_and_commands_and_loads_our_module(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with (
            road(kind) as (ours, _, theirs),
            daemon_at(ours, tmp_path) as daemon,
            mavproxy(theirs, tmp_path) as console,
        ):
            await console.until(lambda text: f"Received {len(NAMES)} parameters" in text)
            console.say("param show LG_*")
            await console.until(lambda text: all(name in text for name in NAMES))
            console.say("param set LG_TRK_COAST 3.5")
            await until(lambda: daemon.settings.track.coast_s == 3.5)
            console.say("param fetch LG_TRK_COAST")
            await console.until(lambda text: "LG_TRK_COAST = 3.5000000" in text)
            console.say("long 31010 0")
            await console.until(lambda text: "COMMAND_ACK: USER_1: ACCEPTED" in text)
            await console.until(lambda text: "AP: Stopped listening, as commanded" in text)
            assert not daemon.component.listening
            console.say("long 400 1")
            await console.until(lambda text: "COMPONENT_ARM_DISARM: UNSUPPORTED" in text)
            await until(lambda: daemon.estimate is None)
            console.say("module load locagen")
            await console.until(lambda text: "Loaded module locagen" in text)
            console.say("locagen")
            await console.until(lambda text: "no call so far" in text)
            console.say("long 31010 1")
            await console.until(lambda text: "locagen: call 1 of vehicle 1" in text)
            console.say("locagen")
            await console.until(lambda text: "vehicle 1 call 1" in text)

    asyncio.run(test())
