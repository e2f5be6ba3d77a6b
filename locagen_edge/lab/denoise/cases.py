"""The mixes by which denoisers are judged: recordings and drones that no training heard, the same for every
method.

Each case is noise alone and then noise with a call in it; the same case at every SNR. `with_array` gives it
the geometry of an array, for bearings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatch

import numpy as np

from locagen_edge.errors import DatasetError
from locagen_edge.geometry import MicArray
from locagen_edge.lab.denoise.mixes import length, placed
from locagen_edge.lab.denoise.sounds import corpus, is_held_out, own_parts, recordings
from locagen_edge.lab.settings import LabSettings
from locagen_edge.stages.denoise import CHUNK
from locagen_edge.types import F32, F64

LONGEST_CALL = 20
"""Pieces of a recording among which the loudest counts: a caller who is silent cannot be found."""


@dataclass(frozen=True, eq=False)
class Case:
    """A call under a drone, apart: mean squares over the clip are both 1."""

    kind: str
    """class of the call"""
    drone: str
    before: F32
    """(CHUNK * k,) the drone alone"""
    noise: F32
    """(CHUNK * k,) the drone as it goes on"""
    call: F32
    """the same length"""

    def mixture(self, snr_db: float) -> tuple[F32, F32]:
        """(n,) noise alone and mixture in one, at -30 dBFS; (m,) the call in it, both ending together."""
        level = 10.0 ** (-30.0 / 20.0)
        call = self.call * np.float32(level * 10.0 ** (snr_db / 20.0))
        return np.concatenate([level * self.before, level * self.noise + call]).astype(np.float32), call


def cases(s: LabSettings, each: int) -> Iterator[Case]:
    """`each` of every class, the drones in turn."""
    drones = own_noise(s)
    calls = corpus(s, "test").calls
    names = list(drones)
    at = 0
    for kind in sorted(calls):
        rng = np.random.default_rng([s.mixes.seed, 99, *kind.encode()])
        order = rng.permutation(len(calls[kind]))
        for k in range(each):
            drone = names[at % len(names)]
            at += 1
            yield case(s, kind, drone, calls[kind][order[k % len(order)]], drones[drone], rng)


def own_noise(s: LabSettings) -> dict[str, list[F32]]:
    """By drone (the pattern that names it), the recordings, or ends of them, that even tuning never heard."""
    if not s.mixes.noise:
        return {name: [sound] for name, sound in corpus(s, "test").drones.items()}
    found = recordings(s)
    names = [name for name in found if any(fnmatch(name, pattern) for pattern in s.mixes.drones)]
    held = [name for k, name in enumerate(names) if is_held_out(s, name, k)]
    patterns = s.mixes.held_out or tuple(held)
    by_drone = {pattern: [found[name] for name in held if fnmatch(name, pattern)] for pattern in patterns}
    return {pattern.rstrip("*."): _judged_by(s, sounds) for pattern, sounds in by_drone.items() if sounds}


def _judged_by(s: LabSettings, sounds: list[F32]) -> list[F32]:
    """What tuning leaves; all of it where there is too little to tune on."""
    try:
        return own_parts(s, sounds)[1]
    except DatasetError:
        return sounds


def case(
    s: LabSettings, kind: str, drone: str, call: F32, noise: list[F32], rng: np.random.Generator
) -> Case:
    """The loudest part of a call anywhere in a clip, after a piece of noise."""
    n = length(s) // CHUNK * CHUNK
    before = round(s.mixes.before_s * s.audio.rate_hz) // CHUNK * CHUNK
    sound = noise[rng.integers(len(noise))]
    while len(sound) < before + n:
        sound = np.concatenate([sound, sound[::-1]])
    first = rng.integers(len(sound) - before - n + 1)
    sound = sound[first : first + before + n] / np.sqrt(
        np.mean(sound[first + before : first + before + n] ** 2) + 1e-20
    )
    clean = placed(loudest(call.astype(np.float64), n), n, rng)
    clean /= np.sqrt(np.mean(clean**2) + 1e-20)
    return Case(kind, drone, sound[:before], sound[before:], clean.astype(np.float32))


def loudest(sound: F64, n: int) -> F64:
    """The n samples of most power among LONGEST_CALL places, or all."""
    if len(sound) <= n:
        return sound
    firsts = np.linspace(0, len(sound) - n, LONGEST_CALL).astype(int)
    return max((sound[first : first + n] for first in firsts), key=lambda piece: float(np.sum(piece**2)))


def with_array(
    c: Case, array: MicArray, rate_hz: float, speed_m_s: float, azimuth_rad: float, snr_db: float,
    rng: np.random.Generator, coherence: float = 0.0,
) -> tuple[F32, F32]:  # fmt: skip
    """The case's mixture and call as an array hears them: (mics, n) and (mics, m), call from far away, level.

    The call's delays are exact (by phase). The noise of each microphone is another piece of the same drone,
    with `coherence` of it (0 to 1, of power) common to all: near rotors are nearly incoherent.
    """
    u = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    shifts_s = -(array.positions_m - array.positions_m.mean(axis=0)) @ u / speed_m_s
    size = 2 * len(c.call)
    frequency = np.fft.rfftfreq(size, 1.0 / rate_hz)
    turned = np.fft.rfft(c.call, size) * np.exp(-2j * np.pi * frequency * shifts_s[:, np.newaxis])
    calls = np.fft.irfft(turned, size)[:, : len(c.call)]
    noise = np.concatenate([c.before, c.noise])
    own = np.stack([np.roll(noise, k) for k in rng.integers(2000, len(noise) - 2000, array.mics)])
    noises = np.sqrt(coherence) * noise + np.sqrt(1.0 - coherence) * own
    mixtures, clean = [], []
    for mic in range(array.mics):
        at = len(c.before)
        mix, call = replace(c, before=noises[mic, :at], noise=noises[mic, at:], call=calls[mic]).mixture(
            snr_db
        )
        mixtures.append(mix)
        clean.append(call)
    return np.stack(mixtures), np.stack(clean)
