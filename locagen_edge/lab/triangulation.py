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


def over_cells(method: Azimuths, rate_hz: float) -> Azimuths:
    """The same method, asked once and for all per combination of whole-sample delays.

    Its answers may have more axes (..., n).
    """
    known: dict[int, F64] = {}

    def answers(delay_s: F32) -> F64:
        seen, first, back = np.unique(cells(delay_s, rate_hz), return_index=True, return_inverse=True)
        new = np.array([number not in known for number in seen.tolist()], dtype=bool)
        if new.any():
            found = method(np.ascontiguousarray(delay_s[:, first[new]]))
            known.update(zip(seen[new].tolist(), np.moveaxis(found, -1, 0), strict=True))
        answer: F64 = np.stack([known[number] for number in seen.tolist()], axis=-1)[..., back]
        return answer

    return answers


def least_squares(s: LabSettings) -> Azimuths:
    """The plane wave that fits all pairs best, each pair with the same weight; all samples at once."""
    gain = np.linalg.pinv(s.mic_array.baselines_m[:, :2])

    def azimuths(delay_s: F32) -> F64:
        x, y = gain @ delay_s.astype(np.float64)
        azimuth: F64 = np.arctan2(y, x)
        return azimuth

    return azimuths


def flight(s: LabSettings, estimator: Estimator) -> Azimuths:
    """A flight estimator over many delays: azimuth, x and y from the array's middle (3, n).

    NaN where the estimator has no answer, or gives no position.
    """
    pairs = len(s.mic_array.pairs)
    middle = s.mic_array.positions_m.mean(axis=0)
    sigma = np.full(pairs, 1.0 / (np.sqrt(6.0) * s.audio.rate_hz))  # of a delay between rounded arrivals

    def answers(delay_s: F32) -> F64:
        found = np.full((3, delay_s.shape[1]), np.nan)
        for k, delay in enumerate(delay_s.T.astype(np.float64)):
            bearing = estimator(Tdoa(delay, sigma, np.ones(pairs)))
            if bearing.azimuth_rad is not None:
                found[0, k] = bearing.azimuth_rad
            if bearing.fix is not None:
                found[1:, k] = (bearing.fix.position_m - middle)[:2]
        return found

    return answers


def fixed_start(s: LabSettings, start_m: tuple[float, float]) -> Azimuths:
    """The paper's minimiser as one would first write it: BFGS from one fixed point; azimuth, x and y (3, n).

    Minimises sum_m ((d_m - d_1) - c tau_1m)^2 in metres with SciPy's default method. A kilometre away the sum
    hardly changes with range, a source at the start's back is many gentle metres off, and the default
    tolerance of 1e-5 on the gradient is met long before either is found: what comes out depends on the start.
    """
    array = s.mic_array
    places = array.positions_m[:, :2] - array.positions_m[:, :2].mean(axis=0)

    def answers(delay_s: F32) -> F64:
        ways = delay_s[: array.mics - 1].T.astype(np.float64) * s.speed_m_s
        at = np.array([_from_start(places, way, start_m) for way in ways]).T
        return np.stack([np.arctan2(at[1], at[0]), *at])

    return answers


def _from_start(places: F64, way_m: F64, start_m: tuple[float, float]) -> F64:
    def cost(at: F64) -> float:
        distance = np.hypot(*(places - at).T)
        off = distance[1:] - distance[0] - way_m
        return float(off @ off)

    place: F64 = minimize(cost, start_m, method="BFGS").x
    return place
