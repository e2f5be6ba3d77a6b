"""Power in the band that all signal-to-noise ratios of this project speak of: 300 to 4700 Hz."""

from __future__ import annotations

import numpy as np

from locagen_edge.types import Array

BAND_HZ = (300.0, 4700.0)


def in_band(frequency_hz: Array, rate_hz: float) -> Array:
    """Which frequencies count; at rates below 10 kHz the band ends at 0.94 of the Nyquist frequency."""
    inside: Array = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= min(BAND_HZ[1], 0.47 * rate_hz))
    return inside


def band_power(signal: Array, rate_hz: float) -> float:
    """Mean square in the band of a signal (..., n), mean over all rows; full scale 1.0."""
    n = signal.shape[-1]
    spectrum = np.fft.rfft(signal.astype(np.float64), axis=-1)
    inside = in_band(np.fft.rfftfreq(n, 1.0 / rate_hz), rate_hz)
    # Parseval; twice for the negative frequencies (the band leaves out 0 Hz and Nyquist)
    return float(2.0 * np.mean(np.sum(np.abs(spectrum[..., inside]) ** 2, axis=-1)) / n**2)


def from_db(level_db: float) -> float:
    """Power ratio of a level in dB."""
    return float(10.0 ** (level_db / 10.0))
