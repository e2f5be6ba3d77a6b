"""Correlation -> Tdoa: the highest peak of each pair, refined to a fraction of the grid, with its sigma.

The peak is that of the parabola through the highest grid point and its neighbours. At 16 points a sample
and a band up to 0.94 of Nyquist the parabola's own bias is below 1e-4 samples.

Sigma. The correlation's slope at the true delay is (1/K) sum_k w_k sin(phi_k), where phi_k is the phase
noise of bin k; the delay's error is that slope over the curvature r''. With E[sin^2 phi] = (1 - E[cos 2 phi])
/ 2 and wrapped-normal phases, for which E[cos 2 phi] = (E[cos phi])^4 (Mardia & Jupp, *Directional
Statistics*, section 3.5), and with the relative peak height p standing for E[cos phi]:

    sigma = sqrt(RHO * mean(w^2) * (1 - p^4) / (2 K)) / |r''|

RHO counts that the Hann window correlates neighbouring bins (2/3 and 1/6 in amplitude): 1 + 2 (4/9 + 1/36).
r'' is the measured curvature. A sound that fills only the share F of the band above the floor (the mean of
p / (p + f) over the bins, of both microphones) reaches a peak of F at most and makes noise in F of the bins:
p is relative to F, and the noise is that of F K bins.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.geometry import LAG_MARGIN_SAMPLES, MicArray
from locagen_edge.settings import CorrelationSettings
from locagen_edge.types import F64, Correlation, Tdoa

RHO = 1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0)

LEAST_NOISE = 4e-3
"""30 dB SNR: above it the peak differs from 1 by no more than it does from frame to frame."""

CHANCE = 0.05
"""Share of pairs of noise alone whose highest peak counts. Below that height there is no peak, no delay and,
where too few are left, no bearing: the sigma above holds near the true peak, not where chance is higher."""


class PeakPicker:
    """Finds the delays of all pairs within what the geometry allows."""

    def __init__(
        self, array: MicArray, speed_m_s: float, rate_hz: float, frame: int, settings: CorrelationSettings
    ):
        low, high = settings.band_hz
        bins = np.arange(math.ceil(low * frame / rate_hz), math.floor(high * frame / rate_hz) + 1)
        omega = 2.0 * np.pi * bins * rate_hz / frame
        self._limit_s = array.spacing_m / speed_m_s
        self._slope_noise = math.sqrt(RHO * float(np.mean(omega**2)) / (2.0 * len(bins)))
        # a lag of pure noise has the variance RHO / (2 K); the peak is the highest of the lags that differ
        lags = 1.0 + 2.0 * float(self._limit_s.max()) * (high - low)
        self._least_peak = math.sqrt(RHO / len(bins) * math.log(lags / CHANCE))
        self._step_s = 1.0 / (settings.oversample * rate_hz)
        self._outside: np.ndarray | None = None
        self._margin_s = LAG_MARGIN_SAMPLES / rate_hz
        self._rows = np.arange(len(array.pairs))
        self._first, self._second = np.array(array.pairs).T

    def _mask(self, lag_s: F64) -> np.ndarray:
        """(pairs, lags) True where a pair's own spacing forbids the lag, or no neighbour is left."""
        if self._outside is None:
            outside = np.abs(lag_s)[None, :] > self._limit_s[:, None] + self._margin_s
            outside[:, [0, -1]] = True
            self._outside = outside
        return self._outside

    def __call__(self, correlation: Correlation) -> Tdoa:
        values = correlation.values
        best = np.where(self._mask(correlation.lag_s), -np.inf, values).argmax(axis=1)
        left = values[self._rows, best - 1].astype(np.float64)
        top = values[self._rows, best].astype(np.float64)
        right = values[self._rows, best + 1].astype(np.float64)
        bend = 2.0 * top - left - right
        fill = np.sqrt(correlation.fill[self._first].astype(np.float64) * correlation.fill[self._second])
        good = (top > self._least_peak * np.sqrt(fill)) & (bend > 0.0)
        bend = np.where(good, bend, 1.0)
        shift = np.clip((right - left) / (2.0 * bend), -1.0, 1.0)
        peak = np.clip(top + (right - left) * shift / 4.0, 0.0, 1.0)
        curvature = bend / self._step_s**2
        coherence = np.minimum(peak / np.maximum(fill, 1e-9), 1.0)
        noise = np.sqrt(fill * np.maximum(1.0 - coherence**4, LEAST_NOISE))
        sigma = self._slope_noise * noise / curvature
        return Tdoa(
            delay_s=np.where(good, correlation.lag_s[best] + shift * self._step_s, np.nan),
            sigma_s=np.where(good, sigma, np.inf),
            peak=np.where(good, peak, 0.0),
        )
