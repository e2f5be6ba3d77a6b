"""What `locagen-edge check` finds: settings, models, microphones, link; what is wrong and what to do."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import replace

from locagen_edge.errors import LocagenError, SourceHungError
from locagen_edge.framing import Losses
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.link import Link, parse
from locagen_edge.mavlink.parameters import kept
from locagen_edge.mavlink.signing import Guard, guard_of
from locagen_edge.models import directory_of, load_model, read_manifest
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import BearingSettings, DenoiseSettings, Settings
from locagen_edge.sources import open_source

Finding = tuple[bool, str, str]
"""good, what, in words"""

LEAST_S = 1.0
"""A fault has to last for most of a second before it counts as one."""

NOT_JUDGED = (
    "no sound was common to all microphones: order, sign and spacing are not judged; "
    "clap or talk while this runs"
)
FASTEST_PPM = 500.0
"""Crystals err by 100 ppm at most; a device that misses its rate by more is not of the rate it says."""
WRONG_CLOCK = ": no crystal errs so much; does it resample, or lose sound?"

ALIVE = Status(hearing=True, track=None, snr_db=0.0, faults=())


def check(settings: Settings, seconds: float) -> Iterator[Finding]:
    """Findings in the order of the way: settings, models, microphones, link. Listens for `seconds`."""
    settings, told, faults = kept(settings)
    array = settings.mic_array
    longest = array.longest_delay_s(settings.speed_m_s) * settings.audio.rate_hz
    yield True, "settings", f"{array.mics} microphones, longest delay {longest:.2f} samples"
    for text in told:
        yield True, "parameters", text
    for text in faults:
        yield False, "parameters", text
    for name in ("roi", "yaw"):
        if getattr(settings.flight, name):
            modes = ", ".join(settings.flight.modes)
            yield True, "flight", f"flight.{name} is ON: we may command the vehicle in mode {modes}"
    yield from _models(settings)
    # the microphones can still be judged without what cannot be made
    fit = replace(settings, denoise=DenoiseSettings())
    try:
        pipeline = Pipeline(fit)
        yield True, "estimator", settings.bearing.estimator
    except LocagenError as error:
        yield False, "estimator", str(error)
        fit = replace(fit, bearing=BearingSettings())
        pipeline = Pipeline(fit)
    if settings.denoise.kind != "none":
        try:
            pipeline = Pipeline(replace(fit, denoise=settings.denoise))
            yield True, "denoiser", settings.denoise.kind
        except LocagenError as error:
            yield False, "denoiser", str(error)
    yield from asyncio.run(_listen(settings, pipeline, max(seconds, LEAST_S)))
    try:
        guard = guard_of(settings)
    except LocagenError as error:
        yield False, "signing", str(error)
        guard = Guard()
    for link in settings.mavlink.link:
        yield asyncio.run(_link(settings, link, guard, seconds))
    for complaint in guard.complaints(math.inf):
        yield False, "signing", complaint


def _models(settings: Settings) -> Iterator[Finding]:
    """Every model of the manifest is loaded; one made for another array is fine as long as it is not used."""
    used = _models_used(settings)
    try:
        names = sorted(read_manifest(directory_of(settings)))
    except LocagenError as error:
        # without a manifest everything works that is not learned
        yield not used, "models", str(error)
        return
    for name in names:
        try:
            load_model(name, settings)
        except LocagenError as error:
            yield name not in used, "models", f"{error}{'' if name in used else ' (not used)'}"
        else:
            yield True, "models", f"{name}: hash and tensors as in the manifest"


def _models_used(settings: Settings) -> set[str]:
    kind, estimator = settings.denoise.kind, settings.bearing.estimator
    used = {getattr(settings.denoise, kind)} if kind in ("wave", "mask") else set()
    return used | ({estimator.removeprefix("model:")} if estimator.startswith("model:") else set())


async def _listen(settings: Settings, pipeline: Pipeline, seconds: float) -> list[Finding]:
    """What is wrong in any frame. Raises `SourceHungError`: after it only the end of the process helps."""
    frames, losses, level_dbfs = 0, Losses(), 0.0
    faults: set[str] = set()
    end = math.inf  # counted from the first frame: opening a device takes its time
    try:
        async with contextlib.aclosing(open_source(settings)) as source:
            async for frame in source:
                end = min(end, time.monotonic() + seconds)
                estimate = pipeline.process(frame)
                faults.update(estimate.faults)
                level_dbfs = estimate.detection.level_dbfs
                frames += 1
                losses.count(frame)
                if time.monotonic() >= end:
                    break
    except SourceHungError:
        raise
    except LocagenError as error:
        return [(False, "microphones", str(error))]
    found = [(False, "microphones", fault) for fault in sorted(faults)]
    if frames and not pipeline.channels_judged:
        found.append((True, "channels", NOT_JUDGED))
    if losses.overruns:
        found.append((False, "sound", f"{losses}: is the machine overloaded?"))
    drift = losses.drift
    if drift is not None:
        wrong = abs(drift.ppm) > FASTEST_PPM + 3.0 * drift.sigma_ppm
        asked = f"audio.device_rate_hz = {settings.audio.device_rate_hz}"
        found.append(
            (not wrong, "clock", f"{asked}, the device runs by {drift}{WRONG_CLOCK if wrong else ''}")
        )
    if not faults:
        found.insert(0, (True, "microphones", f"{frames} frames, level {level_dbfs:.0f} dBFS in the band"))
    return found


async def _link(settings: Settings, name: str, guard: Guard, seconds: float) -> Finding:
    """Opens a link, says one heartbeat, and waits for an autopilot's."""
    component = Component(settings.mavlink, guard=guard)
    link = Link(
        parse(name),
        backoff_s=settings.daemon.backoff_s,
        on_bytes=lambda data: component.receive(data, time.monotonic()),
    )
    task = asyncio.create_task(link.run())
    try:
        told = False
        for _ in range(max(round(seconds / 0.05), 10)):
            if component.autopilot_heard_s is not None:
                break
            if link.up and not told:
                told = all(link.send(guard.sign(frame)) for frame in component.due(time.monotonic(), ALIVE))
            await asyncio.sleep(0.05)
        up = link.up
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    if component.autopilot_heard_s is not None:
        return True, "link", f"{name}: an autopilot answers, system {component.system_id}"
    if up:  # one-way links to a ground station are legal, and it may start later: said, but no fault
        nobody = "but nobody listens there yet" if link.refused else f"no autopilot heard in {seconds:g} s"
        return True, "link", f"{name}: open, {nobody}"
    if name.startswith(("udpin:", "tcpin:")) and not link.last_error:
        return True, "link", f"{name}: open, nobody has been heard in {seconds:g} s"
    return False, "link", f"{name}: {link.last_error or f'not open after {seconds:g} s'}"
