"""Flights past a caller: sightings as a vehicle would make them, with the caller's true place beside.

Nothing here knows how positions are found. Errors are those of the things themselves: attitude and compass
turn the direction as a rotation of the body, a level array measures both horizontal direction cosines equally
well (so azimuths blur towards straight below, elevations towards the horizon, and noise beyond it reads as
the horizon), GPS and height are off by the same for the whole flight, the ground at the caller is higher or
lower than below the vehicle, and the caller strays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from locagen_edge import geodesy
from locagen_edge.types import F64, Sighting


@dataclass(frozen=True)
class Errors:
    """1-sigma of all that is wrong with a flight."""

    cosine_rad: float = math.radians(1.0)
    """of each look's direction cosines: azimuth / cos(depression), elevation / sin(depression)"""
    compass_rad: float = math.radians(2.0)
    tilt_rad: float = math.radians(1.0)
    """about either horizontal axis"""
    gps_m: float = 1.5
    height_m: float = 0.5
    terrain_m: float = 1.0
    terrain_share: float = 0.03
    """the same per metre of distance, at the first look"""
    walk_m: float = 0.1
    """of the caller, per square root of a second"""


@dataclass(frozen=True, eq=False)
class Path:
    """Where a vehicle is at each look."""

    time_s: F64
    """(looks,)"""
    place_m: F64
    """(looks, 2) north, east"""
    height_m: F64
    """(looks,) above the ground"""
    yaw_rad: F64
    """(looks,) of the nose, clockwise from true north"""


@dataclass(frozen=True)
class Flight:
    """What was seen, and where the caller was at the last look."""

    sightings: tuple[Sighting, ...]
    latitude_deg: float
    longitude_deg: float
    caller_m: F64 = field(repr=False)
    """(looks, 2) north, east of the origin"""
    rise_m: float
    """of the ground at the caller over that below the vehicle"""


def line(
    seconds: float, rate_hz: float, start_m: F64, speed_m_s: float, course_rad: float, height_m: float
) -> Path:
    """A straight leg with the nose along it; speed 0 is a hover."""
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    course = np.array([math.cos(course_rad), math.sin(course_rad)])
    return Path(
        time,
        start_m + speed_m_s * time[:, None] * course,
        np.full(len(time), height_m),
        np.full(len(time), course_rad),
    )


def orbit(
    seconds: float, rate_hz: float, centre_m: F64, radius_m: float, speed_m_s: float, height_m: float
) -> Path:
    """An arc, clockwise from its north, with the nose to its centre."""
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    angle = speed_m_s / radius_m * time
    place = centre_m + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Path(time, place, np.full(len(time), height_m), angle + math.pi)


def fly(
    path: Path,
    caller_m: F64,
    errors: Errors,
    rng: np.random.Generator,
    *,
    origin: tuple[float, float] = (47.0, 8.0),
    observer: str = "A",
    caller: int = 1,
    ground_m: float = 400.0,
    elevations: bool = True,
    heights: bool = True,
    like: Flight | None = None,
) -> Flight:
    """Sightings along a path of a caller who begins `caller_m` (2,) north and east of `origin` (degrees).

    `ground_m` is the altitude of the ground below the vehicle. `like`: the flight of another vehicle with as
    many looks, whose caller, walk and ground are the same.
    """
    step = np.diff(path.time_s, prepend=path.time_s[0])
    strays = errors.walk_m * np.sqrt(step)[:, None] * rng.standard_normal((len(step), 2))
    distance = math.hypot(*(caller_m - path.place_m[0]))
    rise = math.hypot(errors.terrain_m, errors.terrain_share * distance) * rng.standard_normal()
    true = caller_m + np.cumsum(strays, axis=0)
    if like is not None:
        rise, true = like.rise_m, like.caller_m
    offset = errors.gps_m * rng.standard_normal(2)
    lift = errors.height_m * rng.standard_normal()
    compass = errors.compass_rad * rng.standard_normal()
    tilt = errors.tilt_rad * rng.standard_normal(2)
    sightings = []
    for k, time_s in enumerate(path.time_s):
        away = np.array([*(true[k] - path.place_m[k]), path.height_m[k] - rise])
        ahead = np.array([math.cos(path.yaw_rad[k]), math.sin(path.yaw_rad[k]), 0.0])
        right = np.array([-ahead[1], ahead[0], 0.0])
        wrong = tilt[0] * ahead + tilt[1] * right + np.array([0.0, 0.0, compass])
        seen = _turned(away / np.linalg.norm(away), wrong)
        level = seen[:2] + errors.cosine_rad * rng.standard_normal(2)
        azimuth, cosine = math.atan2(level[1], level[0]), min(math.hypot(level[0], level[1]), 1.0)
        sine = math.sqrt(1.0 - cosine**2)
        north, east = path.place_m[k] + offset
        lat, lon, _ = geodesy.moved(*origin, 0.0, np.array([north, east, 0.0]))
        # north there is not north at the origin
        turn = geodesy.axes(lat, lon) @ geodesy.axes(*origin).T
        local = turn @ np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        sightings.append(
            Sighting(
                t_ns=round(time_s * 1e9),
                observer=observer,
                caller=caller,
                latitude_deg=lat,
                longitude_deg=lon,
                altitude_m=ground_m + float(path.height_m[k] + lift),
                height_m=float(path.height_m[k] + lift) if heights else None,
                height_sigma_m=errors.height_m,
                azimuth_rad=math.atan2(local[1], local[0]),
                azimuth_sigma_rad=min(errors.cosine_rad / max(cosine, 1e-9), math.pi / math.sqrt(3.0)),
                elevation_rad=-math.acos(cosine) if elevations else None,
                elevation_sigma_rad=errors.cosine_rad / max(sine, errors.cosine_rad) if elevations else 0.0,
                heading_rad=float(path.yaw_rad[k]) + math.atan2(turn[1, 0], turn[0, 0]),
                azimuth_bias_sigma_rad=errors.compass_rad,
                elevation_bias_sigma_rad=errors.tilt_rad,
                position_sigma_m=errors.gps_m,
            )
        )
    lat, lon, _ = geodesy.moved(*origin, 0.0, np.array([true[-1, 0], true[-1, 1], 0.0]))
    return Flight(tuple(sightings), lat, lon, true, rise)


