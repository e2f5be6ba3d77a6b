"""One direction over time: an error-state Kalman filter on the unit sphere.

Azimuth and elevation are no place to filter in: below the drone, where a caller often is, the azimuth has a
pole. So the direction is a unit vector, its error a small vector across it, and an update turns the vector
instead of adding to angles (Hertzberg, Wagner, Frese & Schroeder, "Integrating generic sensor fusion
algorithms with sound state representations through encapsulation of manifolds", Information Fusion 14
(2013); Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, chapter 5). Errors
are kept as vectors of the axes themselves, covariance singular along the direction: no basis has to be
carried along, and other axes are one rotation away.

A call of numpy costs as much as ten sums of plain floats: what has two or three elements is written out.

The rate is an angular velocity with white-noise acceleration (Bar-Shalom, Li & Kirubarajan, *Estimation with
Applications to Tracking and Navigation*, section 6.2), about whatever makes bearings move:

- in the body's axes the drone's own yaw: about z, which moves a caller below on a small circle. Its roll and
  pitch, unknown too, shake the direction;
- in the earth's axes flight past the caller: on a straight line it moves the direction on a great circle, so
  that the angular velocity is across the direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from locagen_edge.geometry import angles, direction, tangent, wrap
from locagen_edge.settings import TrackSettings
from locagen_edge.types import F64, Bearing

LOCAL_RAD = math.radians(15.0)
"""1-sigma of the elevation up to which a bearing is a place on the sphere. Beyond it the meridians'
converging would turn errors of the elevation into errors of the azimuth: there the two count each for
itself."""
UNKNOWN_ELEVATION_RAD = math.radians(30.0)
"""1-sigma of the elevation, around that of the body's horizon, where the array cannot tell it."""
LEAST_SHARE = 0.1
"""Of a bearing's sigma that counts as noise, however much of it is explained by fixed errors."""


