"""What denoisers do for the bearing: calls from known directions under noise, through the whole pipeline.

Calls and drones are those that no training heard. The noise of one microphone becomes that of an array in
four ways (FIELDS); the pipeline that flies hears BEFORE_S of it and then the call. What it says of the
direction at the call's end is right within RIGHT_DEG: the track's azimuth, and where there is none the
bearing's. A pipeline knows nothing of what comes later, so one run tells of a call of one second as well as
of the whole one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from locagen_edge.geometry import direction, wrap
from locagen_edge.lab.denoise.cases import loudest, own_noise
from locagen_edge.lab.denoise.evaluate import HELP
from locagen_edge.lab.denoise.sounds import corpus
from locagen_edge.lab.settings import LabSettings
from locagen_edge.pipeline import Pipeline
from locagen_edge.sim.levels import band_power, from_db
from locagen_edge.sim.propagation import place, plane_wave
from locagen_edge.sim.rotors import hubs_m
from locagen_edge.sim.scene import PARTS, Scene
from locagen_edge.types import F32, F64, Estimate, Frame

SNRS_DB = (-30.0, -20.0, -10.0, 0.0, 10.0)
BEFORE_S = 10.0
LENGTHS_S = (1.0, 2.25)
"""a short call, and the paper's"""
RIGHT_DEG = 10.0
ELEVATION_RAD = math.radians(-20.0)
LEVEL_DBFS = -35.0
"""in-band, of the noise"""

METHODS: dict[str, tuple[str, str, bool, float]] = {
    "steered": ("none", "steered", True, -20.0),
    "steered, all bins alike": ("none", "steered", False, -20.0),
    "steered, mask": ("mask", "steered", True, -20.0),
    "PHAT": ("none", "far-field", True, -20.0),
    "wave, then PHAT": ("wave", "far-field", True, -20.0),
    "wave, then PHAT half whitened": ("wave", "far-field", True, -1.0),
}
"""denoise.kind, bearing.estimator, steered.weigh and correlation.relative_floor_db: at -1 dB bins below the
mean fade out nearly as without whitening"""


Job = TypeVar("Job")


@dataclass(frozen=True)
class Event:
    """One call, and from where."""

    kind: str
    drone: str
    call: F64
    """(n,)"""
    noise: F64
    """(m,) of the drone, one microphone"""
    azimuth_rad: float
    seed: int


@dataclass(frozen=True)
class Answer:
    """What one method said of one event."""

    field: str
    method: str
    snr_db: float
    length_s: float
    right: bool
    called: bool
    """whether it was taken for a call at all"""


# --- scenes -------------------------------------------------------------------------------------------


def events(s: LabSettings, count: int) -> Iterator[Event]:
    """`count` calls for help, classes and drones in turn."""
    calls = {kind: sounds for kind, sounds in corpus(s, "test").calls.items() if kind in HELP}
    drones = own_noise(s)
    n, m = round(max(LENGTHS_S) * s.audio.rate_hz), round(_heard_s() * s.audio.rate_hz)
    for k in range(count):
        rng = np.random.default_rng([s.mixes.seed, 77, k])
        kind, drone = sorted(calls)[k % len(calls)], list(drones)[k % len(drones)]
        call = calls[kind][rng.integers(len(calls[kind]))].astype(np.float64)
        # what is shorter is heard again and again
        whole = loudest(np.tile(call, math.ceil(n / len(call))), n)
        noise = stretch(drones[drone], m, rng)
        yield Event(kind, drone, whole, noise, float(rng.uniform(-math.pi, math.pi)), k)


def stretch(sounds: list[F32], m: int, rng: np.random.Generator) -> F64:
    """m samples of one of a drone's recordings, from anywhere; a shorter one goes to and fro."""
    noise = sounds[rng.integers(len(sounds))].astype(np.float64)
    while len(noise) < m:
        noise = np.concatenate([noise, noise[::-1]])
    first = rng.integers(len(noise) - m + 1)
    return noise[first : first + m]


