"""Sound for tests: plane waves and speech at known directions, with independent or recorded noise."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import soundfile
import soxr

from locagen_edge.geometry import MicArray, direction
from locagen_edge.settings import Settings
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.levels import band_power, from_db
from locagen_edge.sim.propagation import plane_wave
from locagen_edge.types import F32, F64, Frame


def heard(
    settings: Settings, azimuth: float, elevation: float, snr_db: float, samples: int, seed: int = 0
) -> F32:
    """(mics, samples) white sound from a direction at 0.05 full scale, noise of each microphone's own."""
    rng = np.random.default_rng(seed)
    rate_hz, guard = settings.audio.rate_hz, 64  # the delays' tails fall into the guard
    signal = CALLS["white"](samples + 2 * guard, rate_hz, 0.48 * rate_hz, rng)
    u = direction(azimuth, elevation)
    clean = plane_wave(signal, rate_hz, settings.mic_array.positions_m, u, settings.speed_m_s)
    clean = 0.05 * clean[:, guard:-guard] / np.std(clean)
    noise = rng.standard_normal(clean.shape)
    noise *= math.sqrt(band_power(clean[0], rate_hz) / from_db(snr_db) / band_power(noise[0], rate_hz))
    return (clean + noise).astype(np.float32)


def arrivals_s(array: MicArray, source_m: F64, speed_m_s: float) -> F64:
    """Travel times (mics,) from a point source at (3,) metres."""
    times: F64 = np.linalg.norm(array.positions_m - source_m, axis=1) / speed_m_s
    return times


def to_db(power: float) -> float:
    """Level in dB of a power ratio above zero."""
    return float(10.0 * np.log10(power))


def cut(settings: Settings, samples: F32) -> list[Frame]:
    """Frames of (mics, samples), the way every source cuts them."""
    audio = settings.audio
    return [
        Frame(
            samples[:, start : start + audio.frame].copy(),
            float(audio.rate_hz),
            round(start / audio.rate_hz * 1e9),
            start,
        )
        for start in range(0, samples.shape[1] - audio.frame + 1, audio.hop)
    ]


def speech_recording(recordings: Path, number: int, rate_hz: int) -> F64:
    """A recorded sentence, resampled."""
    with (recordings / "MANIFEST.csv").open(newline="") as file:
        paths = sorted(row["path"] for row in csv.DictReader(file) if row["label"] == "speech")
    signal, rate_in = soundfile.read(recordings / paths[number % len(paths)], dtype="float64")
    resampled: F64 = soxr.resample(signal, rate_in, rate_hz)
    return resampled


def rotor_recording(recordings: Path) -> F32:
    """Four propellers on a small frame, (4, samples) at 48 kHz: one motor per file, added."""
    parts = [
        soundfile.read(recordings / f"array/crazyflie_m{motor}_4ch.flac", dtype="float32")[0]
        for motor in (1, 2, 3, 4)
    ]
    length = min(len(part) for part in parts)
    summed: F32 = sum(part[2400:length] for part in parts).T  # type: ignore[attr-defined]  # 0.05 s of zeros
    return summed


RECORDED_ARRAY_M = [[0.055, -0.055, 0.0], [0.055, 0.055, 0.0], [-0.055, 0.055, 0.0]]
"""Microphones 1, 2 and 3 of those recordings, x forward and y right."""


def call_over_noise(
    settings: Settings, call: F64, noise: F32, rate_hz: int, start_s: float, azimuth: float, snr_db: float
) -> F64:
    """(mics, samples): a call from a direction, from start_s on, over noise; in-band SNR while it calls."""
    at = round(start_s * rate_hz)
    call = call[: noise.shape[1] - at]
    signal = np.zeros(noise.shape[1])
    signal[at : at + len(call)] = call
    positions = settings.mic_array.positions_m
    placed = plane_wave(signal, rate_hz, positions, direction(azimuth, -0.3), settings.speed_m_s)
    noise_power = np.mean([band_power(row.astype(np.float64), rate_hz) for row in noise])
    gain = math.sqrt(noise_power * from_db(snr_db) / band_power(call, rate_hz))
    mixed = noise[: len(positions)] + gain * placed
    scaled: F64 = 0.5 * mixed / np.abs(mixed).max()
    return scaled