_EYE: F64 = np.eye(3)
_EYE6: F64 = np.eye(6)
_LEVEL: F64 = np.diag([1.0, 1.0, 0.0])
_UPRIGHT: F64 = np.diag([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Motion:
    """How directions move in one kind of axes."""

    agility_rad: float
    """white noise in the angular acceleration, rad/s^2 per square root of Hz"""
    first_rate_rad_s: float
    """1-sigma of the unknown rate at birth, per axis"""
    wobble_rad: float
    """random walk about the two level axes, rad per square root of a second"""
    great_circle: bool
    """the angular velocity is across the direction; else about z"""

    def axes(self, u: F64) -> F64:
        """(3, 3) projection to the axes about which a direction u can be moving."""
        return _EYE - u[:, None] * u if self.great_circle else _UPRIGHT


def body_motion(settings: TrackSettings) -> Motion:
    """The drone yaws as briskly as the settings say, and leans; the caller's own way is slow beside that."""
    return Motion(math.radians(settings.agility_deg_s2), math.radians(30.0), math.radians(5.0), False)


def earth_motion(settings: TrackSettings) -> Motion:
    """What is left with the attitude taken out; 10 degrees/s is 10 m/s past a caller at 60 m."""
    return Motion(math.radians(settings.agility_earth_deg_s2), math.radians(10.0), 0.0, True)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A direction and its rate."""

    u: F64
    """(3,) unit vector to the source"""
    rate: F64
    """(3,) angular velocity, rad/s: du/dt = rate x u"""
    p: F64
    """(6, 6) covariance of the errors of u and rate, rad^2; nothing along u"""


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """A bearing, in the axes in which directions are followed."""

    turn: F64
    """(3, 3) from the body's axes into those"""
    azimuth: float
    elevation: float | None
    """both in body axes, radians"""
    level_variance: float
    up_variance: float
    """rad^2 along the body's horizon and towards its zenith, without errors that stay the same"""
    fixed_variance: float
    """rad^2 across the direction, of errors that stay the same from frame to frame"""


def measured(bearing: Bearing, turn: F64, *, fixed: float, inflation: float, moved: float) -> Measurement:
    """`fixed`: variance within the bearing's sigma that does not average out; `inflation` of what is left,
    since frames overlap; `moved`: variance of what the direction moves between a frame's middle and the
    moment when its sound was loudest. The bearing has to have an azimuth."""
    assert bearing.azimuth_rad is not None
    level = (bearing.azimuth_sigma_rad * math.cos(bearing.elevation_rad or 0.0)) ** 2
    up = bearing.elevation_sigma_rad**2

    def noise(variance: float) -> float:
        # 1e-12: a millionth of a radian, so that a bearing that claims to be exact leaves a covariance
        return max(variance - fixed, LEAST_SHARE**2 * variance, 1e-12) * inflation + moved

    return Measurement(turn, bearing.azimuth_rad, bearing.elevation_rad, noise(level), noise(up), fixed)


def mirrored(m: Measurement, normal: F64) -> Measurement:
    """The other answer of a flat array with this normal (body axes): as good as the first in every delay."""
    u = direction(m.azimuth, m.elevation or 0.0)
    azimuth, elevation = angles(u - 2.0 * float(u @ normal) * normal)
    return replace(m, azimuth=azimuth, elevation=elevation)


def born(m: Measurement, motion: Motion) -> State:
    u = direction(m.azimuth, m.elevation or 0.0)
    up = UNKNOWN_ELEVATION_RAD**2 if m.elevation is None else min(m.up_variance, UNKNOWN_ELEVATION_RAD**2)
    basis = tangent(u) @ m.turn.T
    u = m.turn @ u
    p = np.zeros((6, 6))
    p[:3, :3] = basis.T @ np.diag([m.level_variance, up]) @ basis
    p[3:, 3:] = motion.first_rate_rad_s**2 * motion.axes(u)
    return State(u, np.zeros(3), p)


def predicted(state: State, motion: Motion, dt: float) -> State:
    """dt seconds later."""
    turn = _turn(state.rate * dt)
    u = turn @ state.u
    lever = -_cross(u)  # an error of the rate moves u by error x u = -(u x error)
    f = _EYE6.copy()
    f[:3, :3] = turn
    f[:3, 3:] = lever * dt
    if motion.great_circle:
        f[3:, 3:] = turn
    axes = motion.axes(u)
    moved = lever @ axes
    cross = moved * (motion.agility_rad**2 * dt**2 / 2)
    p: F64 = f @ state.p @ f.T
    p[:3, :3] += moved @ lever.T * (motion.agility_rad**2 * dt**3 / 3)
    if motion.wobble_rad:
        p[:3, :3] += lever @ _LEVEL @ lever.T * (motion.wobble_rad**2 * dt)
    p[:3, 3:] += cross
    p[3:, :3] += cross.T
    p[3:, 3:] += axes * (motion.agility_rad**2 * dt)
    return State(u, f[3:, 3:] @ state.rate, p)


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """A measurement against a state, along the rows of `basis`, tangents to the sphere."""

    measurement: Measurement
    basis: F64
    """(n, 3), n = 1 or 2"""
    off: F64
    """(n,) rad"""
    noise: F64
    """(n, n) rad^2, of the measurement alone"""
    distance2: float
    """squared Mahalanobis distance, of measurement and state, with what does not average out"""
    cost: float
    """twice the negative log-likelihood but for a constant: a wide state does not win by being wide"""


def innovation(state: State, m: Measurement) -> Innovation:
    here = m.turn.T @ state.u  # as the body sees it
    basis = tangent(here)
    variances = np.array([m.level_variance, m.up_variance])
    if m.elevation is not None and m.up_variance <= LOCAL_RAD**2:
        there = direction(m.azimuth, m.elevation)
        off = basis @ _log(here, there)
        rows = basis @ _carry(there, here) @ tangent(there).T
        noise = rows * variances @ rows.T
    else:
        azimuth, elevation = angles(here)
        off = np.array([wrap(m.azimuth - azimuth) * math.cos(elevation), (m.elevation or 0.0) - elevation])
        noise = np.diag(variances)
        if m.elevation is None:
            basis, off, noise = basis[:1], off[:1], noise[:1, :1]
    basis = basis @ m.turn.T
    gate = basis @ state.p[:3, :3] @ basis.T + noise
    distance2, determinant = _against(off, gate, m.fixed_variance)
    return Innovation(m, basis, off, noise, distance2, distance2 + math.log(determinant))


def _against(off: F64, variance: F64, more: float) -> tuple[float, float]:
    """Squared Mahalanobis distance of off (n,) and the determinant of its variance (n, n), which has `more`
    on its diagonal; n is 1 or 2."""
    if len(off) == 1:
        x, total = float(off[0]), float(variance[0, 0]) + more
        return x * x / total, total
    (a, b), (_, d) = variance.tolist()
    a, d = a + more, d + more
    x, y = off.tolist()
    determinant = max(a * d - b * b, 1e-300)  # above zero but for rounding
    return (d * x * x - 2.0 * b * x * y + a * y * y) / determinant, determinant


def updated(state: State, i: Innovation, motion: Motion) -> State:
    """The state with a measurement in it."""
    ph = state.p[:, :3] @ i.basis.T  # the measurement sees the direction alone
    gain = np.linalg.solve(i.basis @ ph[:3] + i.noise, ph.T).T
    correction = gain @ i.off
    keep = _EYE6.copy()
    keep[:, :3] -= gain @ i.basis
    p = keep @ state.p @ keep.T + gain @ i.noise @ gain.T  # Joseph: stays symmetric and positive
    u = _exp(state.u, correction[:3])
    turn = _carry(state.u, u)
    carry = _EYE6.copy()
    carry[:3, :3] = turn
    if motion.great_circle:
        carry[3:, 3:] = turn
    return State(u, carry[3:, 3:] @ (state.rate + correction[3:]), carry @ p @ carry.T)


def in_other_axes(state: State, turn: F64, motion: Motion) -> State:
    """The same direction, as sure as it was, in axes that `turn` (3, 3) leads to and where `motion` holds.

    The rate begins anew: in it is the drone's own, which is known in one of the two only.
    """
    p = np.zeros((6, 6))
    p[:3, :3] = turn @ state.p[:3, :3] @ turn.T
    u = turn @ state.u
    p[3:, 3:] = motion.first_rate_rad_s**2 * motion.axes(u)
    return replace(state, u=u, rate=np.zeros(3), p=p)


# --- the sphere -----------------------------------------------------------------------------------------


def _cross(v: F64) -> F64:
    """(3, 3) matrix of v x."""
    return _skew(*v.tolist())


def _skew(x: float, y: float, z: float) -> F64:
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _sinc(angle: float) -> float:
    """sin(angle) / angle."""
    return math.sin(angle) / angle if angle else 1.0


def _turn(v: F64) -> F64:
    """(3, 3) rotation about v by |v| radians (Rodrigues)."""
    angle = math.sqrt(v @ v)
    k = _cross(v)
    # (1 - cos) / angle^2 as half a squared sinc
    rotated: F64 = _EYE + _sinc(angle) * k + 0.5 * _sinc(angle / 2.0) ** 2 * (k @ k)
    return rotated


def _carry(a: F64, b: F64) -> F64:
    """(3, 3) the shortest rotation from unit vector a to b: carries what is tangent at a to b."""
    x, y, z = a.tolist()
    p, q, r = b.tolist()
    k = _skew(y * r - z * q, z * p - x * r, x * q - y * p)
    rotated: F64 = _EYE + k + k @ k / max(1.0 + x * p + y * q + z * r, 1e-9)
    return rotated


def _log(a: F64, b: F64) -> F64:
    """(3,) tangent at a whose length is the angle to b, and which points there."""
    cosine = float(a @ b)
    across: F64 = b - a * cosine
    sine = math.sqrt(across @ across)
    return across * (math.atan2(sine, cosine) / sine) if sine > 1e-12 else across


def _exp(u: F64, step: F64) -> F64:
    """The unit vector that lies |step| radians from u along a tangent."""
    angle = math.sqrt(step @ step)
    moved: F64 = u * math.cos(angle) + step * _sinc(angle)
    return moved / math.sqrt(moved @ moved)
