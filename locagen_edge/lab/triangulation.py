"""The methods that learn nothing: plain least squares, the flight's solver, and the paper's minimiser.

Whole-sample delays come in few combinations (30 at 10 kHz and 10 cm), and a method without memory gives one
answer for each, so each combination is solved once: `over_cells`. The flight's estimators are asked as they
fly, not rewritten here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from locagen_edge.lab.bound import cells
from locagen_edge.lab.settings import LabSettings
from locagen_edge.stages.bearing.common import Estimator
from locagen_edge.types import F32, F64, Tdoa

Azimuths = Callable[[F32], F64]
"""Delays (pairs, n) in seconds to azimuths (n,) in radians; NaN where there is no answer."""


def over_cells(one_by_one: Azimuths, rate_hz: float) -> Azimuths:
    """The same method, asked once per combination of whole-sample delays."""

    def azimuths(delay_s: F32) -> F64:
        _, first, back = np.unique(cells(delay_s, rate_hz), return_index=True, return_inverse=True)
        return one_by_one(np.ascontiguousarray(delay_s[:, first]))[back]

    return azimuths


def least_squares(s: LabSettings) -> Azimuths:
    """The plane wave that fits all pairs best, each pair with the same weight; all samples at once."""
    gain = np.linalg.pinv(s.mic_array.baselines_m[:, :2])

    def azimuths(delay_s: F32) -> F64:
        x, y = gain @ delay_s.astype(np.float64)
        azimuth: F64 = np.arctan2(y, x)
        return azimuth

    return azimuths


def flight(s: LabSettings, estimator: Estimator) -> Callable[[F32], tuple[F64, F64]]:
    """A flight estimator over many delays: azimuths (n,) and positions (2, n) from the array's middle.

    NaN where the estimator has no answer, or gives no position.
    """
    pairs = len(s.mic_array.pairs)
    middle = s.mic_array.positions_m.mean(axis=0)
    sigma = np.full(pairs, 1.0 / (np.sqrt(6.0) * s.audio.rate_hz))  # of a delay between rounded arrivals

    def both(delay_s: F32) -> tuple[F64, F64]:
        azimuth, position = np.full(delay_s.shape[1], np.nan), np.full((2, delay_s.shape[1]), np.nan)
        for k, delay in enumerate(delay_s.T.astype(np.float64)):
            bearing = estimator(Tdoa(delay, sigma, np.ones(pairs)))
            if bearing.azimuth_rad is not None:
                azimuth[k] = bearing.azimuth_rad
            if bearing.fix is not None:
                position[:, k] = (bearing.fix.position_m - middle)[:2]
        return azimuth, position

    return both


def fixed_start(s: LabSettings, start_m: tuple[float, float]) -> Azimuths:
    """The paper's minimiser as one would first write it: BFGS for x and y from one fixed point.

    Minimises sum_m ((d_m - d_1) - c tau_1m)^2 in metres with SciPy's default method. A kilometre away the sum
    hardly changes with range, a source at the start's back is many gentle metres off, and the default
    tolerance of 1e-5 on the gradient is met long before either is found: what comes out depends on the start.
    """
    array = s.mic_array
    places = array.positions_m[:, :2] - array.positions_m[:, :2].mean(axis=0)

    def azimuths(delay_s: F32) -> F64:
        ways = delay_s[: array.mics - 1].T.astype(np.float64) * s.speed_m_s
        return np.array([_from_start(places, way, start_m) for way in ways])

    return azimuths


def _from_start(places: F64, way_m: F64, start_m: tuple[float, float]) -> float:
    def cost(at: F64) -> float:
        distance = np.hypot(*(places - at).T)
        off = distance[1:] - distance[0] - way_m
        return float(off @ off)

    x, y = minimize(cost, start_m, method="BFGS").x
    return float(np.arctan2(y, x))
