"""From a place in the air to the microphones: delays exact to a small part of a sample, and spreading.

Two ways, because two things are wanted:
- `place` and `plane_wave` turn the phase of every frequency: exact to rounding, for a source that stands
  still and a signal that is all there;
- `interpolate` reads a signal at any moments by a windowed sinc (Laakso et al., "Splitting the unit
  delay", IEEE Signal Processing Magazine 13 (1996) 30-60): for a source that moves, block by block.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from locagen_edge.types import F32, F64, Array

TAPS = 16
REACH = TAPS // 2
"""samples that `interpolate` needs on either side"""
PHASES = 16384  # delays fall on a grid of 1/16384 sample: 3 ns at 20 kHz
# Kaiser's window for 90 dB over 16 taps has its transition from half of the Nyquist frequency to one and a
# half of it: a signal that keeps below half, being held at twice the rate at which it is heard, passes whole.
BETA = 9.0


def paths(positions_m: F64, source_m: F64, speed_m_s: float) -> tuple[F64, F64]:
    """Delays in seconds and gains from sources (..., 3) to microphones (mics, 3): both (..., mics).

    The gain is that of a point source in the free field, 1 / r, 1.0 at 1 m.
    """
    distance_m = np.linalg.norm(positions_m - np.asarray(source_m)[..., np.newaxis, :], axis=-1)
    return distance_m / speed_m_s, 1.0 / distance_m


def delayed(signal: Array, delay: F64) -> F64:
    """A signal (n,) delayed by each of (k,) samples, whole or not, negative too: (k, n).

    Exact for a signal that is zero near its ends; what is moved beyond an end is cut off, nothing wraps.
    """
    n = len(signal)
    longest = math.ceil(np.max(np.abs(delay), initial=0.0))
    size = 1 << (n + longest + 1024).bit_length()  # the sinc's tails die out in the padding
    frequency = np.fft.rfftfreq(size)
    turn = np.exp(-2j * np.pi * np.multiply.outer(delay, frequency))
    moved: F64 = np.fft.irfft(np.fft.rfft(signal.astype(np.float64), size) * turn, size)[:, :n]
    return moved


def place(signal: Array, rate_hz: float, positions_m: F64, source_m: F64, speed_m_s: float) -> F64:
    """A signal (n,) from a point source at (3,), as the microphones (mics, 3) hear it: (mics, n).

    Time and level are those of the origin: what a microphone there would hear is `signal` itself. Delays
    and 1 / r follow the true distances, so near sources have their curved wave.
    """
    delay_s, gain = paths(positions_m, source_m, speed_m_s)
    range_m = float(np.linalg.norm(source_m))
    return delayed(signal, (delay_s - range_m / speed_m_s) * rate_hz) * (gain * range_m)[:, np.newaxis]


def plane_wave(signal: Array, rate_hz: float, positions_m: F64, u: F64, speed_m_s: float) -> F64:
    """The same from the direction of the unit vector u (3,), infinitely far: (mics, n)."""
    return delayed(signal, -(positions_m @ u) / speed_m_s * rate_hz)


@cache
def _kernels() -> F32:
    """(PHASES + 1, TAPS): row p reads the signal p / PHASES after the tap number TAPS / 2 - 1."""
    fraction = np.arange(PHASES + 1)[:, np.newaxis] / PHASES
    at = np.arange(TAPS) - (TAPS // 2 - 1) - fraction
    window = np.i0(BETA * np.sqrt(np.maximum(0.0, 1.0 - (at / (TAPS / 2)) ** 2))) / np.i0(BETA)
    return (np.sinc(at) * window).astype(np.float32)


def interpolate(signal: F32, at: F64) -> F32:
    """The signal (n,) at the fractional sample numbers `at`, each from REACH - 1 to n - 1 - REACH.

    The error is below -80 dB where the signal keeps below half of its Nyquist frequency.
    """
    index = np.floor(at).astype(np.intp)
    phase = np.rint((at - index) * PHASES).astype(np.intp)
    windows = np.lib.stride_tricks.sliding_window_view(signal, TAPS)
    read: F32 = np.einsum("...t,...t->...", windows[index - (REACH - 1)], _kernels()[phase])
    return read


def interpolate_steadily(signal: F32, first: F64, step: int, n: int) -> F32:
    """The same at first (k,), first + step, ...: (k, n). A delay that stands still needs one kernel only."""
    index = np.floor(first).astype(np.intp)
    phase = np.rint((first - index) * PHASES).astype(np.intp)
    windows = np.lib.stride_tricks.sliding_window_view(signal, TAPS)
    starts = index - (REACH - 1)
    read = [windows[s : s + step * n : step] @ _kernels()[p] for s, p in zip(starts, phase, strict=True)]
    return np.stack(read)
