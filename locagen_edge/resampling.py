"""A stream at one rate from a stream at another: a polyphase filter in the kernel.

Linear phase (a windowed sinc; Oppenheim & Schafer, *Discrete-Time Signal Processing*, section 7.5: Kaiser),
so a sample waits for half of the filter, 4.8 ms from 48 kHz to 10 kHz, and no longer: resamplers of libraries
work in blocks (soxr's hold sound back for 12 to 75 ms, and let frames come in twos). Nothing is shifted:
output sample k belongs to time k / rate_out, so time needs no correction. All microphones share one filter
and one phase, so no delay between them is made up.

Up to 0.94 of the lower rate's Nyquist frequency sound passes, within 0.004 %; what is folded in from beyond
lies above that, and above any band that is listened to by default.

A sample that is not finite spoils the filter's length of its own microphone (9.6 ms from 48 kHz) and nothing
else.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from locagen_edge import kernel
from locagen_edge.errors import SourceError
from locagen_edge.types import F32

PASS = 0.94
"""of the lower Nyquist frequency; by as much above it, all has been taken away"""
ATTENUATION_DB = 90.0
"""The converter's noise is no farther down."""
MOST_TAPS = 8_000_000
"""32 MB. 44.1 kHz and 10 kHz take 37 thousand, 44,101 Hz and 10 kHz 4.6 million."""
AT_ONCE = 64


class Resampler:
    """Rows (n, mics) float32 at `rate_in` to rows at `rate_out`; how they are cut does not show.

    Raises `SourceError` for rates whose ratio takes numbers too large to be kept.
    """

    def __init__(self, rate_in: float, rate_out: float, mics: int) -> None:
        ratio = Fraction(rate_out) / Fraction(rate_in)
        self._up, self._down = ratio.numerator, ratio.denominator
        self._same = ratio == 1
        cutoff = min(float(ratio), 1.0)
        self._half = 0 if self._same else _half(cutoff)
        if self._up * 2 * self._half > MOST_TAPS:
            raise SourceError(
                f"{rate_in:g} Hz cannot be made {rate_out:g} Hz (audio.rate_hz): the two have too little in "
                "common; choose a rate that shares a larger divisor"
            )
        self._table = _filters(self._up, self._half, cutoff)
        self._mics = mics
        self.clear()

    def clear(self) -> None:
        """Forget what is inside: the next row begins a new stream."""
        self._at = 0  # of the next row out: in 1 / up samples from the first held one
        self._taken = self._given = 0
        self._held: F32 = np.zeros((self._mics, max(self._half - 1, 0)), dtype=np.float32)

    def push(self, rows: F32) -> F32:
        """The rows that are ready by now: (m, mics)."""
        self._taken += len(rows)
        if self._same:
            self._given += len(rows)
            return rows
        held = np.concatenate([self._held, rows.T], axis=1, dtype=np.float32)
        # rows begin at places below this
        end = (held.shape[1] - 2 * self._half + 1) * self._up
        count = max(-(-(end - self._at) // self._down), 0)
        ready = kernel.resample(self._table, self._up, self._down, self._at, held, count)
        gone, self._at = divmod(self._at + count * self._down, self._up)
        self._held = held[:, gone:].copy()
        self._given += count
        return ready

    def missing(self, rows_out: int) -> int:
        """How many more rows have to come in until so many more come out."""
        if self._same:
            return rows_out
        last = (self._at + (rows_out - 1) * self._down) // self._up
        return max(last + 2 * self._half - len(self._held[0]), 0)

    def flush(self, rows: F32) -> F32:
        """The last rows, and all that is still inside. Afterwards a new stream may begin."""
        ready = self.push(rows)
        left = -(-self._taken * self._up // self._down) - self._given
        if left > 0:
            silence = np.zeros((self.missing(left), self._mics), dtype=np.float32)
            ready = np.concatenate([ready, self.push(silence)[:left]])
        self.clear()
        return ready


def _half(cutoff: float) -> int:
    """Taps to each side: what Kaiser's formula asks for at this attenuation, samples in."""
    width = 2.0 * (1.0 - PASS) * cutoff * math.pi  # of the transition, radians a sample
    taps = math.ceil((ATTENUATION_DB - 7.95) / (2.285 * width)) + 1
    return math.ceil(taps / kernel.TAPS) * kernel.TAPS // 2


def _filters(up: int, half: int, cutoff: float) -> F32:
    """(up, 2 * half): the filter as it stands for a sample out that lies phase / up after one in."""
    beta = 0.1102 * (ATTENUATION_DB - 8.7)
    table: F32 = np.empty((up, 2 * half), dtype=np.float32)
    for first in range(0, up, AT_ONCE):  # of odd rates there are many
        phases = np.arange(first, min(first + AT_ONCE, up))
        behind = np.arange(1 - half, half + 1) - phases[:, np.newaxis] / up  # samples in
        inside = np.sqrt(np.maximum(1.0 - (behind / max(half, 1)) ** 2, 0.0))
        filters = np.sinc(cutoff * behind) * np.i0(beta * inside)
        table[phases] = filters / filters.sum(axis=1, keepdims=True)
    return table
