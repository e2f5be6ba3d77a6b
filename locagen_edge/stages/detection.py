"""Frame's level and misfit -> Detection: does something call?

The in-band level is held against a background that falls fast and rises slowly, slower still while
something calls, so that rotors are background and a shout is not. A frame is a call where it stands out of
the background by `detection.snr_db` and one far source explains the delays of all pairs.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.settings import DetectionSettings
from locagen_edge.types import Correlation, Detection

SILENCE = 1e-12
"""-120 dBFS: under any converter's noise."""

FALL_S = 0.5
"""How fast the background follows a level that drops: rotors at idle, a gust's end."""

CALL_SLOWDOWN = 5.0
"""How much slower the background rises while something calls: a call of some seconds must not become it."""

SNR_RANGE_DB = (-30.0, 60.0)


class Detector:
    """Tracks the background over time. One per stream."""

    def __init__(self, settings: DetectionSettings):
        self._settings = settings
        self._background: float | None = None

    def __call__(self, correlation: Correlation, misfit: float, elapsed_s: float) -> Detection:
        """`elapsed_s`: since the previous frame."""
        power = correlation.power.astype(np.float64)
        level = float(np.mean(power[power > SILENCE])) if (power > SILENCE).any() else SILENCE
        if self._background is None:
            self._background = level
        least, most = SNR_RANGE_DB
        excess = level / self._background - 1.0
        snr_db = min(max(10.0 * math.log10(excess), least), most) if excess > 0.0 else least
        call = snr_db >= self._settings.snr_db and misfit <= self._settings.misfit
        rise_s = self._settings.background_s * (CALL_SLOWDOWN if call else 1.0)
        time_s = FALL_S if level < self._background else rise_s
        # in the logarithm, so that 30 dB up takes as long to learn as 3 dB
        self._background *= (level / self._background) ** (1.0 - math.exp(-elapsed_s / time_s))
        return Detection(call=call, snr_db=snr_db, level_dbfs=10.0 * math.log10(level))
