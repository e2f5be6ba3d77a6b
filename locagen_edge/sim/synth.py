"""Signals from which calls and rotors are made: band-limited noise, periodic waves, pieces joined."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from locagen_edge.types import F64, Array

TABLE = (
    4096  # points of a wavetable; linear interpolation errs by (pi k / TABLE)^2 / 2: -75 dB at harmonic 24
)


def band_noise(
    n: int, rate_hz: float, low_hz: float, high_hz: float, rng: np.random.Generator, slope: float = 0.0
) -> F64:
    """Gaussian noise (n,) of mean square 1 on average, with nothing outside `low_hz` to `high_hz`.

    Its power falls as frequency ** -slope above 1 kHz.
    """
    size = 1 << max(n - 1, 255).bit_length()  # a power of two is the fastest; what is too much is cut off
    frequency = np.fft.rfftfreq(size, 1.0 / rate_hz)
    inside = np.flatnonzero((frequency >= low_hz) & (frequency <= high_hz))
    gain = np.maximum(frequency[inside] / 1000.0, 1.0) ** (-slope / 2.0)
    spectrum = np.zeros(len(frequency), dtype=np.complex128)
    spectrum[inside] = gain * rng.standard_normal((len(inside), 2)).view(np.complex128)[:, 0]
    noise: F64 = np.fft.irfft(spectrum, size)[:n]
    scale = size / (2.0 * float(np.sqrt(np.sum(gain**2))))
    return scale * noise


def wavetable(amplitudes: Array, rng: np.random.Generator) -> F64:
    """One period (TABLE + 1,) of harmonics 1, 2, ... with these amplitudes and random phases."""
    spectrum = np.zeros(TABLE // 2 + 1, dtype=np.complex128)
    phases = rng.uniform(0.0, 2.0 * np.pi, len(amplitudes))
    spectrum[1 : len(amplitudes) + 1] = 0.5 * TABLE * np.asarray(amplitudes) * np.exp(1j * phases)
    period = np.fft.irfft(spectrum, TABLE)
    return np.append(period, period[0])


def wave(table: F64, turns: F64) -> F64:
    """The periodic wave at these phases, in turns: one period per turn."""
    at = (turns - np.floor(turns)) * TABLE
    index = at.astype(np.intp)
    left = table[index]
    value: F64 = left + (at - index) * (table[index + 1] - left)
    return value


def turns_of(frequency_hz: F64, rate_hz: float) -> F64:
    """Phase in turns of an oscillator that runs at these instantaneous frequencies (n,)."""
    return np.cumsum(frequency_hz) / rate_hz


def glide(points: Array, n: int) -> F64:
    """(n,): a smooth way through `points`, evenly spaced in time."""
    at = np.linspace(0.0, len(points) - 1.0, n)
    step = np.minimum(at.astype(np.intp), len(points) - 2)
    ease = 0.5 - 0.5 * np.cos(np.pi * (at - step))
    points = np.asarray(points, dtype=np.float64)
    way: F64 = points[step] + ease * (points[step + 1] - points[step])
    return way


def joined(pieces: Iterable[F64], overlap: int) -> Iterator[F64]:
    """One sound from pieces, each cross-faded into the next over `overlap` samples at constant power.

    Begins with a fade-in and, when the pieces end, ends with a fade-out; total length is that of the pieces
    less `overlap` for each seam. Every piece is at least twice as long as the overlap.
    """
    rise = np.sin(0.5 * np.pi * (np.arange(overlap) + 0.5) / overlap)
    tail = np.zeros(overlap)
    for piece in pieces:
        tail += piece[:overlap] * rise
        yield np.concatenate([tail, piece[overlap:-overlap]])
        tail = piece[-overlap:] * rise[::-1]
    yield tail
