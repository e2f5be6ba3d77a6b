"""Sightings of several vehicles -> callers on the map: done on the ground, over all that was seen.

Each vehicle counts its callers by itself. Which of one are which of another is decided by evidence: two
streams are one caller where one filter explains them better together than two do apart (the Bayes factor;
MacKay, *Information Theory, Inference, and Learning Algorithms*, chapter 28). Streams of one vehicle that
overlap in time are different callers, whatever fits.

Two vehicles that hover, one bearing each, always cross somewhere: that place is true only if they heard the
same voice. Depression over height, or a moving vehicle, is what tells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from locagen_edge.settings import PositionSettings
from locagen_edge.stages.position import Positioner
from locagen_edge.types import Position, Sighting

Stream = tuple[str, int]
"""observer, caller"""


@dataclass(frozen=True, eq=False)
class Fused:
    """One caller, and who saw it."""

    position: Position
    """at the time of its last sighting"""
    streams: tuple[Stream, ...]
    used: int
    """sightings that made it"""
    unused: int
    """those too soon after another, outside the gate, or not usable"""
    last: Sighting
    """the latest of them all"""


@dataclass(frozen=True)
class _Group:
    streams: dict[Stream, list[Sighting]]
    fused: Fused | None
    evidence: float

    @staticmethod
    def of(streams: dict[Stream, list[Sighting]], settings: PositionSettings) -> _Group:
        looks = sorted((look for stream in streams.values() for look in stream), key=lambda look: look.t_ns)
        positioner = Positioner(settings)
        for look in looks:
            positioner.see(replace(look, caller=0))
        position = positioner.position(0, looks[-1].t_ns)
        counted = positioner.counters
        if position is None:
            return _Group(streams, None, positioner.evidence)
        fused = Fused(position, tuple(streams), counted.used, len(looks) - counted.used, looks[-1])
        return _Group(streams, fused, positioner.evidence)


def fuse(sightings: Iterable[Sighting], settings: PositionSettings) -> tuple[Fused, ...]:
    """The callers that these sightings are of, the most seen first. Any order, on one clock (UTC).

    Streams in which nothing is usable give none.
    """
    settings = replace(settings, forget_s=1e5)  # what was written down is not forgotten between two flights
    streams: dict[Stream, list[Sighting]] = {}
    for sighting in sightings:
        streams.setdefault((sighting.observer, sighting.caller), []).append(sighting)
    groups: list[_Group] = []
    for stream in sorted(streams, key=lambda name: (-len(streams[name]), name)):
        alone = _Group.of({stream: streams[stream]}, settings)
        if alone.fused is None:
            continue
        best, gain = None, 0.0
        for group in groups:
            if any(_at_once(stream, streams[stream], *other) for other in group.streams.items()):
                continue
            joined = _Group.of({**group.streams, **alone.streams}, settings)
            if joined.evidence - group.evidence - alone.evidence > gain:
                best, gain = (group, joined), joined.evidence - group.evidence - alone.evidence
        if best is None:
            groups.append(alone)
        else:
            groups[groups.index(best[0])] = best[1]
    found = [group.fused for group in groups if group.fused is not None]
    return tuple(sorted(found, key=lambda fused: -fused.used))


def _at_once(one: Stream, looks: list[Sighting], other: Stream, others: list[Sighting]) -> bool:
    """Whether two streams are of one vehicle at one time."""
    first, last = min(look.t_ns for look in looks), max(look.t_ns for look in looks)
    return one[0] == other[0] and any(first <= look.t_ns <= last for look in others)
