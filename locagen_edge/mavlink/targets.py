"""A caller's place in messages that every ground station knows: as traffic, or as a camera's target.

Both are switched off by default. ADSB_VEHICLE is drawn on every map, and ArduPilot forwards it while it does
not use ADS-B itself (ADSB_TYPE 0); where it does, it may steer away from what it takes for an aircraft.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from locagen_edge.mavlink.dialect import messages

_UNKNOWN_HEIGHT_MM = 0
_ADDRESSES, _NUMBERS = 0xF00000, 0x8000
"""the block that ICAO keeps for temporary addresses (Annex 10, volume III): no aircraft's own"""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a caller is estimated to be."""

    event_id: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    """above mean sea level"""
    sigma_m: float
    """1-sigma, the greater semi-axis"""
    age_s: float
    """since the last bearing that went in"""

    @property
    def somewhere(self) -> bool:
        """Whether it is a place on earth at all; NaN is none."""
        return abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 180.0


def adsb_vehicle(place: Place) -> Any:
    """ADSB_VEHICLE, standing still, called CALL and the event's number; no category of aircraft."""
    flags = messages.ADSB_FLAGS_VALID_COORDS | messages.ADSB_FLAGS_VALID_CALLSIGN
    altitude_mm = _UNKNOWN_HEIGHT_MM
    if place.altitude_m is not None and abs(place.altitude_m) < 2e6:
        altitude_mm = round(place.altitude_m * 1000.0)
        flags |= messages.ADSB_FLAGS_VALID_ALTITUDE
    number = max(place.event_id, 0)
    return messages.MAVLink_adsb_vehicle_message(
        ICAO_address=_ADDRESSES + number % _NUMBERS,
        lat=round(place.latitude_deg * 1e7),
        lon=round(place.longitude_deg * 1e7),
        altitude_type=messages.ADSB_ALTITUDE_TYPE_GEOMETRIC,
        altitude=altitude_mm,
        heading=0,
        hor_velocity=0,
        ver_velocity=0,
        callsign=f"CALL{number % 10000}".encode("ascii"),
        emitter_type=messages.ADSB_EMITTER_TYPE_POINT_OBSTACLE,
        tslc=_seconds(place.age_s),
        flags=flags,
        squawk=0,
    )


def camera_target(place: Place, from_deg: tuple[float, float] | None = None) -> Any:
    """CAMERA_TRACKING_GEO_STATUS. `from_deg`: the vehicle's latitude and longitude, for the way."""
    distance, heading = _way(from_deg, place) if from_deg else (math.nan, math.nan)
    return messages.MAVLink_camera_tracking_geo_status_message(
        tracking_status=messages.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
        lat=round(place.latitude_deg * 1e7),
        lon=round(place.longitude_deg * 1e7),
        alt=math.nan if place.altitude_m is None else _clamped(place.altitude_m),
        h_acc=_clamped(place.sigma_m),
        v_acc=math.nan,
        vel_n=math.nan,
        vel_e=math.nan,
        vel_d=math.nan,
        vel_acc=math.nan,
        dist=distance,
        hdg=heading,
        hdg_acc=math.nan,
    )


def _way(from_deg: tuple[float, float], place: Place) -> tuple[float, float]:
    """Metres and radians clockwise from north, on a sphere: good for what can be heard."""
    north = math.radians(place.latitude_deg - from_deg[0])
    east = math.radians((place.longitude_deg - from_deg[1] + 180.0) % 360.0 - 180.0)
    east *= math.cos(math.radians(from_deg[0]))
    return 6_371_000.0 * math.hypot(north, east), math.atan2(east, north)


def _clamped(metres: float) -> float:
    """Within what float32 holds; NaN stays NaN."""
    return metres if math.isnan(metres) else min(max(metres, -1e9), 1e9)


def _seconds(age_s: float) -> int:
    return min(max(round(age_s), 0), 255) if math.isfinite(age_s) else 255
