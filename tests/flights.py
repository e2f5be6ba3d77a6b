"""A flight past somebody who calls: the sound that the drone's microphones hear, and its poses beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from locagen_edge.framing import Framer, Tap, as_captured
from locagen_edge.geodesy import moved, north_east_down_m
from locagen_edge.geometry import quaternion, rotation
from locagen_edge.settings import Settings
from locagen_edge.sim.scene import Scene
from locagen_edge.types import F64, Frame, Pose

CALLER = (47.0, 8.0)
"""latitude, longitude, degrees"""
GROUND_M = 400.0
HEIGHT_M = 15.0
SOUTH_M = 25.0
"""of the caller, the line that is flown"""
SPEED_M_S = 8.0


def pose(time_s: float, t_ns: int) -> Pose:
    """East along a line south of the caller, nose down and swaying, heading about north-east."""
    lat, lon, _ = moved(*CALLER, 0.0, _place_m(time_s))
    attitude = quaternion(
        math.radians(5.0 * math.sin(time_s)),
        math.radians(-8.0),
        math.radians(60.0 + 15.0 * math.sin(0.7 * time_s)),
    )
    return Pose(t_ns, attitude, lat, lon, GROUND_M + HEIGHT_M, HEIGHT_M, 0.5)


def _place_m(time_s: float) -> F64:
    return np.array([-SOUTH_M, SPEED_M_S * (time_s - 5.0), 0.0])


class _Passing(Scene):
    def source_m(self, time_s: F64) -> F64:
        """Where the caller is at these times (...): (..., 3) in body axes."""
        bodies = []
        for at in np.ravel(time_s):
            attitude = pose(float(at), 0).attitude
            assert attitude is not None
            away = -_place_m(float(at)) + [0.0, 0.0, HEIGHT_M]
            bodies.append(rotation(attitude).T @ away)
        return np.reshape(bodies, (*np.shape(time_s), 3))


def frames(settings: Settings, seconds: float, tap: Tap | None = None, origin_ns: int = 0) -> Iterator[Frame]:
    """What is heard, each frame with the pose at its middle; after 5 s the caller is abeam."""
    audio = settings.audio
    scene = _Passing(settings)
    framer = Framer(audio.frame, audio.hop, settings.mic_array.mics, audio.rate_hz, origin_ns)
    for _ in range(round(seconds / settings.hop_s)):
        block = scene.render(audio.hop)
        if tap is not None:
            tap.block(as_captured(block, audio.channel_map), audio.rate_hz, framer.origin_ns)
        for frame in framer.push(block):
            at_s = (frame.middle_ns - origin_ns) * 1e-9
            yield replace(frame, pose=pose(at_s, frame.middle_ns))


def miss_m(latitude_deg: float, longitude_deg: float) -> float:
    """How far a place is from the caller's."""
    return float(np.linalg.norm(north_east_down_m(latitude_deg, longitude_deg, 0.0, *CALLER, 0.0)[:2]))
