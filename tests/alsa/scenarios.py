"""What happens to a card, and what the source makes of it. Run by card.py; tells by JSON on stdout."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from pathlib import Path

import numpy as np
from server import SoundServer

from locagen_edge.daemon import Daemon
from locagen_edge.errors import SourceError
from locagen_edge.settings import Settings, from_table
from locagen_edge.sources import open_source
from locagen_edge.stages import mic

DIRECTORY = Path()
"""of the test's own, as the order says"""
RUN, STALL, ENDED, REMOVED = range(4)
MODE, XRUNS, PPM, SKIP, OPENED, CLOSED = range(6)  # struct control of pcm_virtual.c


async def take(source, count):
    return [await anext(source) for _ in range(count)]


def told(frames):
    """Frames as JSON can carry them."""
    return [
        {"start": f.start, "t_ns": f.t_ns, "overruns": f.overruns, "samples": f.samples.tolist()}
        for f in frames
    ]


async def closing_s(source):
    before = time.monotonic()
    await source.aclose()
    return time.monotonic() - before


async def listen(settings, control):
    before_ns = time.monotonic_ns()
    source = open_source(settings)
    frames = await take(source, 6)
    after_ns = time.monotonic_ns()
    seconds = await closing_s(source)
    return {
        "frames": told(frames), "before_ns": before_ns, "after_ns": after_ns, "closing_s": seconds,
        "opened": int(control[OPENED]), "closed": int(control[CLOSED]),
    }  # fmt: skip


async def overrun(settings, control):
    source = open_source(settings)
    frames = await take(source, 4)
    control[XRUNS] += 1
    frames += await take(source, 6)
    await source.aclose()
    return {"frames": told(frames)}


async def skip(settings, control):
    """The card loses a fifth of a second and says nothing."""
    source = open_source(settings)
    frames = await take(source, 10)
    control[SKIP] += settings.audio.device_rate_hz // 5
    frames += await take(source, 20)
    await source.aclose()
    return {"frames": told(frames)}


async def lose(settings, control, mode):
    """The card goes, is missed, and comes back."""
    source = open_source(settings)
    await take(source, 2)
    control[MODE] = mode
    before = time.monotonic()
    try:
        await take(source, 100)
        error = ""
    except SourceError as lost:
        error = str(lost)
    seconds = time.monotonic() - before
    absent = await why(settings)
    control[MODE] = RUN
    source = open_source(settings)
    frames = await take(source, 3)
    return {
        "error": error, "seconds": seconds, "absent": absent,
        "frames": told(frames), "closing_s": await closing_s(source),
    }  # fmt: skip


async def why(settings):
    """The error with which a source does not open."""
    try:
        await anext(open_source(settings))
    except SourceError as error:
        return str(error)
    return ""


async def stalled(settings, control):
    return await lose(settings, control, STALL)


async def ended(settings, control):
    return await lose(settings, control, ENDED)


async def removed(settings, control):
    return await lose(settings, control, REMOVED)


async def cancelled(settings, control):
    """A task that waits for a frame is cancelled, as at SIGTERM."""

    async def forever():
        async for _ in open_source(settings):
            pass

    task = asyncio.create_task(forever())
    await asyncio.sleep(0.3)
    before = time.monotonic()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await asyncio.get_running_loop().shutdown_asyncgens()
    seconds = time.monotonic() - before
    return {"seconds": seconds, "opened": int(control[OPENED]), "closed": int(control[CLOSED])}


async def refused(settings, control):
    return {"error": await why(settings)}


async def hung(settings, control):
    """A driver that does not return from a read."""
    asleep = []

    def capture(stream, settings, wait, now_ns=time.monotonic_ns, tap=None):
        asleep.append(True)
        time.sleep(1.5)
        yield from ()

    mic.capture, real = capture, mic.capture
    mic.OPEN_S = 0.1  # and stall_s of 0.3 s
    mic.CLOSE_S = 0.2
    errors = []
    for _ in range(2):
        before = time.monotonic()
        try:
            await anext(open_source(settings))
        except SourceError as error:
            errors.append([type(error).__name__, str(error), time.monotonic() - before])
    await asyncio.sleep(1.5)
    mic.capture = real
    mic.OPEN_S = 10.0
    source = open_source(settings)
    frames = await take(source, 1)
    await source.aclose()
    return {"errors": errors, "tries": len(asleep), "after": len(frames)}


async def from_server(settings, control):
    """Some frames of a sound server, from when its players have begun."""
    server = SoundServer(DIRECTORY)
    server.start()
    try:
        source = open_source(settings)
        while np.any(np.abs((frame := await anext(source)).samples).max(axis=1) == 0):
            pass
        frames = [frame, *await take(source, 10)]
        return {"frames": told(frames), "closing_s": await closing_s(source)}
    finally:
        server.kill()


async def server_killed(settings, control):
    server = SoundServer(DIRECTORY)
    server.start()
    try:
        return await come_back(settings, lose=server.kill, bring_back=server.start)
    finally:
        server.kill()


async def replugged(settings, control):
    def mode(value):
        control[MODE] = value

    return await come_back(settings, lose=lambda: mode(REMOVED), bring_back=lambda: mode(RUN))


async def come_back(settings, lose, bring_back):
    """A daemon whose card is gone for so long that its pauses are at their longest."""
    daemon = Daemon(settings)
    await daemon.startup()
    main = asyncio.create_task(daemon.main_loop())
    counters = daemon.counters
    try:
        await until(lambda: counters.estimates > 5)
        lose()
        await until(lambda: daemon.source_fault)
        fault = daemon.source_fault
        status = []
        await until(lambda: counters.source_failures >= 4 and not daemon.hearing)
        status.append(daemon._in_words())
        bring_back()
        failures, back = counters.source_failures, time.monotonic()
        estimates = counters.estimates
        await until(lambda: counters.estimates > estimates)
        seconds = time.monotonic() - back
        await until(lambda: counters.estimates > estimates + 5)
        return {
            "fault": fault, "seconds": seconds, "tries": counters.source_failures - failures,
            "status": [*status, daemon._in_words()], "lost_s": counters.sound.lost_s,
        }  # fmt: skip
    finally:
        daemon.stop()
        await main
        await daemon.shutdown()


async def until(condition):
    async with asyncio.timeout(30):
        while not condition():
            await asyncio.sleep(0.01)


async def list_devices(settings, control):
    return {"devices": [[d.name, d.channels, d.default_rate_hz, d.host_api] for d in mic.devices()]}


SCENARIOS = {
    f.__name__: f
    for f in (
        listen, overrun, skip, stalled, ended, removed, cancelled, refused, hung, from_server, server_killed,
        replugged, list_devices,
    )
}  # fmt: skip


def main() -> None:
    global DIRECTORY
    order = json.load(sys.stdin)
    DIRECTORY = Path(order["control"]).parent
    settings: Settings = from_table(order["table"])
    control = np.memmap(order["control"], dtype=np.uint32, mode="r+", shape=(16,))
    json.dump(asyncio.run(SCENARIOS[sys.argv[1]](settings, control)), sys.stdout)


if __name__ == "__main__":
    main()
