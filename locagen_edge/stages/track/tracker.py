"""Callers over time: birth, confirmation, coasting and death.

Where the vehicle's attitude is known at a frame's middle, callers are followed in the earth's axes: a drone
that turns under way does not move them, and what is heard adds up. Elsewhere they are followed as the body
sees them. When the attitude comes or goes, every track is turned into the other axes and lives on.

A bearing within no track's gate begins a track, which counts as confirmed when it was heard again in
`CONFIRM_HEARD` of the first `CONFIRM_OF` frames with a bearing, and is dropped otherwise: M of N (Bar-Shalom,
Willett & Tian, *Tracking and Data Fusion*, section 3.4).

Errors of the microphones' positions and of the attitude are the same in every frame and do not average out:
they are kept out of the filter's shrinking and added to the sigma that is told.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from locagen_edge.geometry import NOWHERE_RAD, angles, direction, rotation, tangent
from locagen_edge.settings import PoseSettings, TrackSettings
from locagen_edge.stages.track import filter as sphere
from locagen_edge.stages.track.association import associate
from locagen_edge.types import F64, Bearing, Detection, Quaternion, Track, TrueBearing

GATE2 = (16.0, 19.4)
"""Squared Mahalanobis distance of one and of two components beyond which a bearing is none of this track's:
4 sigma, 1 in 16,000."""
CONFIRM_HEARD, CONFIRM_OF = 3, 5
"""0.15 s of sound at the default hop. A bearing from nowhere is followed by two more within its gates in 3 %
of all cases."""
CONFIDENCE_S = 0.5
"""Time constant of the share of frames that agree."""
BEST_STAYS_S = 0.25
"""The best track stays it while it is heard this often: of two who call at once, one is not told now and the
other then."""
ALIKE_SIGMA = 2.0
ALIKE_RAD = math.radians(10.0)
"""Two tracks closer than both are one caller; heard in one frame, closer than the second: an array of 10 cm
does not tell such two apart."""
SWELL_S = 0.02
"""1-sigma of the moment within a frame of 0.1 s from which most of its sound comes."""
AS_IT_IS: F64 = np.eye(3)
"""body -> earth, where the attitude is not known"""


@dataclass(slots=True)
class _Caller:
    """A track in the making."""

    id: int
    state: sphere.State
    elevation_known: bool
    age_s: float = 0.0
    silent_s: float = 0.0
    confidence: float = 0.0
    heard: int = 1
    chances: int = 1
    """frames with a bearing since birth; in `heard` of them it was this track's"""
    confirmed: bool = False
    look: TrueBearing | None = None

    @property
    def given_up(self) -> bool:
        return not self.confirmed and self.chances - self.heard > CONFIRM_OF - CONFIRM_HEARD

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        return self.confirmed, self.silent_s < BEST_STAYS_S, self.confidence, self.age_s


