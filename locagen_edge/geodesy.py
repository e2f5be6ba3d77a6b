"""Places on the WGS-84 ellipsoid (NIMA TR8350.2, chapter 3) and the local planes on them.

Earth axes are north, east, down at a place, metres. Altitudes above mean sea level are taken as heights above
the ellipsoid: the 100 m between the two stretch the ground by less than 2 parts in 100 000.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.types import F64

EQUATOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
POLE_M = EQUATOR_M * (1.0 - FLATTENING)


def centred_m(lat_deg: float, lon_deg: float, alt_m: float) -> F64:
    """(3,) from the middle of the earth, turning with it."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    across = EQUATOR_M / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(lat) ** 2)
    flat = (across + alt_m) * math.cos(lat)
    up = (across * (1.0 - ECCENTRICITY_2) + alt_m) * math.sin(lat)
    return np.array([flat * math.cos(lon), flat * math.sin(lon), up])


def geodetic(centred: F64) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and altitude in metres of (3,) from the middle of the earth.

    Bowring, "Transformation from spatial to geographical coordinates", Survey Review 23, 1976, twice: below a
    micrometre anywhere a drone flies.
    """
    x, y, z = (float(value) for value in centred)
    flat = math.hypot(x, y)
    reduced = math.atan2(z * EQUATOR_M, flat * POLE_M)
    for _ in range(2):
        lat = math.atan2(
            z + ECCENTRICITY_2 / (1.0 - ECCENTRICITY_2) * POLE_M * math.sin(reduced) ** 3,
            flat - ECCENTRICITY_2 * EQUATOR_M * math.cos(reduced) ** 3,
        )
        reduced = math.atan2((1.0 - FLATTENING) * math.sin(lat), math.cos(lat))
    across = EQUATOR_M / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(lat) ** 2)
    # along the ellipsoid's normal: holds at the poles too, where flat / cos(lat) does not
    alt = flat * math.cos(lat) + z * math.sin(lat) - EQUATOR_M**2 / across
    return math.degrees(lat), math.degrees(math.atan2(y, x)), alt


def axes(lat_deg: float, lon_deg: float) -> F64:
    """(3, 3): its rows are north, east and down of a place, in centred axes."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    down = np.array([-math.cos(lat) * math.cos(lon), -math.cos(lat) * math.sin(lon), -math.sin(lat)])
    return np.stack([north, east, down])


def north_east_down_m(
    lat_deg: float, lon_deg: float, alt_m: float, from_lat_deg: float, from_lon_deg: float, from_alt_m: float
) -> F64:
    """(3,) metres from the second place to the first along north, east and down of the second."""
    away = centred_m(lat_deg, lon_deg, alt_m) - centred_m(from_lat_deg, from_lon_deg, from_alt_m)
    local: F64 = axes(from_lat_deg, from_lon_deg) @ away
    return local


def moved(lat_deg: float, lon_deg: float, alt_m: float, north_east_down: F64) -> tuple[float, float, float]:
    """Latitude, longitude (degrees) and altitude (m) of the place (3,) metres along these axes of another."""
    return geodetic(centred_m(lat_deg, lon_deg, alt_m) + north_east_down @ axes(lat_deg, lon_deg))
