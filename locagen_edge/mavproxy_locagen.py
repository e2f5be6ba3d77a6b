"""A MAVProxy module: bearing lines, ellipses of positions and a list of calls, on the map and in the console.

    pip install MAVProxy locagen-edge        # into one environment
    module load locagen                      # locagen.py, which is installed beside
    locagen                                  # the calls, the last first
    locagen clear | locagen length METRES    # of the map; how long a line is drawn

It reads LOCAGEN_BEARING and LOCAGEN_POSITION, as messages of their own or inside TUNNEL, whichever comes.
Without the map module it lists and draws nothing. It sends nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from MAVProxy.modules.lib import mp_module

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.records import UNKNOWN

EVENTS = 200
"""calls that are remembered; beyond that the first is forgotten"""
LAYER = "locagen"
LINE, EDGE, PLACE = (255, 64, 64), (255, 176, 176), (255, 220, 0)
"""colours, red, green, blue: the bearing, its 1-sigma to both sides, a position's ellipse"""
SURE = 2.448
"""radius of a 95 % ellipse over its 1-sigma axes: sqrt(-2 ln 0.05)"""
POINTS = 36
EARTH_M = 6_371_000.0

Point = tuple[float, float]


@dataclass
class Event:
    """One call, as it was last told."""

    id: int
    system: int
    began_s: float
    last_s: float
    bearings: int = 0
    azimuth_deg: float = math.nan
    sigma_deg: float = math.nan
    confidence: float = math.nan
    place: Point | None = None
    confirmed: bool = False
    ambiguous: bool = False


def beyond(here: Point, azimuth_rad: float, distance_m: float) -> Point:
    """Latitude and longitude so far off in a direction from true north, degrees, on a sphere."""
    latitude = math.radians(here[0])
    north, east = distance_m * math.cos(azimuth_rad), distance_m * math.sin(azimuth_rad)
    return (
        here[0] + math.degrees(north / EARTH_M),
        here[1] + math.degrees(east / (EARTH_M * max(math.cos(latitude), 1e-6))),
    )


def ellipse(centre: Point, nn: float, ne: float, ee: float) -> list[Point]:
    """The closed 95 % ellipse of a covariance of north and east, square metres."""
    half, apart = (nn + ee) / 2.0, math.hypot((nn - ee) / 2.0, ne)
    major, minor = math.sqrt(max(half + apart, 0.0)), math.sqrt(max(half - apart, 0.0))
    turn = 0.5 * math.atan2(2.0 * ne, nn - ee)
    points = []
    for step in range(POINTS + 1):
        angle = 2.0 * math.pi * step / POINTS
        along, across = SURE * major * math.cos(angle), SURE * minor * math.sin(angle)
        north = along * math.cos(turn) - across * math.sin(turn)
        east = along * math.sin(turn) + across * math.cos(turn)
        points.append(beyond(centre, math.atan2(east, north), math.hypot(north, east)))
    return points


def record_in(message: Any) -> tuple[Any, int] | None:
    """The LOCAGEN message that a message of MAVProxy is or holds, and whose; None: none. Never raises.

    MAVProxy does not know our ids: what they carry it hands on unread, unchecked, and without its sender.
    """
    kind = message.get_type()
    if kind == "TUNNEL":
        record = dialect.untunnel(message)
        return None if record is None else (record, message.get_srcSystem())
    if kind in (f"UNKNOWN_{dialect.LOCAGEN_BEARING}", f"UNKNOWN_{dialect.LOCAGEN_POSITION}"):
        for packet in Framer().feed(bytes(message.get_msgbuf())):
            return dialect.decode(packet.raw), packet.system_id
    return None


