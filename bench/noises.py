"""Rotor noise of every kind at an array, for the benchmarks: simulated, hunting, and recorded.

Each maker gives (mics, samples) at the processing rate with an in-band power of 1 per microphone. The
recorded kinds need the folder of recorded sounds, from LOCAGEN_RECORDINGS or beside the project.
"""

from __future__ import annotations

import csv
import itertools
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile
import soxr
from report import ROOT

from locagen_edge.sim.levels import band_power, from_db
from locagen_edge.sim.propagation import place
from locagen_edge.sim.rotors import hubs_m, rotor
from locagen_edge.types import F64

RATE = 10_000
SPEED_M_S = 343.2
ARM_M = 0.3
SENSOR_DB = -10.0
FADE_S = 1.0  # recordings are joined so slowly that the joint is no event
SWING = 0.1  # relative change of a hunting rotor's speed in a second
CRAZYFLIE_M = [[0.055, -0.055, 0.0], [0.055, 0.055, 0.0], [-0.055, 0.055, 0.0]]

Maker = Callable[[float, F64, int, np.random.Generator], F64]
"""seconds, positions (mics, 3), number of the stream, generator -> (mics, samples)"""


def recordings() -> Path | None:
    folder = Path(os.environ.get("LOCAGEN_RECORDINGS", ROOT.parent / "shared" / "data" / "audio"))
    return folder if (folder / "MANIFEST.csv").exists() else None


def _unit(noise: F64) -> F64:
    scaled: F64 = noise / math.sqrt(np.mean([band_power(row, RATE) for row in noise]))
    return scaled


def _hiss(noise: F64, rng: np.random.Generator) -> F64:
    return _unit(_unit(noise) + 10 ** (SENSOR_DB / 20) * rng.standard_normal(noise.shape))


def rotor_of(samples: int, throttle: float, rng: np.random.Generator) -> F64:
    """(samples,) of one rotor."""
    pieces = rotor(throttle, RATE, 0.48 * RATE, rng)
    made = list(itertools.islice(pieces, math.ceil(samples / 7000) + 1))
    return np.concatenate(made)[:samples]


def steady(seconds: float, positions: F64, number: int, rng: np.random.Generator) -> F64:
    """Four rotors that hover, at 30, 50 or 70 % of throttle."""
    samples, throttle = round(seconds * RATE), (0.3, 0.5, 0.7)[number % 3]
    noise = sum(
        place(rotor_of(samples, throttle, rng), RATE, positions, hub, SPEED_M_S) for hub in hubs_m(4, ARM_M)
    )
    return _hiss(np.asarray(noise), rng)


def hunting(seconds: float, positions: F64, number: int, rng: np.random.Generator) -> F64:
    """The same, each rotor's speed up and down by 10 % a second, for 1 to 3.5 s at a time."""
    samples = round(seconds * RATE)
    time_s = np.arange(samples) / RATE
    noise = np.zeros((len(positions), samples))
    for hub in hubs_m(4, ARM_M):
        period_s = (2.0, 3.0, 5.0)[number % 3] * rng.uniform(0.7, 1.4)
        zigzag = 4.0 * np.abs((time_s / period_s + rng.uniform()) % 1.0 - 0.5) - 1.0  # slope 4 / period
        speed = np.exp(SWING * period_s / 4.0 * zigzag)
        at = np.cumsum(speed)
        sound = rotor_of(math.ceil(at[-1]) + 1, 0.5, rng)
        # thrust, and with it power, goes with a high power of the speed
        noise += place(
            np.interp(at, np.arange(len(sound)), sound) * speed**2.5, RATE, positions, hub, SPEED_M_S
        )
    return _hiss(noise, rng)


def _endless(sound: F64, samples: int, rng: np.random.Generator) -> F64:
    """(channels, any) -> (channels, samples): again and again, joined by slow cross-fades."""
    fade = round(FADE_S * RATE)
    ramp = np.sin(np.linspace(0.0, np.pi / 2.0, fade))
    piece = sound.copy()
    piece[:, :fade] *= ramp
    piece[:, -fade:] *= ramp[::-1]
    step = sound.shape[1] - fade
    out = np.zeros((len(sound), samples + 2 * sound.shape[1]))
    for start in range(0, samples + sound.shape[1], step):
        out[:, start : start + sound.shape[1]] += piece
    begin = int(rng.integers(fade, sound.shape[1]))
    return out[:, begin : begin + samples]


def four_microphones(seconds: float, _: F64, __: int, rng: np.random.Generator) -> F64:
    """Recorded on a flying frame: four propellers, each from a file of its own, three of four microphones."""
    folder = recordings()
    assert folder is not None
    noise = np.zeros((3, round(seconds * RATE)))
    for motor in range(1, 5):
        sound, rate = soundfile.read(folder / f"array/crazyflie_m{motor}_4ch.flac", dtype="float64")
        sound = soxr.resample(sound[2400:, :3], rate, RATE).T  # 0.05 s of zeros at the start
        noise += _endless(sound, noise.shape[1], rng) * 10 ** (rng.uniform(-1.5, 1.5) / 20)
    return _unit(noise)


def one_microphone(seconds: float, positions: F64, number: int, rng: np.random.Generator) -> F64:
    """Recorded propellers at fixed throttle, other parts of one recording at each of four hubs."""
    folder = recordings()
    assert folder is not None
    with (folder / "MANIFEST.csv").open(newline="") as file:
        paths = sorted(row["path"] for row in csv.DictReader(file) if "cfprop" in row["path"])
    sound, rate = soundfile.read(folder / paths[number % len(paths)], dtype="float64")
    sound = soxr.resample(sound, rate, RATE)[np.newaxis]
    samples = round(seconds * RATE)
    noise = sum(
        place(_endless(sound, samples, rng)[0], RATE, positions, hub, SPEED_M_S) for hub in hubs_m(4, ARM_M)
    )
    return _hiss(np.asarray(noise), rng)


NOISES: dict[str, Maker] = {
    "steady": steady,
    "hunting": hunting,
    "recorded, four microphones": four_microphones,
    "recorded, one microphone": one_microphone,
}
RECORDED = ("recorded, four microphones", "recorded, one microphone")


def positions_of(name: str, usual: F64) -> F64:
    """The array at which a kind of noise is heard."""
    return np.array(CRAZYFLIE_M) if name == "recorded, four microphones" else usual


def mixed(noise: F64, call: F64, start_s: float, snr_db: float) -> F64:
    """Noise with a call (mics, any) from start_s on, at an in-band SNR while it calls."""
    at = round(start_s * RATE)
    power = np.mean([band_power(row, RATE) for row in call])
    total = noise.copy()
    total[:, at : at + call.shape[1]] += call * math.sqrt(from_db(snr_db) / power)
    return total
