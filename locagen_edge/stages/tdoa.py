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
        self._margin_s = LAG_MARGIN_SAMPLES / rate_hz
        self._pairs = array.pairs
        self._lags: list[tuple[int, int]] | None = None

    def _allowed(self, lag_s: F64) -> list[tuple[int, int]]:
        """The first lag of each pair that its own spacing allows and that has neighbours, and the one after
        the last."""
        if self._lags is None:
            allowed = np.abs(lag_s)[None, :] <= self._limit_s[:, None] + self._margin_s
            allowed[:, [0, -1]] = False
            self._lags = [(int(row[0]), int(row[-1]) + 1) for row in map(np.flatnonzero, allowed)]
        return self._lags

    def __call__(self, correlation: Correlation) -> Tdoa:
        values, fills = correlation.values, correlation.fill.tolist()
        delay_s, sigma_s, peaks = [], [], []
        for row, ((i, j), (low, high)) in enumerate(
            zip(self._pairs, self._allowed(correlation.lag_s), strict=True)
        ):
            best = low + int(values[row, low:high].argmax())
            left, top, right = values[row, best - 1 : best + 2].tolist()
            bend = 2.0 * top - left - right
            fill = math.sqrt(fills[i] * fills[j])
            if not (top > self._least_peak * math.sqrt(fill) and bend > 0.0):
                delay_s.append(math.nan)
                sigma_s.append(math.inf)
                peaks.append(0.0)
                continue
            shift = min(max((right - left) / (2.0 * bend), -1.0), 1.0)
            peak = min(max(top + (right - left) * shift / 4.0, 0.0), 1.0)
            coherence = min(peak / max(fill, 1e-9), 1.0)
            noise = math.sqrt(fill * max(1.0 - coherence**4, LEAST_NOISE))
            delay_s.append(float(correlation.lag_s[best]) + shift * self._step_s)
            sigma_s.append(self._slope_noise * noise / (bend / self._step_s**2))
            peaks.append(peak)
        return Tdoa(np.array(delay_s), np.array(sigma_s), np.array(peaks))