class Locagen(mp_module.MPModule):  # type: ignore[misc]
    """What MAVProxy loads."""

    def __init__(self, mpstate: Any) -> None:
        super().__init__(mpstate, "locagen", "bearings and positions of calls for help")
        self.events: dict[tuple[int, int], Event] = {}
        self.length_m = 300.0
        self.add_command("locagen", self.command, "calls for help", ["<events|clear>", "length"])

    def mavlink_packet(self, m: Any) -> None:
        """Called for each message that arrives."""
        found = record_in(m)
        if found is None or found[0].event_id == 0:
            return
        record, system = found
        now_s = time.time()
        event = self.events.get((system, record.event_id))
        if event is None:
            event = Event(record.event_id, system, now_s, now_s)
            self.events[system, record.event_id] = event
            if len(self.events) > EVENTS:
                del self.events[next(iter(self.events))]
            print(f"locagen: call {event.id} of vehicle {system}")
        event.last_s = now_s
        if record.get_msgId() == dialect.LOCAGEN_BEARING:
            self._take_bearing(event, record)
        else:
            self._take_position(event, record)

    def _take_bearing(self, event: Event, record: Any) -> None:
        event.bearings += 1
        event.azimuth_deg, event.sigma_deg = record.azimuth_true, record.azimuth_sigma
        event.confidence = record.confidence
        event.confirmed |= bool(record.flags & dialect.messages.LOCAGEN_BEARING_FLAGS_CONFIRMED)
        event.ambiguous = bool(record.flags & dialect.messages.LOCAGEN_BEARING_FLAGS_AMBIGUOUS)
        if UNKNOWN in (record.lat, record.lon) or not math.isfinite(record.azimuth_true):
            return
        here = (record.lat * 1e-7, record.lon * 1e-7)
        sigma = record.azimuth_sigma if math.isfinite(record.azimuth_sigma) else 0.0
        for name, off, colour in (("", 0.0, LINE), ("left", -sigma, EDGE), ("right", sigma, EDGE)):
            there = beyond(here, math.radians(record.azimuth_true + off), self.length_m)
            self._draw(f"bearing{event.system}.{event.id}{name}", [here, there], colour, 1 if name else 2)

    def _take_position(self, event: Event, record: Any) -> None:
        event.place = (record.lat * 1e-7, record.lon * 1e-7)
        covariance = (record.covariance_nn, record.covariance_ne, record.covariance_ee)
        if all(map(math.isfinite, covariance)):
            self._draw(f"place{event.system}.{event.id}", ellipse(event.place, *covariance), PLACE, 2)

    def _draw(self, key: str, points: Sequence[Point], colour: tuple[int, int, int], width: int) -> None:
        """On every map that is open; a shape with the same key replaces the last."""
        maps = self.module_matching("map?") + [m for m in (self.module("map"),) if m is not None]
        if not maps:
            return
        from MAVProxy.modules.mavproxy_map import mp_slipmap_util

        shape = mp_slipmap_util.SlipPolygon(key, list(points), LAYER, colour, width, showcircles=False)
        for one in maps:
            one.map.add_object(shape)

    def command(self, args: list[str]) -> None:
        """`locagen ...` on MAVProxy's command line."""
        match args:
            case [] | ["events"]:
                print("\n".join(self.lines()) or "no call so far")
            case ["clear"]:
                self.events.clear()
                maps = self.module_matching("map?") + [m for m in (self.module("map"),) if m is not None]
                if maps:
                    from MAVProxy.modules.mavproxy_map import mp_slipmap_util

                    for one in maps:
                        one.map.add_object(mp_slipmap_util.SlipClearLayer(LAYER))
            case ["length", metres] if metres.replace(".", "", 1).isdigit() and float(metres) > 0:
                self.length_m = float(metres)
            case _:
                print("Usage: locagen [events|clear|length METRES]")

    def lines(self) -> list[str]:
        """The calls, the last first."""
        now_s = time.time()
        lines = []
        for event in sorted(self.events.values(), key=lambda event: event.last_s, reverse=True):
            where = f"{event.azimuth_deg:03.0f} deg true +-{event.sigma_deg:.0f}"
            if not math.isfinite(event.azimuth_deg):
                where = "no true bearing"
            if event.ambiguous:
                where += " or its mirror image"
            place = f", at {event.place[0]:.6f} {event.place[1]:.6f}" if event.place else ""
            sure = " confirmed" if event.confirmed else ""
            since = f"over {event.last_s - event.began_s:.0f} s, {now_s - event.last_s:.0f} s ago"
            who = f"vehicle {event.system} call {event.id}{sure}"
            lines.append(f"{who}: {where}{place}, {event.bearings} bearings {since}")
        return lines


def init(mpstate: Any) -> Locagen:
    """What MAVProxy calls to load a module."""
    return Locagen(mpstate)
