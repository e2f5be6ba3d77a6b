"""The whole record of a bearing or a position, as one message that nothing can tear apart.

LOCAGEN_BEARING and LOCAGEN_POSITION (`locagen.xml`; field tables in docs/mavlink.md) hold what
NAMED_VALUE_FLOAT tells piecemeal, with the vehicle's pose at the moment of the sound, and "nothing heard"
too. `dialect.tunnel` packs the same bytes for paths that drop unknown ids. Here is where radians and None
become what the wire carries: degrees and NaN, clamped, because the generated code raises on an integer that
does not fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from locagen_edge.geometry import compass_deg
from locagen_edge.mavlink.dialect import messages
from locagen_edge.types import Pose

UNKNOWN = 0x7FFFFFFF
"""INT32_MAX: an integer that is not known"""


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingRecord:
    """What LOCAGEN_BEARING says. None: not known."""

    time_us: int
    """of the sound's middle"""
    autopilot_time: bool
    """`time_us` is on the autopilot's clock, not on ours since boot"""
    event_id: int
    """the call's number; 0: nothing heard"""
    azimuth_body_rad: float | None = None
    azimuth_true_rad: float | None = None
    azimuth_sigma_rad: float | None = None
    elevation_rad: float | None = None
    elevation_sigma_rad: float | None = None
    confidence: float | None = None
    snr_db: float | None = None
    noise_dbfs: float | None = None
    pose: Pose | None = None
    """at the time of the sound"""
    call: int = messages.LOCAGEN_CALL_UNKNOWN
    confirmed: bool = False
    ambiguous: bool = False
    microphone_fault: bool = False
    simulated: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionRecord:
    """What LOCAGEN_POSITION says."""

    time_us: int
    autopilot_time: bool
    event_id: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    """above mean sea level"""
    covariance_m2: tuple[float, float, float]
    """north-north, north-east, east-east"""
    age_s: float
    """since the last bearing that went in"""
    looks: int
    """bearings that went in"""
    triangulated: bool = False
    on_ground: bool = False
    confirmed: bool = False
    simulated: bool = False


def bearing_message(record: BearingRecord) -> Any:
    """LOCAGEN_BEARING. Takes any number in any field: what cannot be is clamped, or not known."""
    body, true = _azimuth(record.azimuth_body_rad), _azimuth(record.azimuth_true_rad)
    elevation = _degrees(record.elevation_rad, -90, 90)
    pose = record.pose or Pose(0, None)
    lat, lon = _place(pose.latitude_deg, pose.longitude_deg)
    q = tuple(_clamped(value, -1, 1) for value in pose.attitude or (None,) * 4)
    return messages.MAVLink_locagen_bearing_message(
        time_usec=_unsigned(record.time_us, 64),
        event_id=_unsigned(record.event_id, 32),
        azimuth_body=body,
        azimuth_true=true,
        azimuth_sigma=_degrees(record.azimuth_sigma_rad, 0, 180),
        elevation=elevation,
        elevation_sigma=_degrees(record.elevation_sigma_rad, 0, 90),
        confidence=_clamped(record.confidence, 0, 1),
        snr=_clamped(record.snr_db, -200, 200),
        noise_level=_clamped(record.noise_dbfs, -200, 50),
        lat=lat,
        lon=lon,
        alt=_millimetres(pose.altitude_m),
        height=_clamped(pose.height_m, -1e5, 1e5),
        q=q,
        flags=_bits(
            (record.event_id <= 0, messages.LOCAGEN_BEARING_FLAGS_NOTHING_HEARD),
            (record.autopilot_time, messages.LOCAGEN_BEARING_FLAGS_AUTOPILOT_TIME),
            (not math.isnan(body), messages.LOCAGEN_BEARING_FLAGS_AZIMUTH_BODY_VALID),
            (not math.isnan(true), messages.LOCAGEN_BEARING_FLAGS_AZIMUTH_TRUE_VALID),
            (not math.isnan(elevation), messages.LOCAGEN_BEARING_FLAGS_ELEVATION_VALID),
            (not any(map(math.isnan, q)), messages.LOCAGEN_BEARING_FLAGS_ATTITUDE_VALID),
            (lat != UNKNOWN, messages.LOCAGEN_BEARING_FLAGS_POSITION_VALID),
            (record.confirmed, messages.LOCAGEN_BEARING_FLAGS_CONFIRMED),
            (record.ambiguous, messages.LOCAGEN_BEARING_FLAGS_AMBIGUOUS),
            (record.microphone_fault, messages.LOCAGEN_BEARING_FLAGS_MICROPHONE_FAULT),
            (record.simulated, messages.LOCAGEN_BEARING_FLAGS_SIMULATED),
        ),
        call=_unsigned(record.call, 8),
    )


