"""One caller who calls five times in a minute, perhaps too faintly for one call to be found: what is told.

Fields, classes and drones are those of `bearings`. BEFORE_S of noise, then a minute of it with CALLS calls of
one class from one direction in it, at random times, each PAUSE_S or more after the one before and as loud.
Right is what the pipeline tells at the end of the last one: the track's azimuth, and where there is none the
bearing's, within `bearings.RIGHT_DEG`. The drone hovers, and its attitude is not known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from locagen_edge.geometry import direction
from locagen_edge.lab.denoise import bearings
from locagen_edge.lab.denoise.bearings import Answer, Event
from locagen_edge.lab.denoise.cases import loudest, own_noise
from locagen_edge.lab.denoise.evaluate import HELP
from locagen_edge.lab.denoise.sounds import corpus
from locagen_edge.lab.settings import LabSettings
from locagen_edge.sim.levels import band_power, from_db
from locagen_edge.sim.propagation import plane_wave
from locagen_edge.types import F64

CALLS = 5
CALL_S = 2.25
MINUTE_S = 60.0
PAUSE_S = 1.0
SNRS_DB = (-25.0, -20.0, -15.0, -10.0)
METHODS = {"steered": True, "steered, every call by itself": False}
"""whether what is too faint is remembered, as `detection.repeats_s` says"""


@dataclass(frozen=True)
class Repeated:
    """One caller, and when."""

    event: Event
    """its `call` is the first"""
    calls: tuple[F64, ...]
    """(n,) each"""
    starts: tuple[int, ...]
    """in samples of the noise"""

    @property
    def end(self) -> int:
        """Of the last call, in samples."""
        return self.starts[-1] + len(self.calls[-1])


def callers(s: LabSettings, count: int) -> Iterator[Repeated]:
    """`count` callers for help, classes and drones in turn."""
    known = {kind: sounds for kind, sounds in corpus(s, "test").calls.items() if kind in HELP}
    drones = own_noise(s)
    rate_hz = s.audio.rate_hz
    n = round(CALL_S * rate_hz)
    before, minute = round(bearings.BEFORE_S * rate_hz), round(MINUTE_S * rate_hz)
    for k in range(count):
        rng = np.random.default_rng([s.mixes.seed, 79, k])
        kind, drone = sorted(known)[k % len(known)], list(drones)[k % len(drones)]
        sounds = [
            known[kind][place].astype(np.float64) for place in rng.integers(len(known[kind]), size=CALLS)
        ]
        calls = tuple(loudest(np.tile(call, math.ceil(n / len(call))), n) for call in sounds)
        noise = bearings.stretch(drones[drone], before + minute, rng)
        azimuth_rad = float(rng.uniform(-math.pi, math.pi))
        starts = tuple(before + start for start in _starts(minute, n, round(PAUSE_S * rate_hz), rng))
        yield Repeated(Event(kind, drone, calls[0], noise, azimuth_rad, 10_000 + k), calls, starts)


def _starts(minute: int, n: int, pause: int, rng: np.random.Generator) -> list[int]:
    """CALLS times within a minute, calls of n samples at least `pause` apart; all such times are alike."""
    spare = minute - CALLS * n - (CALLS - 1) * pause
    return [int(at) + k * (n + pause) for k, at in enumerate(np.sort(rng.integers(spare + 1, size=CALLS)))]


def sound_of(s: LabSettings, caller: Repeated, field: str) -> tuple[F64, F64]:
    """Noise (mics, m) at LEVEL_DBFS, and the calls (mics, m), each of them as loud while it lasts."""
    event, rate_hz = caller.event, s.audio.rate_hz
    rng = np.random.default_rng([s.mixes.seed, 80, event.seed])
    noise = bearings.FIELDS[field](s, event, rng)
    level = from_db(bearings.LEVEL_DBFS)
    noise *= math.sqrt(level / band_power(noise, rate_hz))
    u = direction(event.azimuth_rad, bearings.ELEVATION_RAD)
    heard = np.zeros_like(noise)
    for call, start in zip(caller.calls, caller.starts, strict=True):
        wave = plane_wave(call, rate_hz, s.mic_array.positions_m, u, s.speed_m_s)
        heard[:, start : start + len(call)] = wave * math.sqrt(level / band_power(wave, rate_hz))
    return noise, heard


def answers(
    s: LabSettings, methods: tuple[str, ...], snrs_db: tuple[float, ...], job: tuple[Repeated, str]
) -> list[Answer]:
    """All methods at all SNRs on one caller in one field; `called`: whether anything was told at the end."""
    caller, field = job
    noise, calls = sound_of(s, caller, field)
    found = []
    for snr_db in snrs_db:
        sound = (noise + math.sqrt(from_db(snr_db)) * calls).astype(np.float32)[:, : caller.end]
        for method in methods:
            memory_s = s.detection.repeats_s if METHODS[method] else 0.0
            flown = replace(s, detection=replace(s.detection, repeats_s=memory_s))
            last = bearings.estimates(flown, "steered", sound)[-1]
            told = last.track is not None or last.bearing.azimuth_rad is not None
            right = bearings.is_right(last, caller.event.azimuth_rad)
            found.append(Answer(field, method, snr_db, MINUTE_S, right, told))
    return found


def evaluate(
    s: LabSettings, count: int, processes: int = 1, methods: tuple[str, ...] = tuple(METHODS),
    fields: tuple[str, ...] = tuple(bearings.FIELDS), snrs_db: tuple[float, ...] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Counts of `count` callers in each of `fields`, as `bearings.evaluate` gives them."""
    chosen = list(callers(s, count))
    jobs = [(caller, field) for caller in chosen for field in fields]
    ask = partial(answers, s, methods, SNRS_DB if snrs_db is None else snrs_db)
    said = bearings.asked(ask, jobs, processes, "callers")
    return bearings.summary([caller.event for caller in chosen], said)
