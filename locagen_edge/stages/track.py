"""Bearing and Detection -> Track: one caller over time, in body axes.

A Kalman filter of azimuth and its rate with white-noise acceleration (Bar-Shalom, Li & Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, section 6.2), so that it does not lag behind a
drone that turns; elevation is a random walk. It is born with the first call, rejects what lies beyond its
gate, coasts through pauses and dies after `track.coast_s`.

Errors from the microphones' positions are the same in every frame and do not average out: they are kept
out of the filter's shrinking and added to the sigma that is told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from locagen_edge.geometry import wrap
from locagen_edge.settings import TrackSettings
from locagen_edge.types import F64, Bearing, Detection, Track

GATE_SIGMA = 4.0
LOST_AFTER = 5
"""Calls in a row outside the gate after which the track gives way to them."""
FIRST_RATE_RAD_S = math.radians(30.0)
"""1-sigma of the unknown rate at birth: a drone's brisk yaw."""
ELEVATION_WALK_RAD = math.radians(3.0)
"""Random walk of the elevation, per square root of a second."""
CONFIDENCE_S = 0.5
"""Time constant of the share of frames that agree."""


@dataclass
class _State:
    x: F64  # azimuth (not wrapped while it lives), rate
    p: F64
    elevation: float | None
    elevation_variance: float
    age_s: float = 0.0
    silent_s: float = 0.0
    outside: int = 0
    confidence: float = 0.0


class Tracker:
    """Follows one caller. One per stream.

    `tolerance_rad`: 1-sigma of a bearing from the microphones' positions. `overlap`: frame over hop; frames
    that overlap share their noise, so that each brings less than its sigma says.
    """

    def __init__(self, settings: TrackSettings, tolerance_rad: float, overlap: float):
        self._settings = settings
        self._fixed = tolerance_rad**2
        self._inflation = max(0.75 * overlap, 1.0)  # 1.5 at half overlap: Hann frames correlate by 1/6
        self._state: _State | None = None

    def __call__(self, bearing: Bearing, detection: Detection, elapsed_s: float) -> Track | None:
        """`elapsed_s`: since the previous frame."""
        state = self._state
        if state is not None:
            self._predict(state, elapsed_s)
            if state.silent_s > self._settings.coast_s:
                state = None
        heard = detection.call and bearing.azimuth_rad is not None
        if heard and state is None:
            state = self._born(bearing)
        elif heard and state is not None:
            if self._agrees(state, bearing):
                self._update(state, bearing)
            elif state.outside >= LOST_AFTER:
                state = self._born(bearing)
            if state.outside == 0:
                state.confidence += 1.0 - math.exp(-elapsed_s / CONFIDENCE_S)
        self._state = state
        return None if state is None else self._told(state)

    def _noise(self, sigma: float) -> float:
        return max(sigma**2 - self._fixed, (0.1 * sigma) ** 2) * self._inflation

    def _born(self, bearing: Bearing) -> _State:
        assert bearing.azimuth_rad is not None
        variance = self._noise(bearing.azimuth_sigma_rad)
        return _State(
            x=np.array([bearing.azimuth_rad, 0.0]),
            p=np.diag([variance, FIRST_RATE_RAD_S**2]),
            elevation=bearing.elevation_rad,
            elevation_variance=bearing.elevation_sigma_rad**2,
        )

    def _predict(self, state: _State, dt: float) -> None:
        f = np.array([[1.0, dt], [0.0, 1.0]])
        q = math.radians(self._settings.agility_deg_s2) ** 2
        state.x = f @ state.x
        state.p = f @ state.p @ f.T + q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        state.elevation_variance += ELEVATION_WALK_RAD**2 * dt
        state.age_s += dt
        state.silent_s += dt
        state.confidence *= math.exp(-dt / CONFIDENCE_S)

    def _agrees(self, state: _State, bearing: Bearing) -> bool:
        assert bearing.azimuth_rad is not None
        variance = state.p[0, 0] + self._noise(bearing.azimuth_sigma_rad) + self._fixed
        inside = abs(wrap(bearing.azimuth_rad - state.x[0])) <= GATE_SIGMA * math.sqrt(variance)
        state.outside = 0 if inside else state.outside + 1
        return inside

    def _update(self, state: _State, bearing: Bearing) -> None:
        assert bearing.azimuth_rad is not None
        innovation = wrap(bearing.azimuth_rad - state.x[0])
        gain = state.p[:, 0] / (state.p[0, 0] + self._noise(bearing.azimuth_sigma_rad))
        state.x = state.x + gain * innovation
        state.p = state.p - np.outer(gain, state.p[0])
        state.silent_s = 0.0
        if bearing.elevation_rad is not None:
            variance = bearing.elevation_sigma_rad**2 * self._inflation
            old = bearing.elevation_rad if state.elevation is None else state.elevation
            share = state.elevation_variance / (state.elevation_variance + variance)
            state.elevation = old + share * (bearing.elevation_rad - old)
            state.elevation_variance *= 1.0 - share

    def _told(self, state: _State) -> Track:
        return Track(
            azimuth_rad=wrap(float(state.x[0])),
            azimuth_sigma_rad=math.sqrt(float(state.p[0, 0]) + self._fixed),
            elevation_rad=state.elevation,
            elevation_sigma_rad=math.sqrt(state.elevation_variance),
            age_s=state.age_s,
            silent_s=state.silent_s,
            confidence=min(state.confidence, 1.0),
        )