class Tracker:
    """Follows the callers of one stream.

    `tolerance_rad`: 1-sigma of a bearing from the microphones' positions. `overlap`: frame over hop; frames
    that overlap share their noise, so that each brings less than its sigma says. `normal` (3,) of a flat
    array, body axes: of its two answers a bearing holds the lower as the body sees it, and on a drone that
    leans, a caller near the horizon may be the other.
    """

    def __init__(
        self,
        settings: TrackSettings,
        pose: PoseSettings,
        tolerance_rad: float,
        overlap: float,
        normal: F64 | None = None,
    ):
        self._fixed = tolerance_rad**2
        self._inflation = max(0.75 * overlap, 1.0)  # 1.5 at half overlap: Hann frames correlate by 1/6
        self.apply(settings, pose, normal)
        self._turn: F64 | None = None  # body -> earth, of the last frame
        self._callers: list[_Caller] = []  # the best first
        self._ids = itertools.count(1)

    def apply(self, settings: TrackSettings, pose: PoseSettings, normal: F64 | None = None) -> None:
        """As these settings say from the next frame on; callers keep their tracks and numbers."""
        self._compass, self._tilt = math.radians(pose.compass_deg), math.radians(pose.tilt_deg)
        self._normal = normal
        self._settings = settings
        self._motions = {False: sphere.body_motion(settings), True: sphere.earth_motion(settings)}

    def __call__(
        self,
        bearings: tuple[Bearing, ...],
        detection: Detection,
        elapsed_s: float,
        attitude: Quaternion | None = None,
    ) -> tuple[Track, ...]:
        """All tracks after this frame, the best first. `bearings`: of the sources in it, the strongest first;
        `elapsed_s`: since the previous frame; `attitude`: at the frame's middle."""
        turned_rad = self._predict(elapsed_s, None if attitude is None else rotation(attitude))
        heard = [b for b in bearings if _usable(b)] if detection.call else []
        if heard:
            rate = turned_rad / elapsed_s if elapsed_s > 0.0 else 0.0
            self._hear(heard, rate, elapsed_s)
        self._order()
        return tuple(self._told(caller) for caller in self._callers)

    @property
    def _motion(self) -> sphere.Motion:
        return self._motions[self._turn is not None]

    # --- time goes on

    def _predict(self, dt: float, turn: F64 | None) -> float:
        """To the next frame, and into its axes. Returns by how much the vehicle turned, where known."""
        before = self._turn
        if before is not None and turn is None:
            self._turn = None
            self._change_axes(before.T)
        for caller in self._callers:
            caller.state = sphere.predicted(caller.state, self._motion, dt)
            caller.age_s += dt
            caller.silent_s += dt
            caller.look = None
            caller.confidence *= math.exp(-dt / CONFIDENCE_S)
        self._callers = [c for c in self._callers if c.silent_s <= self._settings.coast_s]
        del self._callers[self._settings.most :]
        self._turn = turn
        if turn is None:
            return 0.0
        if before is None:
            self._change_axes(turn)
            return 0.0
        return math.acos(min(max((float(np.vdot(before, turn)) - 1.0) / 2.0, -1.0), 1.0))  # trace of b^T t

    def _change_axes(self, turn: F64) -> None:
        for caller in self._callers:
            caller.state = sphere.in_other_axes(caller.state, turn, self._motion)

    # --- what is heard

    def _hear(self, bearings: list[Bearing], rate: float, dt: float) -> None:
        turn = AS_IT_IS if self._turn is None else self._turn
        measurements = [
            sphere.measured(
                b,
                turn,
                fixed=self._fixed,
                # of an average over time, each hop brings dt / (2 span) that is new
                inflation=max(self._inflation, 2.0 * b.span_s / max(dt, 1e-3)),
                moved=(rate * max(SWELL_S, b.span_s)) ** 2,
            )
            for b in bearings
        ]
        innovations = [[self._nearest(c.state, m) for c in self._callers] for m in measurements]
        costs = [
            [i.cost if i.distance2 <= GATE2[len(i.off) - 1] else math.inf for i in row] for row in innovations
        ]
        for caller in self._callers:
            caller.chances += 1
        pairing = associate(costs)
        agreed = 1.0 - math.exp(-dt / CONFIDENCE_S)
        for number, place in enumerate(pairing):
            if place is not None:
                caller = self._callers[place]
                caller.state = sphere.updated(caller.state, innovations[number][place], self._motion)
                caller.elevation_known |= measurements[number].elevation is not None
                caller.look = self._look(innovations[number][place].measurement)
                caller.silent_s = 0.0
                caller.heard += 1
                caller.confirmed |= caller.heard >= CONFIRM_HEARD
                caller.confidence += agreed
        self._callers = [caller for caller in self._callers if not caller.given_up]
        self._merge()
        for m, row in zip(measurements, costs, strict=True):
            # left over within a gate: one caller heard twice
            if all(math.isinf(cost) for cost in row) and self._make_room():
                state = sphere.born(m, self._motion)
                known = m.elevation is not None
                caller = _Caller(next(self._ids), state, known, confidence=agreed, look=self._look(m))
                self._callers.append(caller)

    def _nearest(self, state: sphere.State, m: sphere.Measurement) -> sphere.Innovation:
        """Against whichever answer is nearer, of those that are below the true horizon."""
        first = sphere.innovation(state, m)
        if self._normal is None or self._turn is None or m.elevation is None:
            return first
        other = sphere.mirrored(m, self._normal)
        if (self._turn @ direction(other.azimuth, other.elevation or 0.0))[2] <= 0.0:
            return first
        return min(first, sphere.innovation(state, other), key=lambda i: i.cost)

    def _make_room(self) -> bool:
        """Whether one more can be followed; a confirmed caller who is heard now gives way to nobody."""
        if len(self._callers) < self._settings.most:
            return True
        weakest = min(self._callers, key=lambda caller: caller.rank)
        if weakest.confirmed and weakest.silent_s < BEST_STAYS_S:
            return False
        self._callers.remove(weakest)
        return True

    def _merge(self) -> None:
        """Of two tracks of one caller, the surer stays."""
        for a, b in itertools.combinations(sorted(self._callers, key=lambda c: c.rank, reverse=True), 2):
            if self._alike(a.state, b.state, at_once=a.silent_s == b.silent_s == 0.0):
                self._callers = [caller for caller in self._callers if caller is not b]

    def _alike(self, a: sphere.State, b: sphere.State, *, at_once: bool) -> bool:
        off = math.acos(min(max(float(a.u @ b.u), -1.0), 1.0))
        if off > ALIKE_RAD or at_once:
            return off <= ALIKE_RAD
        across = b.u - a.u
        across /= max(float(np.linalg.norm(across)), 1e-12)
        variance = float(across @ (a.p[:3, :3] + b.p[:3, :3]) @ across) + self._fixed
        return off <= ALIKE_SIGMA * math.sqrt(variance)

    def _order(self) -> None:
        """The best first; it stays while it is heard."""
        if not self._callers:
            return
        best = self._callers[0]
        self._callers.sort(key=lambda caller: caller.rank, reverse=True)
        if best.confirmed and best.silent_s < BEST_STAYS_S:
            self._callers.remove(best)
            self._callers.insert(0, best)

    # --- what is told

    def _told(self, caller: _Caller) -> Track:
        turn = AS_IT_IS if self._turn is None else self._turn
        azimuth, azimuth_sigma, elevation, elevation_sigma = self._seen(caller, turn.T)
        return Track(
            azimuth_rad=azimuth,
            azimuth_sigma_rad=azimuth_sigma,
            elevation_rad=elevation,
            elevation_sigma_rad=elevation_sigma,
            age_s=caller.age_s,
            silent_s=caller.silent_s,
            confidence=min(caller.confidence, 1.0),
            id=caller.id,
            confirmed=caller.confirmed,
            earth=None if self._turn is None else self._in_earth(caller),
            look=caller.look,
        )

    def _in_earth(self, caller: _Caller) -> TrueBearing:
        _, slope = angles(caller.state.u)
        # leaning by a wrong angle moves what is below sideways, and what is level up and down
        azimuth, azimuth_sigma, elevation, elevation_sigma = self._seen(
            caller, AS_IT_IS, level=(self._tilt * math.sin(slope)) ** 2, up=self._tilt**2
        )
        azimuth_sigma = min(math.hypot(azimuth_sigma, self._compass), NOWHERE_RAD)
        return TrueBearing(azimuth, azimuth_sigma, elevation, elevation_sigma)

    def _look(self, m: sphere.Measurement) -> TrueBearing | None:
        """One frame's bearing in the earth's axes, with the sigmas of its noise."""
        if self._turn is None:
            return None
        here = direction(m.azimuth, m.elevation or 0.0)
        there = self._turn @ here
        azimuth, elevation = angles(there)
        rows = tangent(there) @ self._turn @ tangent(here).T
        level, up = (rows**2 @ np.array([m.level_variance, m.up_variance])).tolist()
        azimuth_sigma = min(math.sqrt(level) / max(math.cos(elevation), 1e-9), NOWHERE_RAD)
        known = m.elevation is not None
        elevation_sigma = min(math.sqrt(up), NOWHERE_RAD) if known else NOWHERE_RAD
        return TrueBearing(azimuth, azimuth_sigma, elevation if known else None, elevation_sigma)

    def _seen(
        self, caller: _Caller, turn: F64, level: float = 0.0, up: float = 0.0
    ) -> tuple[float, float, float | None, float]:
        """Azimuth, elevation and their sigmas in the axes that `turn` leads to; `level` and `up` are
        variances on top, rad^2 across the direction."""
        u = turn @ caller.state.u
        azimuth, elevation = angles(u)
        across = tangent(u) @ turn
        variance = ((across @ caller.state.p[:3, :3] * across).sum(axis=1) + self._fixed).tolist()
        azimuth_sigma = math.sqrt(variance[0] + level) / max(math.cos(elevation), 1e-9)
        if not caller.elevation_known:
            return azimuth, min(azimuth_sigma, NOWHERE_RAD), None, NOWHERE_RAD
        elevation_sigma = min(math.sqrt(variance[1] + up), NOWHERE_RAD)
        return azimuth, min(azimuth_sigma, NOWHERE_RAD), elevation, elevation_sigma


def _usable(bearing: Bearing) -> bool:
    """Whether it says anything; one NaN would stay in a track for ever."""
    elevation = (
        (0.0, 0.0) if bearing.elevation_rad is None else (bearing.elevation_rad, bearing.elevation_sigma_rad)
    )
    return bearing.azimuth_rad is not None and all(
        map(math.isfinite, (bearing.azimuth_rad, bearing.azimuth_sigma_rad, *elevation))
    )
