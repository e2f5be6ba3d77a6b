"""The direction of a plane wave, by least squares over all pairs.

delay = baseline . u / c is linear in u, and |u| = 1. In the array's own two main axes linear least squares
gives the start (Smith & Abel, "Closed-form least-squares source location estimation from range-difference
measurements", IEEE Trans. ASSP 35 (1987), in its far-field limit). Across them there are two answers, on
either side of the array. A flat array cannot tell them apart, and there it ends. Any other array follows both
by Gauss-Newton steps on the sphere, since a third axis of a few millimetres says too little about u to be
solved for by itself, and too much to be left out.

Of two answers that fit alike the lower is taken: the source is below. Where the other is no higher than the
horizon either (a tilted array), the sigma covers both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from locagen_edge.geometry import FLAT_M, NOWHERE_RAD, angles, tangent, wrap
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import (
    LARGEST_AZIMUTH_SIGMA_RAD,
    DelayModel,
    Estimator,
    no_bearing,
)
from locagen_edge.types import F64, Bearing, Tdoa

ALIKE = 16.0
"""Two answers count as alike where their squared misfits differ by less, per independent delay: 4 sigma, so
that noise in a nearly flat array does not lift a caller on the ground into the sky. All pairs of M
microphones hold each independent delay M / 2 times."""

MOST_STEPS = 20
CLOSE_RAD = 1e-8
"""Gauss-Newton ends here; four steps are usual."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """One answer."""

    u: F64
    cost: float
    """sum of squared (measured - fitted) delay over its sigma"""
    azimuth: float
    elevation: float
    azimuth_sigma: float
    elevation_sigma: float


def far_field(settings: Settings, name: str = "far-field") -> Estimator:
    """Weighted least squares for the unit vector to a far source. Needs three microphones off one line."""
    model = DelayModel.of(settings)
    correlation = model.correlation
    _, thickness, axes = np.linalg.svd(model.array.baselines_m)
    flat = len(thickness) < 3 or thickness[2] < FLAT_M
    plane = axes[:2]  # (2, 3) orthonormal
    normal = axes[2] * (1.0 if axes[2, 2] >= 0.0 else -1.0)  # downwards
    slope = model.array.baselines_m / model.speed_m_s  # (pairs, 3) delay by u
    spare = len(model.array.pairs) - 2
    alike = ALIKE * model.array.mics / 2

    def estimate(tdoa: Tdoa) -> Bearing:
        heard = np.isfinite(tdoa.delay_s)
        a, delay, sigma, related = slope, tdoa.delay_s, model.sigma_s(tdoa), correlation
        if not heard.all():
            a, delay, sigma, related = a[heard], delay[heard], sigma[heard], related[np.ix_(heard, heard)]
            if len(a) < 2 or np.linalg.matrix_rank(a @ plane.T) < 2:
                return no_bearing(name)
        a, delay = a / sigma[:, None], delay / sigma
        in_plane = a @ plane.T
        v = _inverse(in_plane) @ delay
        inside = float(v @ v)
        if inside >= 1.0:
            v = v / math.sqrt(inside)
        across = normal * math.sqrt(max(1.0 - inside, 0.0))
        starts = [plane.T @ v + across, plane.T @ v - across]
        least = _least_tilt(in_plane)
        fits = [_judged(u, a, delay, related, normal, least) for u in _followed(starts, a, delay, flat)]
        return _chosen(fits, alike, max(spare + int(inside >= 1.0) - int((~heard).sum()), 1), name)

    return estimate


def _followed(starts: list[F64], a: F64, delay: F64, flat: bool) -> list[F64]:
    """The starts at the nearest minima of |delay - a u| on the sphere."""
    if flat:
        return starts
    ends = []
    for start in starts:
        u = start
        for _ in range(MOST_STEPS):
            across = tangent(u)
            # at the rim of a nearly flat array one direction is hardly seen: rcond leaves it alone
            step = np.linalg.lstsq(a @ across.T, delay - a @ u, rcond=1e-3)[0]
            length = float(np.linalg.norm(step))
            u = u + step @ across * min(1.0, 0.5 / max(length, 1e-12))
            u = u / np.linalg.norm(u)
            if length < CLOSE_RAD:
                break
        ends.append(u)
    return ends


def _inverse(a: F64) -> F64:
    """(2, n): the pseudo-inverse of (n, 2), by Gram and Schmidt: a tenth of a singular value decomposition's
    time, and as exact where the columns are not nearly one."""
    first, second = a[:, 0], a[:, 1]
    length2 = float(first @ first)
    shared = float(first @ second) / length2 if length2 else 0.0
    rest = second - shared * first
    rest2 = float(rest @ rest)
    if rest2 <= 1e-18 * length2 or length2 <= 1e-18 * rest2:
        return np.asarray(np.linalg.pinv(a, rcond=1e-9), dtype=np.float64)
    inverse: F64 = np.empty((2, len(a)))
    inverse[1] = rest / rest2
    inverse[0] = first / length2 - shared * inverse[1]
    return inverse


def _least_tilt(in_plane: F64) -> float:
    """How far a unit vector has to stand out of the array's plane for its tilt to be seen to first order.

    Nearer, the tilt is seen to second order only, and the 1-sigma of what is seen in the plane bounds it.
    `in_plane` (n, 2): slope of the delays along the plane's axes, in units of their sigma.
    """
    (a, b), (_, d) = (in_plane.T @ in_plane).tolist()
    weakest = (a + d) / 2.0 - math.hypot((a - d) / 2.0, b)
    return min(1.0 / math.sqrt(max(math.sqrt(max(weakest, 0.0)), 1e-12)), 0.5)


def _judged(u: F64, a: F64, delay: F64, related: F64, normal: F64, least: float) -> _Fit:
    """Misfit and sigmas of an answer; `a` and `delay` are in units of the delays' sigma. Nearer to the plane
    than `least` the sigmas are those of `least`."""
    residual = delay - a @ u
    azimuth, elevation = angles(u)
    out = float(u @ normal)
    if abs(out) < least:
        u = u - normal * out
        u = u / math.sqrt(u @ u) * math.sqrt(1.0 - least**2) + normal * math.copysign(least, out)
    gain = _inverse(a @ tangent(u).T)
    variance = ((gain @ related) * gain).sum(axis=1).tolist()
    return _Fit(
        u,
        float(residual @ residual),
        azimuth,
        elevation,
        math.sqrt(variance[0]) / max(math.cos(elevation), 1e-9),
        math.sqrt(variance[1]),
    )


def _chosen(fits: list[_Fit], alike: float, spare: int, name: str) -> Bearing:
    fits.sort(key=lambda fit: fit.cost)
    best, other = fits
    rival = other.cost - best.cost < alike
    if rival and other.u[2] > best.u[2]:
        best, other = other, best
    misfit = math.sqrt(best.cost / spare)
    # delays that disagree are worse than they claim
    azimuth_sigma = best.azimuth_sigma * max(misfit, 1.0)
    elevation_sigma = best.elevation_sigma * max(misfit, 1.0)
    if rival and other.elevation <= 0.0:
        azimuth_sigma += abs(wrap(other.azimuth - best.azimuth)) / 2.0
        elevation_sigma += abs(other.elevation - best.elevation) / 2.0
    known = azimuth_sigma <= LARGEST_AZIMUTH_SIGMA_RAD
    return Bearing(
        azimuth_rad=best.azimuth if known else None,
        azimuth_sigma_rad=min(azimuth_sigma, NOWHERE_RAD),
        elevation_rad=best.elevation,
        elevation_sigma_rad=min(elevation_sigma, NOWHERE_RAD),
        misfit=misfit,
        estimator=name,
    )