def _heard_s() -> float:
    return BEFORE_S + max(LENGTHS_S)


def _pieces(event: Event, count: int, rng: np.random.Generator) -> F64:
    """(count, m): other pieces of the same drone."""
    m = len(event.noise)
    return np.stack([np.roll(event.noise, k) for k in rng.integers(m // 20, m - m // 20, count)])


def _near(s: LabSettings, event: Event, rng: np.random.Generator) -> F64:
    return _pieces(event, s.mic_array.mics, rng)


def _diffuse(s: LabSettings, event: Event, rng: np.random.Generator) -> F64:
    """Coherence sin(x) / x of all directions alike (Cook et al., J. Acoust. Soc. Am. 27 (1955))."""
    array, m = s.mic_array, len(event.noise)
    apart = np.linalg.norm(array.positions_m[:, np.newaxis] - array.positions_m, axis=2)
    frequency = np.fft.rfftfreq(m, 1.0 / s.audio.rate_hz)
    coherence = np.sinc(2.0 * frequency[:, np.newaxis, np.newaxis] * apart / s.speed_m_s)
    root = np.linalg.cholesky(coherence + 1e-6 * np.eye(array.mics))
    spectra = np.fft.rfft(_pieces(event, array.mics, rng))
    sound: F64 = np.fft.irfft(np.einsum("fij,jf->if", root, spectra), m)
    return sound


def _rotors(s: LabSettings, event: Event, rng: np.random.Generator) -> F64:
    hubs = hubs_m(4, s.sim.rotor_arm_m)
    heard = [
        place(piece, s.audio.rate_hz, s.mic_array.positions_m, hub, s.speed_m_s)
        for piece, hub in zip(_pieces(event, len(hubs), rng), hubs, strict=True)
    ]
    sound: F64 = np.sum(heard, axis=0)
    return sound


def _simulated(s: LabSettings, event: Event, rng: np.random.Generator) -> F64:
    throttle = float(rng.uniform(0.3, 0.7))
    scene = Scene(replace(s, sim=replace(s.sim, rotors=4, throttle=throttle, seed=1000 + event.seed)))
    sound: F64 = scene.parts(len(event.noise))[PARTS.index("rotors") :].sum(axis=0, dtype=np.float64)
    return sound


FIELDS = {"diffuse": _diffuse, "four rotors": _rotors, "near rotors": _near, "simulated rotors": _simulated}
"""recorded noise from all directions; from four hubs; independent in each microphone; the simulated scene"""


def sound_of(s: LabSettings, event: Event, field: str) -> tuple[F64, F64]:
    """Noise (mics, m) at LEVEL_DBFS, and the call (mics, m) in its last part as loud over the event."""
    rng = np.random.default_rng([s.mixes.seed, 78, event.seed])
    noise = FIELDS[field](s, event, rng)
    n, rate_hz = len(event.call), s.audio.rate_hz
    u = direction(event.azimuth_rad, ELEVATION_RAD)
    call = np.zeros_like(noise)
    call[:, -n:] = plane_wave(event.call, rate_hz, s.mic_array.positions_m, u, s.speed_m_s)
    level = from_db(LEVEL_DBFS)
    noise *= math.sqrt(level / band_power(noise[:, -n:], rate_hz))
    call *= math.sqrt(level / band_power(call[:, -n:], rate_hz))
    return noise, call


# --- what the pipeline says -----------------------------------------------------------------------------


def pipeline(s: LabSettings, method: str) -> Pipeline:
    """The one that flies, with a method of METHODS."""
    kind, estimator, weigh, floor_db = METHODS[method]
    return Pipeline(
        replace(
            s,
            denoise=replace(s.denoise, kind=kind),
            bearing=replace(s.bearing, estimator=estimator),
            steered=replace(s.steered, weigh=weigh),
            correlation=replace(s.correlation, relative_floor_db=floor_db),
        )
    )


def estimates(s: LabSettings, method: str, sound: F32) -> list[Estimate]:
    """Of (mics, m), frame by frame."""
    hear, audio = pipeline(s, method), s.audio
    return [
        hear.process(
            Frame(
                sound[:, start : start + audio.frame].copy(),
                float(audio.rate_hz),
                round(start / audio.rate_hz * 1e9),
                start,
            )
        )
        for start in range(0, sound.shape[1] - audio.frame + 1, audio.hop)
    ]


def is_right(estimate: Estimate, azimuth_rad: float) -> bool:
    """Whether the track, or where there is none the bearing, is within RIGHT_DEG."""
    told = estimate.track.azimuth_rad if estimate.track else estimate.bearing.azimuth_rad
    return told is not None and abs(wrap(told - azimuth_rad)) <= math.radians(RIGHT_DEG)


def answers(
    s: LabSettings, methods: tuple[str, ...], snrs_db: tuple[float, ...], job: tuple[Event, str]
) -> list[Answer]:
    """All methods at all SNRs on one event in one field."""
    event, field = job
    noise, call = sound_of(s, event, field)
    found = []
    for snr_db in snrs_db:
        sound = (noise + math.sqrt(from_db(snr_db)) * call).astype(np.float32)
        for method in methods:
            said = estimates(s, method, sound)
            begin = sound.shape[1] - len(event.call)
            for length_s in LENGTHS_S:
                end = begin + round(length_s * s.audio.rate_hz)
                heard = [e for k, e in enumerate(said) if begin < k * s.audio.hop + s.audio.frame <= end]
                called = any(e.detection.call for e in heard)
                right = is_right(heard[-1], event.azimuth_rad)
                found.append(Answer(field, method, snr_db, length_s, right, called))
    return found


def evaluate(
    s: LabSettings, count: int, processes: int = 1, methods: tuple[str, ...] = tuple(METHODS),
    fields: tuple[str, ...] = tuple(FIELDS), snrs_db: tuple[float, ...] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Counts of `count` events in each of `fields`."""
    chosen = list(events(s, count))
    jobs = [(event, field) for event in chosen for field in fields]
    ask = partial(answers, s, methods, SNRS_DB if snrs_db is None else snrs_db)
    return summary(chosen, asked(ask, jobs, processes, "bearings"))


def asked(ask: Callable[[Job], list[Answer]], jobs: list[Job], processes: int, name: str) -> list[Answer]:
    """All answers to all jobs, with a progress bar of that name."""
    bar = partial(tqdm, total=len(jobs), unit="scene", desc=name)
    if processes > 1:
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            return [one for some in bar(pool.map(ask, jobs)) for one in some]
    return [one for some in bar(map(ask, jobs)) for one in some]


def summary(chosen: list[Event], said: list[Answer]) -> dict[str, Any]:
    """Shares by field, length of the call, method and SNR, with their confidence intervals."""
    cells: dict[str, Any] = {}
    groups: dict[tuple[str, str, str, str], list[Answer]] = {}
    for x in said:
        groups.setdefault((x.field, f"{x.length_s:g}", x.method, f"{x.snr_db:g}"), []).append(x)
    for (field, length, method, snr), group in groups.items():
        cells.setdefault(field, {}).setdefault(length, {}).setdefault(method, {})[snr] = _cell(group)
    return {
        "events": len(chosen),
        "kinds": sorted({event.kind for event in chosen}),
        "drones": sorted({event.drone for event in chosen}),
        "fields": cells,
    }


def _cell(said: list[Answer]) -> dict[str, float]:
    right, of = sum(x.right for x in said), len(said)
    low, high = wilson(right, of)
    return {"right": right / of, "low": low, "high": high, "called": sum(x.called for x in said) / of}


def wilson(right: int, of: int) -> tuple[float, float]:
    """95 % confidence interval of a share (Wilson, J. Am. Stat. Assoc. 22 (1927) 209-212)."""
    z = 1.96
    share = right / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return middle - half, middle + half
