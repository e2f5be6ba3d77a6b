"""The twin at the level of arrivals: delays as a sampled array would measure them, with the truth beside.

No sound is made here: a source stands somewhere, each microphone (a little off its place) hears it after
distance / c, and notes the sample of its own grid at which it does. That is the data of Kunwar, Cantor,
Rizzo & Qayyum, *LocaGen: Sub-Sample Time-Delay Learning for Beam Localization*; how an arrival becomes a
whole number, which the paper leaves open, is a parameter here, because the answer depends on it.

Samples come in blocks, each from a generator of its own that is seeded by (seed, number of the block): sample
k of a seed is the same whoever draws it and however many are asked for, so that a data set can be made in
pieces, in parallel, or again from the middle. The arrays of a block stay in the cache, and single
precision holds because distances are never subtracted: see `_later_m`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from locagen_edge.geometry import MicArray
from locagen_edge.settings import setting
from locagen_edge.types import F32, F64

BLOCK = 8192
"""Samples per generator: some 30 arrays of 32 KiB, twice a Raspberry Pi 5's second level."""


@dataclass(frozen=True)
class TwinSettings:
    """The digital twin: where sources stand, and how their arrivals are measured."""

    source: str = setting(
        "disc",
        "`disc`: uniform over the area of a disc around the array. `sweep`: once round and again, clockwise "
        "from ahead, at a fixed range.",
        choices=("disc", "sweep"),
    )
    range_m: float = setting(
        100.0, "Radius of the disc, or range of the sweep.", unit="m", least=0.5, most=10000
    )
    step_deg: float = setting(0.1, "Step of the sweep.", unit="degrees", least=0.001, most=180)
    height_m: float = setting(
        0.0, "Height of the array above the source; the paper's is 0.", unit="m", least=0, most=1000
    )
    height_span_m: float = setting(
        0.0, "The height is drawn from height_m to this much above, uniform.", unit="m", least=0, most=1000
    )
    position_error_m: float = setting(
        0.001,
        "Each microphone is off its place by up to this along x and y, uniform, anew for every sample.",
        unit="m",
        least=0,
        most=0.1,
    )
    rounding: str = setting(
        "nearest",
        "How an arrival becomes a sample number: the nearest one, the last one before it, or not at all.",
        choices=("nearest", "floor", "none"),
    )
    phase: str = setting(
        "common",
        "Where the sampling instants lie. `aligned`: the call begins on one, for all microphones. `common`: "
        "at random, the same for all microphones. `each`: at random for each microphone by itself, and not "
        "known: converters that do not share a clock, up to a sample of skew.",
        choices=("aligned", "common", "each"),
    )
    offset_samples: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "Fixed delay of each microphone's channel, as a share of a sample.",
        unit="samples",
        least=-100,
        most=100,
    )
    clock_ppm: float = setting(
        0.0,
        "Each microphone's clock, started when the call began, is off by up to this, uniform, anew for every "
        "sample.",
        unit="ppm",
        least=0,
        most=10000,
    )
    noise: str = setting(
        "none",
        "Gaussian error of each arrival before rounding. `fixed`: noise_us. `snr`: what the Cramer-Rao bound "
        "leaves at snr_db in one frame.",
        choices=("none", "fixed", "snr"),
    )
    noise_us: float = setting(3.0, "1-sigma with noise = fixed.", unit="us", least=0, most=10000)
    snr_db: float = setting(10.0, "In-band SNR with noise = snr.", unit="dB", least=-60, most=80)


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """What the array measured and what was true; one column per sample, pairs in the array's order.

    The first mics - 1 pairs are those against the base microphone, number 0.
    """

    delay_s: F32
    """(pairs, samples) measured t_j - t_i"""
    true_delay_s: F32
    """(pairs, samples) the same of the sound itself, at the microphones' displaced places"""
    position_m: F32
    """(2, samples) source x and y from the middle of the array, body axes"""
    azimuth_rad: F32
    """(samples,) -pi to pi"""


def draw(
    array: MicArray,
    speed_m_s: float,
    rate_hz: float,
    twin: TwinSettings,
    noise_s: float,
    count: int,
    seed: int,
    first: int = 0,
) -> Arrivals:
    """Samples `first` to `first + count` of a seed's endless row, at `rate_hz` samples a second.

    `noise_s` is the 1-sigma of each arrival. Same arguments, same bytes (with the same numpy on the same
    kind of processor).
    """
    pairs = len(array.pairs)
    measured = np.empty((pairs, count), np.float32)
    true = np.empty((pairs, count), np.float32)
    position = np.empty((2, count), np.float32)
    azimuth = np.empty(count, np.float32)
    places = array.positions_m - array.positions_m.mean(axis=0)
    end = first + count
    for number in range(first // BLOCK, -(-end // BLOCK)):
        start = number * BLOCK
        begin, stop = max(first, start), min(end, start + BLOCK)
        inside, outside = slice(begin - start, stop - start), slice(begin - first, stop - first)
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(number,))))
        at, angle, height = _sources(twin, start, rng)
        later_m = _later_m(places, twin, at, height, rng)
        recorded = _recorded(later_m, at, height, speed_m_s, rate_hz, twin, noise_s, rng)
        for row, (i, j) in enumerate(array.pairs):
            np.subtract(recorded[j, inside], recorded[i, inside], out=measured[row, outside])
            np.subtract(later_m[j, inside], later_m[i, inside], out=true[row, outside])
        position[:, outside] = at[:, inside]
        azimuth[outside] = angle[inside]
    measured *= np.float32(1.0 / rate_hz)
    true *= np.float32(1.0 / speed_m_s)
    return Arrivals(measured, true, position, azimuth)


