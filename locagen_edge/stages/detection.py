"""Bearing's evidence, or the frame's level and the bearing's misfit -> Detection: does something call?

An estimator that judges the spectra themselves says how far its best direction stands out of what noise
alone gives: from `detection.evidence` on it is a call, whatever the level. Those that only see delays need
the level:

The in-band level is held against the background: the lowest smoothed level of the last
`detection.background_s` (minimum statistics: Martin, "Noise power spectral density estimation based on
optimal smoothing and minimum statistics", IEEE Trans. Speech Audio Processing 9 (2001), for the whole band).
Rotors that start or rise are background after that time, however far they rise, and a call that is longer is
too. A frame is a call where it stands out of the background by `detection.snr_db` and one far source explains
the delays.
"""

from __future__ import annotations

import math
from collections import deque

from locagen_edge.settings import DetectionSettings
from locagen_edge.types import Bearing, Correlation, Detection

SILENCE = 1e-12
"""-120 dBFS: under any converter's noise. Quieter frames are no background, but a muted input."""

SMOOTH_S = 0.2
"""The level is smoothed over two frames before its minimum is taken."""

PIECES = 8
"""The minimum is kept for pieces of the time, so that the oldest can be forgotten."""

BIAS = 1.08
"""The lowest of many smoothed levels is below their mean: 0.3 dB for 0.2 s of 4.4 kHz and 6 s of them."""

SNR_RANGE_DB = (-30.0, 60.0)


class Detector:
    """Tracks the background over time. One per stream."""

    def __init__(self, settings: DetectionSettings):
        self._settings = settings
        self._smooth: float | None = None
        self._minima: deque[float] = deque(maxlen=PIECES)
        self._piece_s = 0.0
        self._since_s = 0.0

    def __call__(self, correlation: Correlation, bearing: Bearing, elapsed_s: float) -> Detection:
        """`elapsed_s`: since the previous frame."""
        live = [power for power in correlation.power.tolist() if power > SILENCE]
        if not live:
            self._since_s = 0.0
            return Detection(call=False, snr_db=SNR_RANGE_DB[0], level_dbfs=10.0 * math.log10(SILENCE))
        level = sum(live) / len(live)
        background = self._follow(level, elapsed_s)
        least, most = SNR_RANGE_DB
        excess = level / background - 1.0
        snr_db = min(max(10.0 * math.log10(excess), least), most) if excess > 0.0 else least
        if bearing.evidence is not None:
            call, since_s = bearing.evidence.ratio >= self._settings.evidence, bearing.evidence.since_s
        else:
            call = snr_db >= self._settings.snr_db and bearing.misfit <= self._settings.misfit
            since_s = self._since_s + elapsed_s
        self._since_s = since_s if call else 0.0
        return Detection(call, snr_db, 10.0 * math.log10(level), self._since_s)

    def apply(self, settings: DetectionSettings) -> None:
        """New limits from the next frame on; the background stays."""
        self._settings = settings

    def forget(self) -> None:
        """The next frame is all that is known of the background."""
        self._smooth = None
        self._minima.clear()

    def _follow(self, level: float, elapsed_s: float) -> float:
        """The background's power with this frame in it."""
        if self._smooth is None:
            self._smooth = level
        old = math.exp(-elapsed_s / SMOOTH_S)
        # a mean and not a step towards the level, which rounds to nothing at all after a far louder frame
        self._smooth = old * self._smooth + (1.0 - old) * level
        self._piece_s += elapsed_s
        if not self._minima or self._piece_s > self._settings.background_s / PIECES:
            self._minima.append(self._smooth)
            self._piece_s = 0.0
        self._minima[-1] = min(self._minima[-1], self._smooth)
        return max(BIAS * min(self._minima), SILENCE)
