"""From two GPS fixes and a heading to azimuth and range, on the WGS-84 ellipsoid (NIMA TR8350.2)."""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.types import F64

EQUATOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)


def centred_m(lat_deg: float, lon_deg: float, alt_m: float) -> F64:
    """(3,) from the middle of the earth, turning with it."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    across = EQUATOR_M / math.sqrt(1.0 - ECCENTRICITY_2 * math.sin(lat) ** 2)
    flat = (across + alt_m) * math.cos(lat)
    up = (across * (1.0 - ECCENTRICITY_2) + alt_m) * math.sin(lat)
    return np.array([flat * math.cos(lon), flat * math.sin(lon), up])


def north_east_down_m(
    lat_deg: float, lon_deg: float, alt_m: float, from_lat_deg: float, from_lon_deg: float, from_alt_m: float
) -> F64:
    """(3,) metres from the second place to the first along north, east and down of the second."""
    lat, lon = math.radians(from_lat_deg), math.radians(from_lon_deg)
    away = centred_m(lat_deg, lon_deg, alt_m) - centred_m(from_lat_deg, from_lon_deg, from_alt_m)
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    return np.array([away @ north, away @ east, away @ np.cross(north, east)])
