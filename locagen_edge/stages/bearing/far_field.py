"""The direction of a plane wave, by least squares over all pairs."""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.geometry import angles
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import NOWHERE_RAD, DelayModel, Estimator, no_bearing
from locagen_edge.types import F64, Bearing, Tdoa

LARGEST_AZIMUTH_SIGMA_RAD = math.radians(60.0)
"""Beyond this the answer is "no bearing"."""


def far_field(settings: Settings, name: str = "far-field") -> Estimator:
    """Weighted least squares for the direction of a plane wave over all pairs.

    delay = baseline . u / c is linear in u. A flat array gives the part of u in its plane; the part across
    follows from |u| = 1 and "the source is below". Smith & Abel, "Closed-form least-squares source location
    estimation from range-difference measurements", IEEE Trans. ASSP 35 (1987), in its far-field limit.
    """
    model = DelayModel.of(settings)
    correlation = model.correlation
    _, _, axes = np.linalg.svd(model.array.baselines_m)
    dims = model.array.dimensions
    plane = axes[:dims]  # (dims, 3) orthonormal, spans the array
    normal = axes[2] * (1.0 if axes[2, 2] >= 0.0 else -1.0)  # downwards: the source is below
    slope = model.array.baselines_m @ plane.T / model.speed_m_s  # (pairs, dims)

    def estimate(tdoa: Tdoa) -> Bearing:
        heard = np.isfinite(tdoa.delay_s)
        if not heard.all() and np.linalg.matrix_rank(slope[heard]) < dims:
            return no_bearing(name)
        sigma = model.sigma_s(tdoa)[heard]
        delay, a = tdoa.delay_s[heard], slope[heard]
        weighted = a / sigma[:, None]
        gain = np.linalg.pinv(weighted) / sigma[None, :]  # (dims, pairs): weighted least squares
        v = gain @ delay
        covariance = gain @ (correlation[np.ix_(heard, heard)] * np.outer(sigma, sigma)) @ gain.T
        return _from_direction(v, covariance, delay, a, sigma, plane, normal, name)

    return estimate


def _from_direction(
    v: F64, covariance: F64, delay: F64, slope: F64, sigma: F64, plane: F64, normal: F64, name: str
) -> Bearing:
    """Angles and their sigmas from the direction's part v in the array's own axes."""
    length = float(np.linalg.norm(v))
    if length < 1e-9:
        v, length = v + 1e-9, 1e-9 * math.sqrt(len(v))
    spare = len(delay) - len(plane)
    if len(plane) == 3 or length > 1.0:
        v = v / length  # onto the sphere, or the rim of the disc of possible directions
        spare += 1
    misfit = float(np.sqrt(np.sum(((delay - slope @ v) / sigma) ** 2) / max(spare, 1)))
    covariance = covariance * max(misfit, 1.0) ** 2  # delays that disagree are worse than they claim
    u = plane.T @ v
    turn = plane.T  # du / dv
    if len(plane) == 2:
        across = math.sqrt(max(1.0 - float(v @ v), 0.0))
        u = u + normal * across
        # at the rim the derivative is infinite and the linear theory ends: the sigma of v bounds it
        bounded = max(across, math.sqrt(math.sqrt(float(np.trace(covariance)))))
        turn = turn - np.outer(normal, v) / bounded
    spread = turn @ covariance @ turn.T  # (3, 3) of u
    azimuth, elevation = angles(u)
    flat = max(float(u[0] ** 2 + u[1] ** 2), 1e-12)
    across_flat = np.array([-u[1], u[0], 0.0]) / flat
    azimuth_sigma = math.sqrt(max(float(across_flat @ spread @ across_flat), 0.0))
    elevation_sigma = math.sqrt(max(spread[2, 2], 0.0)) / max(math.cos(elevation), 1e-3)
    known = azimuth_sigma <= LARGEST_AZIMUTH_SIGMA_RAD
    return Bearing(
        azimuth_rad=azimuth if known else None,
        azimuth_sigma_rad=min(azimuth_sigma, NOWHERE_RAD),
        elevation_rad=elevation,
        elevation_sigma_rad=min(elevation_sigma, NOWHERE_RAD),
        misfit=misfit,
        estimator=name,
    )
