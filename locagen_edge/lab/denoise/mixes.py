"""Mixes on the fly: pools of altered clips, put together anew for every step.

A clip of noise is the drone just before the call, which gives its spectrum, and under it. What is altered:
speed (blade rate), colour, slow loudness, another drone or background added; of calls speed, colour and an
echo. So few recordings become many drones, of which none is like the one that will fly, and that is the
point.

SNR: mean square of call over that of noise, over the clip, both high-passed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from locagen_edge.lab.denoise.sounds import Corpus
from locagen_edge.lab.settings import LabSettings
from locagen_edge.stages.denoise import STEP, WINDOW, window
from locagen_edge.types import F32, F64

MICS = 3
"""A mask is made of the mean over microphones, whose noise agrees less than their calls: half of the mixes
have it so, half have one microphone's."""
REPLACED = 3
"""clips of each pool that are new in each step"""
NO_CALL = 0.04
"""share of mixes without a call"""


@dataclass(frozen=True, eq=False)
class Batch:
    """Mixes, mean square of the noise 1 before `level`."""

    mixture: torch.Tensor
    """(batch, MICS, n)"""
    call: torch.Tensor
    """(batch, n): zeros where nothing calls"""
    reference: torch.Tensor
    """(batch, MICS, WINDOW / 2 + 1) mean power spectrum of the noise before"""


class Mixer:
    """An endless source of batches from one part of the sounds."""

    def __init__(self, s: LabSettings, sounds: Corpus, seed: int, pool: int, alter: float = 1.0) -> None:
        self._s = s
        self._sounds = sounds
        self._rng = np.random.default_rng([s.mixes.seed, seed])
        self._alter = alter  # of the noise: 1 makes other drones of it, 0 leaves it as it is
        self._n = length(s)
        self._before = round(s.mixes.before_s * s.audio.rate_hz)
        self._classes = sorted(sounds.calls)
        self._drones = list(sounds.drones.values())
        self._calls = [self._call() for _ in range(pool)]
        self._noise = [self._drone() for _ in range(pool)]

    def batch(self, count: int) -> Batch:
        """So many mixes, and some clips of the pools made new."""
        rng = self._rng
        for _ in range(REPLACED):
            self._calls[rng.integers(len(self._calls))] = self._call()
            self._noise[rng.integers(len(self._noise))] = self._drone()
        calls = np.stack([self._calls[k] for k in rng.integers(len(self._calls), size=count)])
        low, high = self._s.mixes.snr_db
        calls *= 10.0 ** (rng.uniform(low, high, size=(count, 1)).astype(np.float32) / 20.0)
        calls[rng.random(count) < NO_CALL] = 0.0
        chosen = [self._noise[k] for k in rng.integers(len(self._noise), size=count)]
        mixture = calls[:, None] + np.stack([noise for noise, _ in chosen])
        reference = np.stack([reference for _, reference in chosen])
        return Batch(torch.from_numpy(mixture), torch.from_numpy(calls), torch.from_numpy(reference))

    def _call(self) -> F32:
        """(n,) of mean square 1."""
        rng, n = self._rng, self._n
        sounds = self._sounds.calls[self._classes[rng.integers(len(self._classes))]]
        while True:
            sound: F64 = sounds[rng.integers(len(sounds))].astype(np.float64)
            sound = coloured(faster(sound, np.exp(rng.uniform(-0.2, 0.2))), 5.0, rng)
            delay = rng.integers(50, 1500)
            if rng.random() < 0.3 and delay < len(sound):
                sound[delay:] += rng.uniform(0.1, 0.5) * sound[:-delay]
            sound = placed(sound, n, rng)
            power = np.mean(sound**2)
            if power > 1e-9:
                call: F32 = (sound / np.sqrt(power)).astype(np.float32)
                return call

    def _drone(self) -> tuple[F32, F32]:
        """(MICS, n) of mean square 1, and the power spectrum (MICS, bins) of what was before it."""
        rng, alter = self._rng, self._alter
        noise = self._cut(self._drones)
        if rng.random() < 0.25 * alter:
            noise += 10.0 ** rng.uniform(-1.0, 0.0) * self._cut(self._drones)
        if self._sounds.background and rng.random() < 0.3 * alter:
            noise += 10.0 ** rng.uniform(-1.2, -0.2) * self._cut(self._sounds.background)
        swing_db = alter * rng.normal(0.0, 1.0, 7)
        swing_db = np.interp(np.arange(len(noise)), np.linspace(0, len(noise), 7), swing_db)
        noise = coloured(noise, 6.0 * alter, rng) * 10.0 ** (swing_db / 20.0)
        shifts = rng.integers(300, 3000, MICS) * (rng.random() < 0.5)
        shifts[0] = 0
        mics = np.stack([np.roll(noise, shift) for shift in shifts])
        mics /= np.sqrt(np.mean(mics[0, self._before :] ** 2)) + 1e-12
        first = int(rng.uniform(0.0, 0.6) * self._before)
        reference = power_spectra(mics[:, first : self._before]).mean(axis=1)
        return mics[:, self._before :].astype(np.float32), reference.astype(np.float32)

    def _cut(self, recordings: list[F32]) -> F64:
        """(before + n,) of one of them, of mean square 1; short ones are played forth and back."""
        rng, wanted = self._rng, self._before + self._n
        sound = recordings[rng.integers(len(recordings))]
        factor = np.exp(self._alter * rng.uniform(-0.25, 0.2))
        needed = int(wanted * factor) + 2
        while len(sound) < needed:
            sound = np.concatenate([sound, sound[::-1]])
        first = rng.integers(len(sound) - needed + 1)
        cut = faster(sound[first : first + needed].astype(np.float64), factor)[:wanted]
        sign = rng.choice([-1.0, 1.0])
        return np.asarray(sign * cut / np.sqrt(np.mean(cut**2) + 1e-20))


def length(s: LabSettings) -> int:
    """Samples of a clip: whole steps."""
    return (round(s.mixes.clip_s * s.audio.rate_hz) // STEP + 1) * STEP


def power_spectra(sound: F64) -> F64:
    """(..., n) to (..., spectra, WINDOW / 2 + 1), as they are made in flight."""
    pieces = np.lib.stride_tricks.sliding_window_view(sound, WINDOW, axis=-1)[..., ::STEP, :]
    power: F64 = np.abs(np.fft.rfft(pieces * window())) ** 2
    return power


def faster(sound: F64, factor: float) -> F64:
    """The same played faster, and as much higher."""
    count = int((len(sound) - 1) / factor)
    played: F64 = np.interp(np.arange(count) * factor, np.arange(len(sound)), sound)
    return played


def coloured(sound: F64, swing_db: float, rng: np.random.Generator) -> F64:
    """Through a smooth filter without delay whose gain wanders by this much (standard deviation) over the
    band.
    """
    size = 1 << (len(sound) - 1).bit_length()
    gain_db = np.interp(
        np.linspace(0.0, 1.0, size // 2 + 1), np.linspace(0.0, 1.0, 8), rng.normal(0.0, swing_db, 8)
    )
    filtered: F64 = np.fft.irfft(np.fft.rfft(sound, size) * 10.0 ** (gain_db / 20.0), size)[: len(sound)]
    return filtered


def placed(sound: F64, n: int, rng: np.random.Generator) -> F64:
    """(n,): any piece of a long sound; a short one anywhere."""
    if len(sound) > n:
        first = rng.integers(len(sound) - n + 1)
        return sound[first : first + n]
    out = np.zeros(n)
    first = rng.integers(n - len(sound) + 1)
    out[first : first + len(sound)] = sound
    return out