def drawn(rng: np.random.Generator) -> Flight:
    """A flight of any kind: a leg, a hover, an orbit, a leg without elevations; 6 to 15 s at 2 looks a
    second, 10 to 50 m high, a caller 8 to 120 m away, with good and bad sensors."""
    errors = Errors(
        cosine_rad=math.radians(rng.uniform(0.5, 4.0)),
        compass_rad=math.radians(rng.uniform(0.5, 4.0)),
        tilt_rad=math.radians(rng.uniform(0.3, 2.0)),
        gps_m=rng.uniform(0.5, 3.0),
        height_m=rng.uniform(0.2, 2.0),
    )
    azimuth, course = rng.uniform(0.0, 2.0 * math.pi, 2)
    caller = math.exp(rng.uniform(math.log(8.0), math.log(120.0))) * np.array(
        [math.cos(azimuth), math.sin(azimuth)]
    )
    height, seconds, kind = rng.uniform(10.0, 50.0), rng.uniform(6.0, 15.0), rng.integers(4)
    if kind == 0:
        path = line(seconds, 2.0, np.zeros(2), rng.uniform(2.0, 8.0), course, height)
    elif kind == 1:
        path = line(seconds, 2.0, np.zeros(2), 0.0, course, height)
    elif kind == 2:
        centre = caller + rng.normal(0.0, 5.0, 2)
        path = orbit(seconds, 2.0, centre, rng.uniform(15.0, 50.0), rng.uniform(2.0, 8.0), height)
    else:
        aside = azimuth + rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.6)
        path = line(seconds, 2.0, np.zeros(2), rng.uniform(4.0, 10.0), aside, height)
    return fly(path, caller, errors, rng, elevations=bool(kind != 3))


def _turned(vector: F64, rotation: F64) -> F64:
    """A vector after a rotation vector (radians), by Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0.0:
        return vector
    axis = rotation / angle
    turned: F64 = (
        vector * math.cos(angle)
        + np.cross(axis, vector) * math.sin(angle)
        + axis * (axis @ vector) * (1.0 - math.cos(angle))
    )
    return turned


def miss_m(flight: Flight, latitude_deg: float, longitude_deg: float) -> F64:
    """(2,) north and east from the caller's true place to a told one."""
    away = geodesy.north_east_down_m(
        latitude_deg, longitude_deg, 0.0, flight.latitude_deg, flight.longitude_deg, 0.0
    )
    return away[:2]


def normalised_error(flight: Flight, latitude_deg: float, longitude_deg: float, covariance_m2: F64) -> float:
    """Normalised estimation error squared: chi-square with 2 degrees of freedom where the covariance is true.

    Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 5.4.
    """
    miss = miss_m(flight, latitude_deg, longitude_deg)
    return float(miss @ np.linalg.solve(covariance_m2, miss))
