"""Channels made alike: each delayed by a fraction of a sample and scaled, as `locagen-edge calibrate` found.

A channel that comes late (another converter, a longer filter, a multiplexed card) turns every bearing, by a
degree per 7 us on a 10 cm array. It is mended here once, in the stream, before frames are cut: whatever comes
after, delays or spectra, profits without knowing of it.

The stream is read between its samples by a windowed sinc (Laakso et al., "Splitting the unit delay", IEEE
Signal Processing Magazine 13 (1996) 30-60). Sound comes out late by the filter's half (6 ms at 10 kHz), but
not shifted: output sample k is what the microphone heard at time k / rate, as with the resampler.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from locagen_edge.types import F32, F64

HALF = 64
"""Taps to each side. With BETA the passband ends 6 % below Nyquist (4.7 of 5 kHz)."""
BETA = 5.65
"""Kaiser's window for 60 dB."""


class Aligner:
    """Rows (n, mics) float32 to rows in which all channels hear a far, level, middling sound alike.

    Args:
        delays_s: by how much each channel is late, seconds (mics,); empty: none is.
        gains_db: by how much each channel is loud, dB (mics,); empty: all alike.
        rate_hz: of the rows.

    How the rows are cut does not show. A sample that is not finite spoils the filter's length of its own
    channel and nothing else.
    """

    def __init__(
        self, delays_s: Sequence[float], gains_db: Sequence[float], rate_hz: float, mics: int
    ) -> None:
        shift = np.array(delays_s if len(delays_s) else np.zeros(mics)) * rate_hz
        self._scale = 10.0 ** (-np.array(gains_db if len(gains_db) else np.zeros(mics)) / 20.0)
        self._reach = HALF + math.ceil(np.abs(shift).max()) if np.any(shift) else 0
        self._filters = [s * _fractional(d, self._reach) for s, d in zip(self._scale, shift, strict=True)]
        self._mics = mics
        self.clear()

    def clear(self) -> None:
        """Forget what is inside: the next row begins a new stream."""
        self._held: F32 = np.zeros((self._reach, self._mics), dtype=np.float32)

    def push(self, rows: F32) -> F32:
        """The rows that are ready by now: (m, mics)."""
        if not self._reach:
            return rows if np.all(self._scale == 1.0) else (rows * self._scale).astype(np.float32)
        held = np.concatenate([self._held, rows])
        keep = 2 * self._reach
        self._held = held[-keep:] if len(held) >= keep else held
        if len(held) <= keep:
            return np.empty((0, self._mics), dtype=np.float32)
        ready = [np.convolve(held[:, m], taps, mode="valid") for m, taps in enumerate(self._filters)]
        return np.stack(ready, axis=1).astype(np.float32)

    def missing(self, rows_out: int) -> int:
        """How many more rows have to come in until so many more come out."""
        return rows_out + 2 * self._reach - len(self._held)

    def flush(self, rows: F32) -> F32:
        """The last rows, and all that is still inside. Afterwards a new stream may begin."""
        end = np.zeros((self._reach, self._mics), dtype=np.float32)
        ready = self.push(np.concatenate([rows, end]))
        self.clear()
        return ready


def _fractional(shift: float, reach: int) -> F64:
    """Taps (2 reach + 1,) for np.convolve that read a signal `shift` samples later; reach 0: one tap of 1."""
    at = np.arange(reach, -reach - 1, -1) - shift
    window = np.i0(BETA * np.sqrt(np.maximum(0.0, 1.0 - (at / HALF) ** 2))) / np.i0(BETA)
    taps: F64 = np.sinc(at) * np.where(np.abs(at) < HALF, window, 0.0)
    return taps
