"""Frame -> Correlation: GCC-PHAT of every pair, in C.

Knapp & Carter, "The generalized correlation method for estimation of time delay", IEEE Trans. ASSP 24
(1976). Window, FFT, whitening and the few lags that can exist are one call of the kernel: splitting it
into stages of its own would cost more in Python than the whole of it costs in C.
"""

from __future__ import annotations

import math

from locagen_edge.errors import SourceError
from locagen_edge.geometry import LAG_MARGIN_SAMPLES, MicArray
from locagen_edge.kernel import GccPhat
from locagen_edge.settings import CorrelationSettings
from locagen_edge.types import Correlation, Frame


class Correlator:
    """GCC-PHAT for one array, rate and frame length."""

    def __init__(
        self, array: MicArray, speed_m_s: float, rate_hz: float, frame: int, settings: CorrelationSettings
    ):
        longest = array.longest_delay_s(speed_m_s) * rate_hz + LAG_MARGIN_SAMPLES
        self._kernel = GccPhat(
            mics=array.mics,
            frame=frame,
            lags=math.ceil(longest * settings.oversample) + 1,  # the parabola needs a neighbour
            oversample=settings.oversample,
            rate_hz=rate_hz,
            band_hz=(settings.band_hz[0], settings.band_hz[1]),
            floor=10 ** (settings.floor_dbfs / 10),
            relative_floor=10 ** (settings.relative_floor_db / 10),
        )
        self._rate_hz = rate_hz

    def __call__(self, frame: Frame) -> Correlation:
        """Raises `SourceError` where the frame is not of the rate the correlator was made for."""
        if frame.rate_hz != self._rate_hz:
            raise SourceError(f"a frame at {frame.rate_hz:g} Hz came, audio.rate_hz is {self._rate_hz:g} Hz")
        values, power, bad_mics = self._kernel.process(frame.samples)
        return Correlation(values, self._kernel.lag_s, power, self._kernel.fill, bad_mics)
