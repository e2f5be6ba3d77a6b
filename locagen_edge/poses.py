"""Poses beside a recording: each as a record, and the pose at a time from those around it."""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_left
from collections.abc import Iterable

from locagen_edge.geometry import slerp
from locagen_edge.jsonl import Record
from locagen_edge.types import Pose

LIMIT_NS = 500_000_000
"""Between poses further apart nothing is known."""
NUMBERS = tuple(f.name for f in dataclasses.fields(Pose) if f.name not in ("t_ns", "attitude"))


def record_of(pose: Pose) -> Record:
    """The record of a pose, to the last bit; what is not known or not finite is left out."""
    numbers = {name: getattr(pose, name) for name in NUMBERS}
    record: Record = {"type": "pose", "t_ns": pose.t_ns}
    record |= {name: value for name, value in numbers.items() if value is not None and math.isfinite(value)}
    if pose.attitude is not None and all(map(math.isfinite, pose.attitude)):
        record["attitude"] = list(pose.attitude)
    return record


def pose_of(record: Record) -> Pose | None:
    """The pose of a record, None for a record of another kind or form."""
    t_ns, attitude = record.get("t_ns"), record.get("attitude")
    if record.get("type") != "pose" or type(t_ns) is not int:
        return None
    numbers = {name: record[name] for name in NUMBERS if name in record}
    if not all(map(_is_number, numbers.values())):
        return None
    if attitude is None:
        return Pose(t_ns, None, **numbers)
    if not isinstance(attitude, list) or len(attitude) != 4 or not all(map(_is_number, attitude)):
        return None
    w, x, y, z = attitude
    if not 0.9 < math.hypot(w, x, y, z) < 1.1:
        return None
    return Pose(t_ns, (w, x, y, z), **numbers)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class Poses:
    """Those of one clock, in any order."""

    def __init__(self, poses: Iterable[Pose]) -> None:
        self._poses = sorted(poses, key=lambda pose: pose.t_ns)
        self._times = [pose.t_ns for pose in self._poses]

    def at(self, t_ns: int) -> Pose | None:
        """The pose of this time, or one between its neighbours; None before the first and after the last."""
        after = bisect_left(self._times, t_ns)
        if after == len(self._poses):
            return None
        b = self._poses[after]
        if b.t_ns == t_ns:
            return b
        if after == 0 or b.t_ns - self._poses[after - 1].t_ns > LIMIT_NS:
            return None
        a = self._poses[after - 1]
        return _between(a, b, (t_ns - a.t_ns) / (b.t_ns - a.t_ns), t_ns)


def _between(a: Pose, b: Pose, share: float, t_ns: int) -> Pose:
    """What both know, on a line; the attitude by slerp."""
    numbers = {}
    for name in NUMBERS:
        first, second = getattr(a, name), getattr(b, name)
        if first is None or second is None:
            continue
        step = second - first
        if name == "longitude_deg":
            step = (step + 180.0) % 360.0 - 180.0  # the short way over the date line
        numbers[name] = first + share * step
    attitude = None
    if a.attitude is not None and b.attitude is not None:
        attitude = slerp(a.attitude, b.attitude, share)
    return Pose(t_ns, attitude, **numbers)