def position_message(record: PositionRecord) -> Any:
    """LOCAGEN_POSITION. Raises `ValueError` for a place that is none: nobody is sent there."""
    lat, lon = _place(record.latitude_deg, record.longitude_deg)
    if lat == UNKNOWN:
        raise ValueError(f"no place on earth: {record.latitude_deg}, {record.longitude_deg}")
    alt = _millimetres(record.altitude_m)
    nn, ne, ee = (_clamped(value, -1e12, 1e12) for value in record.covariance_m2)
    return messages.MAVLink_locagen_position_message(
        time_usec=_unsigned(record.time_us, 64),
        event_id=_unsigned(record.event_id, 32),
        lat=lat,
        lon=lon,
        alt=alt,
        covariance_nn=nn,
        covariance_ne=ne,
        covariance_ee=ee,
        age=_clamped(record.age_s, 0, 1e6),
        looks=_unsigned(record.looks, 16),
        flags=_bits(
            (record.autopilot_time, messages.LOCAGEN_POSITION_FLAGS_AUTOPILOT_TIME),
            (alt != UNKNOWN, messages.LOCAGEN_POSITION_FLAGS_ALTITUDE_VALID),
            (record.triangulated, messages.LOCAGEN_POSITION_FLAGS_TRIANGULATED),
            (record.on_ground, messages.LOCAGEN_POSITION_FLAGS_ON_GROUND),
            (record.confirmed, messages.LOCAGEN_POSITION_FLAGS_CONFIRMED),
            (record.simulated, messages.LOCAGEN_POSITION_FLAGS_SIMULATED),
        ),
    )


def _bits(*held: tuple[bool, int]) -> int:
    return sum(bit for holds, bit in held if holds)


def _clamped(value: float | None, least: float, most: float) -> float:
    """NaN stays NaN: `min` and `max` alone would make a limit of it."""
    return math.nan if value is None or math.isnan(value) else min(max(float(value), least), most)


def _degrees(angle_rad: float | None, least: float, most: float) -> float:
    return math.nan if angle_rad is None else _clamped(math.degrees(angle_rad), least, most)


def _azimuth(angle_rad: float | None) -> float:
    """[0, 360) as float32 rounds it; NaN for what is no angle."""
    if angle_rad is None or not math.isfinite(angle_rad):
        return math.nan
    degrees = compass_deg(angle_rad)
    return 0.0 if degrees > 360 - 1.6e-5 else degrees  # float32 has no number between this and 360


def _unsigned(value: int, bits: int) -> int:
    return min(max(value, 0), (1 << bits) - 1)


def _place(latitude_deg: float | None, longitude_deg: float | None) -> tuple[int, int]:
    """degE7, both or neither."""
    if latitude_deg is None or longitude_deg is None:
        return UNKNOWN, UNKNOWN
    if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180):  # NaN too
        return UNKNOWN, UNKNOWN
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7)


def _millimetres(metres: float | None) -> int:
    """A metre that is no number, or farther than the wire reaches (2147 km), is not known."""
    if metres is None or not abs(metres) < 2.1e6:
        return UNKNOWN
    return round(metres * 1000)
