"""What `locagen-edge check` finds: settings, models, microphones, link; what is wrong and what to do."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator

from locagen_edge.errors import LocagenError
from locagen_edge.mavlink.component import Component
from locagen_edge.mavlink.link import Link, parse
from locagen_edge.models import default_directory, load_model, read_manifest
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings
from locagen_edge.sources import open_source
from locagen_edge.types import Estimate

Finding = tuple[bool, str, str]
"""good, what, in words"""


def check(settings: Settings, seconds: float) -> Iterator[Finding]:
    """Findings in the order of the way: settings, models, microphones, link. Listens for `seconds`."""
    array = settings.mic_array
    longest = array.longest_delay_s(settings.speed_m_s) * settings.audio.rate_hz
    yield True, "settings", f"{array.mics} microphones, longest delay {longest:.2f} samples"
    yield from _models(settings)
    try:
        pipeline = Pipeline(settings)
    except LocagenError as error:
        yield False, "estimator", str(error)
        return
    yield True, "estimator", settings.bearing.estimator
    yield from asyncio.run(_listen(settings, pipeline, seconds))
    yield asyncio.run(_link(settings, seconds))


def _models(settings: Settings) -> Iterator[Finding]:
    """Every model of the manifest is loaded; one made for another array is fine as long as it is not used."""
    from pathlib import Path

    directory = Path(settings.models.directory) if settings.models.directory else default_directory()
    try:
        names = sorted(read_manifest(directory))
    except LocagenError as error:
        # without a manifest everything but the learned estimators works
        yield not settings.bearing.estimator.startswith("model:"), "models", str(error)
        return
    for name in names:
        used = settings.bearing.estimator == f"model:{name}"
        try:
            load_model(name, settings)
        except LocagenError as error:
            yield not used, "models", f"{error}{'' if used else ' (not used)'}"
        else:
            yield True, "models", f"{name}: hash and tensors as in the manifest"


async def _listen(settings: Settings, pipeline: Pipeline, seconds: float) -> list[Finding]:
    frames, overruns = 0, 0
    last: Estimate | None = None
    end = time.monotonic() + seconds
    try:
        async with contextlib.aclosing(open_source(settings)) as source:
            async with asyncio.timeout(seconds + settings.daemon.stall_s):
                async for frame in source:
                    last = pipeline.process(frame)
                    frames += 1
                    overruns += frame.overruns
                    if time.monotonic() >= end:
                        break
    except TimeoutError:
        return [(False, "microphones", f"no sound within {seconds + settings.daemon.stall_s:g} s")]
    except LocagenError as error:
        return [(False, "microphones", str(error))]
    if last is None:
        return [(False, "microphones", f"{settings.audio.source}: the source ended before the first frame")]
    found = [(False, "microphones", fault) for fault in last.faults]
    if overruns:
        found.append((False, "microphones", f"sound was lost {overruns} times: is the machine overloaded?"))
    level = last.detection.level_dbfs
    return found or [(True, "microphones", f"{frames} frames, level {level:.0f} dBFS in the band")]


async def _link(settings: Settings, seconds: float) -> Finding:
    """Opens the link and waits for an autopilot's heartbeat."""
    component = Component(settings.mavlink)
    link = Link(
        parse(settings.mavlink.link),
        backoff_s=settings.daemon.backoff_s,
        on_bytes=lambda data: component.receive(data, time.monotonic()),
    )
    task = asyncio.create_task(link.run())
    try:
        for _ in range(round(seconds / 0.05)):
            if component.autopilot_heard_s is not None:
                break
            await asyncio.sleep(0.05)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    if component.autopilot_heard_s is not None:
        return True, "link", f"{settings.mavlink.link}: an autopilot answers, system {component.system_id}"
    if link.last_error:
        return False, "link", link.last_error
    # one-way links to a ground station are legal: say it, but it is no fault
    return True, "link", f"{settings.mavlink.link}: open, but no autopilot has been heard in {seconds:g} s"
