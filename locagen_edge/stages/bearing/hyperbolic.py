"""The paper's solver: the position that explains the delays against the base microphone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from locagen_edge.geometry import NOWHERE_RAD, direction, wrap
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import DelayModel, Estimator, no_bearing
from locagen_edge.stages.bearing.far_field import far_field
from locagen_edge.types import F64, Bearing, Fix, Tdoa

STARTS = (1.2, 2.0, 5.0, 1000.0)
"""Ranges, in radii of the array, from which the minimiser starts, in the direction of the far field.

Two hyperbolas can cross twice: three microphones then have two exact answers, one of them within some
five spacings. Several starts find both; of answers that fit alike the farther is given (a caller is rarely
at arm's length), and the range counts as not observable."""

SOLID = 0.2
"""Share of its width from which an array's height counts: a thinner one cannot look up and down."""

FARTHEST_M = 1e4
"""Where the search ends: beyond a kilometre a curved wave differs from a plane one by nanoseconds."""


def hyperbolic(settings: Settings) -> Estimator:
    """The paper's solver: the position whose range differences to the base microphone fit best.

    Minimises sum_m ((d_m - d_1) - c tau_1m)^2 over positions, d_m the distance to microphone m, by
    Levenberg-Marquardt (Nocedal & Wright, *Numerical Optimization*, section 10.3) in direction and inverse
    range, in which far sources are as well-behaved as near ones (Civera, Davison & Montiel, "Inverse depth
    parametrization for monocular SLAM", IEEE Trans. Robotics 24, 2008). A flat array finds positions in its
    own plane, so a source far below is taken for a nearer one: the far field gives the better elevation.
    """
    model = DelayModel.of(settings)
    array, speed = model.array, model.speed_m_s
    base = [row for row, (i, _) in enumerate(array.pairs) if i == 0]
    others = array.positions_m[1:]
    _, extent, axes = np.linalg.svd(array.positions_m - array.positions_m.mean(axis=0))
    solid = len(extent) == 3 and extent[2] > SOLID * extent[1]
    normal = axes[2]
    plane_wave = far_field(settings)
    correlation = model.correlation[np.ix_(base, base)]
    centre = array.positions_m.mean(axis=0)
    nearest = float(np.linalg.norm(array.positions_m - centre, axis=1).max()) * 1.05

    def place(q: F64) -> F64:
        u = direction(q[0], q[1]) if solid else _in_plane(q[0], normal)
        position: F64 = centre + u / min(max(q[-1], 1.0 / FARTHEST_M), 1.0 / nearest)
        return position

    def differences(q: F64) -> F64:
        at = place(q)
        farther: F64 = np.linalg.norm(others - at, axis=1) - np.linalg.norm(array.positions_m[0] - at)
        return farther

    def estimate(tdoa: Tdoa) -> Bearing:
        wanted = tdoa.delay_s[base] * speed
        start = plane_wave(tdoa)
        if not np.isfinite(wanted).all() or start.azimuth_rad is None:
            return no_bearing("hyperbolic")
        sigma = model.sigma_s(tdoa)[base] * speed
        angle = (start.azimuth_rad, start.elevation_rad or 0.0) if solid else (start.azimuth_rad,)
        found = [
            _levenberg_marquardt(differences, wanted, np.array([*angle, 1.0 / (nearest * start_range)]))
            for start_range in STARTS
        ]
        best = min(cost for cost, _, _ in found)
        alike = [answer for answer in found if answer[0] <= best + float(np.mean(sigma**2))]
        cost, q, jacobian = min(alike, key=lambda answer: float(answer[1][-1]))
        rival = max(float(answer[1][-1]) for answer in alike)
        noise = correlation * np.outer(sigma, sigma)
        gain = np.linalg.pinv(jacobian)
        covariance = gain @ noise @ gain.T
        fix = _fix(q, place, covariance)
        unique = rival - q[-1] <= 3.0 * math.sqrt(max(float(covariance[-1, -1]), 0.0)) + 1e-6
        misfit = max(start.misfit, math.sqrt(cost) / float(np.linalg.norm(sigma)))
        spread = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * max(misfit, 1.0)
        return Bearing(
            azimuth_rad=wrap(float(q[0])),
            azimuth_sigma_rad=min(float(spread[0]), NOWHERE_RAD),
            elevation_rad=float(q[1]) if solid else None,
            elevation_sigma_rad=min(float(spread[1]), NOWHERE_RAD) if solid else NOWHERE_RAD,
            misfit=misfit,
            estimator="hyperbolic",
            fix=replace(fix, range_observable=fix.range_observable and unique),
        )

    return estimate


def _levenberg_marquardt(
    f: Callable[[F64], F64], wanted: F64, q: F64, steps: int = 30
) -> tuple[float, F64, F64]:
    """Minimises |f(q) - wanted|^2 from q. Returns the cost, q and the Jacobian there."""
    damping, residual = 1e-3, f(q) - wanted
    cost = float(residual @ residual)
    jacobian = _jacobian(f, q)
    for _ in range(steps):
        hessian = jacobian.T @ jacobian
        scale = np.diag(np.maximum(np.diag(hessian), 1e-12))
        step = np.linalg.solve(hessian + damping * scale, -jacobian.T @ residual)
        trial = q + step
        trial[-1] = abs(trial[-1])
        trial_residual = f(trial) - wanted
        trial_cost = float(trial_residual @ trial_residual)
        if trial_cost < cost:
            small = cost - trial_cost < 1e-18  # (nanometre)^2
            q, residual, cost, damping = trial, trial_residual, trial_cost, damping / 10.0
            jacobian = _jacobian(f, q)
            if small:
                break
        else:
            damping *= 10.0
            if damping > 1e9:
                break
    return cost, q, jacobian


def _jacobian(f: Callable[[F64], F64], q: F64) -> F64:
    """Central differences; 1e-6 rad and 1e-6 / m move a 10 cm array's range differences by 0.1 um."""
    step = 1e-6
    columns = []
    for k in range(len(q)):
        move = np.zeros_like(q)
        move[k] = step
        columns.append((f(q + move) - f(q - move)) / (2.0 * step))
    return np.stack(columns, axis=1)


def _fix(q: F64, place: Callable[[F64], F64], covariance: F64) -> Fix:
    """The position, from direction and inverse range with their covariance."""
    inverse, inverse_sigma = float(q[-1]), math.sqrt(max(float(covariance[-1, -1]), 0.0))
    range_m = 1.0 / min(max(inverse, 1.0 / FARTHEST_M), 1e3)
    # to first order; where the inverse range is not three sigmas from zero, that theory has no meaning
    observable = inverse > 3.0 * inverse_sigma and inverse > 1.0 / FARTHEST_M
    turn = _jacobian(place, q)
    return Fix(place(q), turn @ covariance @ turn.T, range_m, inverse_sigma * range_m**2, observable)


def _in_plane(azimuth_rad: float, normal: F64) -> F64:
    """Unit vector (3,) of this azimuth in the plane across `normal`, which is not level."""
    level = direction(azimuth_rad)
    u = level - np.array([0.0, 0.0, float(level @ normal) / normal[2]])
    unit: F64 = u / np.linalg.norm(u)
    return unit
