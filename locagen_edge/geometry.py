"""The array: positions, pairs, delays, the angles between, and how body and earth are turned to each other.

Axes are MAVLink's FRD: x forward, y right, z down, metres. Azimuth is atan2(y, x), so 0 is ahead and
positive is clockwise seen from above; elevation is positive up. `u` is the unit vector from the array to
the source; pair (i, j), i < j, has the delay t_j - t_i = (p_i - p_j) . u / c: positive when j hears later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from locagen_edge.types import F64, Quaternion

KELVIN = 273.15

LAG_MARGIN_SAMPLES = 0.25
"""Noise moves the peak of a source in line with a pair beyond the longest delay: look a little further."""

FLAT_M = 1e-4
"""Thinner than this an array is flat: 0.1 mm is 0.3 us, a tenth of what a frame's noise leaves."""


def speed_of_sound(temperature_c: float) -> float:
    """Speed of sound in dry air, m/s: 331.3 sqrt(1 + T / 273.15).

    Kinsler, Frey, Coppens & Sanders, *Fundamentals of Acoustics*, 4th ed., section 5.6. Humidity adds at
    most 0.4 % at 20 degrees Celsius, left out: it costs less than a hundredth of a degree of bearing.
    """
    return 331.3 * math.sqrt(1.0 + temperature_c / KELVIN)


def direction(azimuth_rad: float, elevation_rad: float = 0.0) -> F64:
    """Unit vector (3,) in FRD from the array to a source at these angles."""
    horizontal = math.cos(elevation_rad)
    return np.array(
        [
            horizontal * math.cos(azimuth_rad),
            horizontal * math.sin(azimuth_rad),
            -math.sin(elevation_rad),
        ]
    )


def angles(u: F64) -> tuple[float, float]:
    """Azimuth and elevation in radians of a vector (3,) in FRD, of any length above zero."""
    return math.atan2(u[1], u[0]), math.atan2(-u[2], math.hypot(u[0], u[1]))


def tangent(u: F64) -> F64:
    """(2, 3): across a direction (3,), level with the horizon (clockwise) and towards the zenith."""
    x, y, z = u.tolist()
    flat = math.hypot(x, y)
    a, b = (-y / flat, x / flat) if flat > 1e-9 else (0.0, 1.0)
    return np.array([[a, b, 0.0], [b * z, -a * z, a * y - b * x]])


NOWHERE_RAD = math.pi / math.sqrt(3.0)
"""1-sigma of an angle that may be anything: the standard deviation of a uniform one, 104 degrees."""


def wrap(angle_rad: float) -> float:
    """The same angle within -pi (included) to pi (left out)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def compass_deg(angle_rad: float) -> float:
    """Degrees [0, 360) for people."""
    return math.degrees(angle_rad) % 360.0 % 360.0  # twice: -1e-17 % 360 is 360.0


# --- attitude: earth axes are north, east, down, so that azimuth counts from true north -----------------


def quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """The attitude of MAVLink's roll, pitch and yaw: yaw about down first, then pitch, then roll.

    Diebel, "Representing attitude: Euler angles, unit quaternions, and rotation vectors" (2006), section 8.
    """
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def rotation(q: Quaternion) -> F64:
    """(3, 3) matrix that does what `Pose.attitude` says: body (FRD) vectors into the earth's (NED).

    Its transpose turns the earth's into the body's.
    """
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading(q: Quaternion) -> float:
    """Of the body's nose, radians clockwise from true north."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """The attitude `share` of the way from a to b, by the shorter way and at an even rate; a share above 1
    goes on beyond b.

    Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """
    p, q = np.array(a), np.array(b)
    near = float(p @ q)
    if near < 0.0:  # q and -q are one attitude
        q, near = -q, -near
    angle = math.acos(min(near, 1.0))
    if angle < 1e-6:  # sin(x) / x is 1 to 1e-13
        mixed = p + share * (q - p)
    else:
        mixed = (math.sin((1.0 - share) * angle) * p + math.sin(share * angle) * q) / math.sin(angle)
    w, x, y, z = (mixed / np.linalg.norm(mixed)).tolist()
    return (w, x, y, z)


# --- the array ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MicArray:
    """Microphone positions and what follows from them alone."""

    positions_m: F64
    """(mics, 3) FRD"""

    @property
    def mics(self) -> int:
        return len(self.positions_m)

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """(0, 1), (0, 2), ... (1, 2), ...: the order of every (pairs, ...) array, in C too."""
        return tuple((i, j) for i in range(self.mics) for j in range(i + 1, self.mics))

    @cached_property
    def baselines_m(self) -> F64:
        """(pairs, 3): p_i - p_j, so that a delay is baseline . u / c."""
        return np.array([self.positions_m[i] - self.positions_m[j] for i, j in self.pairs])

    @cached_property
    def spacing_m(self) -> F64:
        """(pairs,): distance between the two microphones."""
        distance: F64 = np.linalg.norm(self.baselines_m, axis=1)
        return distance

    @cached_property
    def normal(self) -> F64 | None:
        """(3,) unit vector across a flat array, downwards: it hears a sound and its mirror image alike.

        None for one that is not flat, or on one line.
        """
        _, extent, axes = np.linalg.svd(self.baselines_m)
        if len(extent) < 3 or extent[1] < FLAT_M or extent[2] > FLAT_M:
            return None
        across: F64 = axes[2] * (1.0 if axes[2, 2] >= 0.0 else -1.0)
        return across

    def longest_delay_s(self, speed_m_s: float) -> float:
        """The longest delay that any pair can see, seconds."""
        return float(self.spacing_m.max()) / speed_m_s

    def delays_s(self, u: F64, speed_m_s: float) -> F64:
        """Delays (pairs,) of a plane wave from direction u (3,)."""
        delays: F64 = self.baselines_m @ u / speed_m_s
        return delays


def equilateral(side_m: float = 0.10) -> MicArray:
    """Three microphones around the origin: the first ahead, the others behind right and behind left."""
    radius = side_m / math.sqrt(3.0)
    azimuths = np.radians([0.0, 120.0, 240.0])
    return MicArray(np.stack([radius * np.cos(azimuths), radius * np.sin(azimuths), np.zeros(3)], axis=1))


def tolerance_rad(array: MicArray, tolerance_m: float) -> float:
    """1-sigma of the azimuth of a source on the horizon from position errors alone, worst direction.

    Position errors of 1-sigma `tolerance_m` per axis and microphone, independent: least squares gives
    tolerance / sqrt(sum_m (p_m . v)^2), v across the bearing; the worst v is the smallest eigenvalue's.
    """
    flat = array.positions_m[:, :2] - array.positions_m[:, :2].mean(axis=0)
    spread = np.linalg.eigvalsh(flat.T @ flat)
    seen = spread[spread > 1e-6 * spread[-1]]  # microphones on one line are judged along it
    return tolerance_m / math.sqrt(max(float(seen[0]), 1e-12))