def _sources(twin: TwinSettings, start: int, rng: np.random.Generator) -> tuple[F32, F32, F32]:
    """Places (2, BLOCK), azimuths (BLOCK,), and heights of the array above them (BLOCK,) or (1,)."""
    if twin.source == "sweep":
        steps = max(round(360.0 / twin.step_deg), 1)
        degrees = (np.arange(start, start + BLOCK) % steps) * (360.0 / steps)
        angle = np.radians((degrees + 180.0) % 360.0 - 180.0).astype(np.float32)
        radius = np.full(BLOCK, twin.range_m, np.float32)
    else:
        uniform = rng.random((2, BLOCK), dtype=np.float32)
        angle = (uniform[0] - np.float32(0.5)) * np.float32(2.0 * math.pi)
        radius = np.sqrt(uniform[1]) * np.float32(twin.range_m)  # the area inside r grows with r^2
    height = np.full(1, twin.height_m, np.float32)
    if twin.height_span_m:
        height = height + np.float32(twin.height_span_m) * rng.random(BLOCK, dtype=np.float32)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)]), angle, height


def _later_m(places: F64, twin: TwinSettings, at: F32, height: F32, rng: np.random.Generator) -> F32:
    """How much longer the way to each microphone is than to the array's middle, metres (mics, BLOCK).

    |s - p| - |s| = (|p|^2 - 2 p.s) / (|s - p| + |s|), in which nothing large is subtracted: single precision
    is good to 10 nm at 100 m, where the difference of two distances would be good to 10 um.
    """
    x, y = at
    direct = x * x + y * y + height * height
    middle = np.sqrt(direct)
    later = np.empty((len(places), BLOCK), np.float32)
    error = np.float32(2.0 * twin.position_error_m)
    for m, (nominal_x, nominal_y, z) in enumerate(places.astype(np.float32)):
        if error:
            shift = rng.random((2, BLOCK), dtype=np.float32)
            shift -= np.float32(0.5)
            shift *= error
            mic_x, mic_y = shift[0] + nominal_x, shift[1] + nominal_y
        else:
            mic_x, mic_y = np.full((2, BLOCK), [[nominal_x], [nominal_y]], np.float32)
        # |p|^2 - 2 p.s as p.(p - 2 s)
        gain = mic_x * (mic_x - 2 * x)
        gain += mic_y * (mic_y - 2 * y)
        gain += z * (z - 2 * height)
        np.divide(gain, np.sqrt(direct + gain) + middle, out=later[m])
    return later


def _recorded(
    later_m: F32,
    at: F32,
    height: F32,
    speed_m_s: float,
    rate_hz: float,
    twin: TwinSettings,
    noise_s: float,
    rng: np.random.Generator,
) -> F32:
    """Sample numbers (mics, BLOCK) at which the microphones hear, from an origin common to all of them."""
    number = later_m * np.float32(rate_hz / speed_m_s)
    if noise_s > 0.0:
        number += rng.standard_normal(number.shape, dtype=np.float32) * np.float32(noise_s * rate_hz)
    if any(twin.offset_samples):
        number += np.array(twin.offset_samples, dtype=np.float32)[:, None]
    if twin.clock_ppm > 0.0:
        wrong = rng.random(number.shape, dtype=np.float32) - np.float32(0.5)
        wrong *= np.float32(2e-6 * twin.clock_ppm)
        number += wrong * _travel_samples(at, height, rate_hz / speed_m_s).astype(np.float32)
    if twin.rounding == "none":
        return number
    if twin.phase == "aligned":
        number += np.modf(_travel_samples(at, height, rate_hz / speed_m_s))[0].astype(np.float32)
        phase: F32 = np.zeros(1, np.float32)
    else:
        phase = rng.random((1 if twin.phase == "common" else len(number), BLOCK), dtype=np.float32)
        number += phase
    np.add(number, np.float32(0.5 if twin.rounding == "nearest" else 0.0), out=number)
    np.floor(number, out=number)
    return number


def _travel_samples(at: F32, height: F32, samples_per_m: float) -> F64:
    """Travel time to the array's middle in samples, in double precision: it may be 10,000 samples."""
    x, y = at.astype(np.float64)
    samples: F64 = np.sqrt(x * x + y * y + height.astype(np.float64) ** 2) * samples_per_m
    return samples
