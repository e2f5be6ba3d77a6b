"""A stream at one rate from a stream at another: libsoxr, one state for all microphones.

soxr works in blocks, so what goes in comes out late, 12 to 33 ms from 48 kHz to 10 kHz, but not shifted: output
sample k belongs to time k / rate_out whatever the delay, so time needs no correction.
All microphones share one filter and one phase, so no delay between them is made up.

A sample that is not finite spoils 43 ms of its own microphone (the block that it is in) and nothing else.
"""

from __future__ import annotations

import os

import numpy as np
import soxr

from locagen_edge.types import F32

SHORT_BLOCKS = "10"
"""log2 of the longest Fourier transform in soxr's filters. Its own choice is longer, which saves nothing at
these rates, and lets sound wait for 12 to 75 ms, so that frames come in twos."""


class Resampler:
    """Rows (n, mics) float32 at `rate_in` to rows at `rate_out`; how they are cut does not show."""

    def __init__(self, rate_in: float, rate_out: float, mics: int) -> None:
        # HQ errs below -120 dB and passes 0.94 of the lower Nyquist frequency; VHQ would double the delay for
        # digits that lie under the converter's noise.
        os.environ["SOXR_LARGE_DFT_SIZE"] = SHORT_BLOCKS  # soxr reads it there at each stream's begin
        self._soxr = (
            None if rate_in == rate_out else soxr.ResampleStream(rate_in, rate_out, mics, quality="HQ")
        )

    def push(self, rows: F32) -> F32:
        """The rows that are ready by now: (m, mics)."""
        return self._process(rows, last=False)

    def flush(self, rows: F32) -> F32:
        """The last rows, and all that is still inside. Afterwards a new stream may begin."""
        ready = self._process(rows, last=True)
        self.clear()
        return ready

    def clear(self) -> None:
        """Forget what is inside: the next row begins a new stream."""
        if self._soxr is not None:
            self._soxr.clear()

    def _process(self, rows: F32, *, last: bool) -> F32:
        if self._soxr is None:
            return rows
        ready: F32 = self._soxr.resample_chunk(np.ascontiguousarray(rows, dtype=np.float32), last=last)
        return ready
