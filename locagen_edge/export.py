"""Events on the map as files that map programs open: GPX 1.1, GeoJSON (RFC 7946), KML 2.2.

A caller whose place is known is a point with its time, and the ellipse that holds the caller with 95 %. One
of whom only the direction is known is the vehicle's place, marked "bearing only", a line of `LINE_M` from
there, and the sector that holds the direction with 95 %. Areas are polygons, in GPX, which has none, closed
tracks. Coordinates are longitude, latitude in GeoJSON and KML, attributes in GPX.
"""

from __future__ import annotations

import json
import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge import geodesy
from locagen_edge.errors import ExportError
from locagen_edge.files import write
from locagen_edge.geometry import compass_deg
from locagen_edge.sightings import EPOCH
from locagen_edge.types import Estimate, Pose, Position, Sighting, Track

SCALE_95 = math.sqrt(-2.0 * math.log(0.05))
"""Semi-axes of the 95 % ellipse over those of 1-sigma: 2.45."""
SIGMAS_95 = 1.96
"""Half a 95 % interval over 1-sigma."""
LINE_M = 300.0
"""How long a bearing is drawn: about as far as a voice is heard from a drone at best."""
WIDEST_RAD = math.pi / 2.0
"""Half of the widest sector that is drawn."""
ARC = 12
CORNERS = 48
MOST = 1000
"""Callers kept for one file; beyond that the first goes."""
DIGITS = 7
"""Of degrees: a centimetre."""
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, escaped or not (section 2.2)."""

Ring = list[tuple[float, float]]
"""longitude, latitude; the last is the first"""


@dataclass(frozen=True, slots=True)
class Event:
    """Somebody or something at a place."""

    t_ns: int
    """UTC, since 1970"""
    latitude_deg: float
    longitude_deg: float
    semi_major_m: float
    """1-sigma"""
    semi_minor_m: float
    orientation_rad: float
    """of the major axis, clockwise from true north"""
    kind: str = "call"
    name: str = ""
    confidence: float | None = None
    """0 to 1"""
    altitude_m: float | None = None
    """above mean sea level"""

    @property
    def time_utc(self) -> str:
        """RFC 3339, milliseconds."""
        return utc(self.t_ns)


@dataclass(frozen=True, slots=True)
class Direction:
    """Somebody or something in a direction from a vehicle; how far off is not known."""

    t_ns: int
    """UTC, since 1970"""
    latitude_deg: float
    """of the vehicle, as are longitude and altitude"""
    longitude_deg: float
    azimuth_rad: float
    """clockwise from true north"""
    azimuth_sigma_rad: float
    kind: str = "bearing only"
    name: str = ""
    confidence: float | None = None
    """0 to 1"""
    altitude_m: float | None = None
    """above mean sea level"""

    @property
    def time_utc(self) -> str:
        """RFC 3339, milliseconds."""
        return utc(self.t_ns)


Told = Event | Direction


def utc(t_ns: int) -> str:
    """RFC 3339 with milliseconds of nanoseconds since 1970."""
    time = EPOCH + timedelta(microseconds=t_ns // 1000)
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def event(position: Position, t_ns: int, **more: Any) -> Event | None:
    """An event at a position, None where that knows no place.

    `t_ns`: its time in UTC; `more`: the kind, name and confidence of the event.
    """
    if position.latitude_deg is None or position.longitude_deg is None:
        return None
    return Event(
        t_ns=t_ns,
        latitude_deg=position.latitude_deg,
        longitude_deg=position.longitude_deg,
        semi_major_m=position.semi_major_m,
        semi_minor_m=position.semi_minor_m,
        orientation_rad=position.orientation_rad,
        altitude_m=position.altitude_m,
        **more,
    )


def direction(track: Track, pose: Pose | None, t_ns: int, **more: Any) -> Direction | None:
    """The bearing of a track from the vehicle's place, None where either is not known.

    `t_ns`: its time in UTC; `more`: as of `event`.
    """
    if track.earth is None or pose is None or pose.latitude_deg is None or pose.longitude_deg is None:
        return None
    numbers = (track.earth.azimuth_rad, track.earth.azimuth_sigma_rad, pose.latitude_deg, pose.longitude_deg)
    if not all(map(math.isfinite, numbers)):
        return None
    return Direction(
        t_ns=t_ns,
        latitude_deg=pose.latitude_deg,
        longitude_deg=pose.longitude_deg,
        azimuth_rad=track.earth.azimuth_rad,
        azimuth_sigma_rad=track.earth.azimuth_sigma_rad,
        altitude_m=pose.altitude_m,
        **more,
    )


def seen_from(look: Sighting, **more: Any) -> Direction:
    """The bearing of a look, from where it was taken; `more`: as of `event`."""
    return Direction(
        t_ns=look.t_ns,
        latitude_deg=look.latitude_deg,
        longitude_deg=look.longitude_deg,
        azimuth_rad=look.azimuth_rad,
        azimuth_sigma_rad=math.hypot(look.azimuth_sigma_rad, look.azimuth_bias_sigma_rad),
        altitude_m=look.altitude_m,
        **more,
    )


def export(events: Sequence[Told], path: Path) -> None:
    """Writes the events in the format of the file's ending, all or nothing.

    Raises `ExportError` where the ending is none of FORMATS or the file cannot be written.
    """
    _check_ending(path)
    try:
        write(path, FORMATS[path.suffix.lower()](events))
    except OSError as error:
        raise ExportError(f"{path}: cannot be written: {error.strerror}") from error


def _check_ending(path: Path) -> None:
    if path.suffix.lower() not in FORMATS:
        raise ExportError(f"{path}: the ending says the format: one of {', '.join(FORMATS)}")


class Callers:
    """The last known place of each caller of a stream, on the way into a map file, the last MOST of them.

    Of a confirmed caller who was never placed, the last bearing that was heard, from where the vehicle was.
    Raises `ExportError` at once where the file could not be written.
    """

    def __init__(self, path: Path) -> None:
        _check_ending(path)
        if not path.parent.is_dir():
            raise ExportError(f"{path}: there is no such folder")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise ExportError(f"{path}: may not be written")
        self.path = path
        self._events: dict[int, Told] = {}
        self.changed = False
        """since this was last set to False: whether there is something new to write"""

    def hear(self, estimate: Estimate, utc_ns: int) -> None:
        """What the pipeline made of a frame; `utc_ns` is the time of its first sample since 1970."""
        for track in estimate.tracks:
            told = self._placed(track, estimate, utc_ns) or self._pointed_at(track, estimate, utc_ns)
            if told is not None:
                self._events[track.id] = told
                if len(self._events) > MOST:
                    del self._events[next(iter(self._events))]
                self.changed = True

    def _placed(self, track: Track, estimate: Estimate, utc_ns: int) -> Told | None:
        position = estimate.position(track)
        if position is None or (track.silent_s > 0.0 and track.id in self._events):
            return None  # nothing new; what is sure of a call fades while nothing is heard
        heard_ns = utc_ns + position.t_ns - estimate.t_ns - round(position.age_s * 1e9)
        return event(position, heard_ns, name=f"caller {track.id}", confidence=track.confidence)

    def _pointed_at(self, track: Track, estimate: Estimate, utc_ns: int) -> Told | None:
        """A place once known stays: the vehicle's next bearing is less."""
        if not track.confirmed or track.silent_s > 0.0 or isinstance(self._events.get(track.id), Event):
            return None
        heard_ns = utc_ns if estimate.pose is None else utc_ns + estimate.pose.t_ns - estimate.t_ns
        return direction(
            track, estimate.pose, heard_ns, name=f"caller {track.id}", confidence=track.confidence
        )

    @property
    def events(self) -> list[Told]:
        """In the order in which they were first heard."""
        return list(self._events.values())


# --- shapes -------------------------------------------------------------------------------------------


def outline(told: Told) -> Ring:
    """What holds the caller with 95 %, counter-clockwise, longitudes without a jump."""
    return ellipse(told) if isinstance(told, Event) else sector(told)


def sector(d: Direction) -> Ring:
    """Of `LINE_M`, about the bearing's 95 %; longitudes as in `ellipse`."""
    half = min(SIGMAS_95 * d.azimuth_sigma_rad, WIDEST_RAD)
    angles = d.azimuth_rad + np.linspace(half, -half, ARC)  # from the right to the left
    here = (_longitude(d.longitude_deg), d.latitude_deg)
    return [here, *(_away(d, float(angle)) for angle in angles), here]


def line(d: Direction) -> Ring:
    """From the vehicle along the bearing: two points, open."""
    return [(_longitude(d.longitude_deg), d.latitude_deg), _away(d, d.azimuth_rad)]


def _away(d: Direction, azimuth_rad: float) -> tuple[float, float]:
    way = LINE_M * np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    lat, lon, _ = geodesy.moved(d.latitude_deg, d.longitude_deg, 0.0, way)
    return _near(lon, _longitude(d.longitude_deg)), lat


def _near(longitude_deg: float, centre_deg: float) -> float:
    """The same longitude within half a turn of another."""
    return centre_deg + (longitude_deg - centre_deg + 180.0) % 360.0 - 180.0


def ellipse(e: Event) -> Ring:
    """The 95 % ellipse, counter-clockwise, longitudes without a jump: beyond +-180 where it crosses that."""
    angle = -2.0 * math.pi * np.arange(CORNERS) / CORNERS  # north, east turn clockwise
    along, aside = SCALE_95 * e.semi_major_m * np.cos(angle), SCALE_95 * e.semi_minor_m * np.sin(angle)
    cosine, sine = math.cos(e.orientation_rad), math.sin(e.orientation_rad)
    ring = []
    for north, east in zip(cosine * along - sine * aside, sine * along + cosine * aside, strict=True):
        lat, lon, _ = geodesy.moved(e.latitude_deg, e.longitude_deg, 0.0, np.array([north, east, 0.0]))
        centre = _longitude(e.longitude_deg)
        ring.append((_near(lon, centre), lat))
    return [*ring, ring[0]]


def _longitude(degrees: float) -> float:
    """The same longitude within -180 (included) to 180 (left out)."""
    return (degrees + 180.0) % 360.0 - 180.0


def _cut(ring: Ring) -> list[Ring]:
    """The ring in parts that do not cross the antimeridian (RFC 7946, section 3.1.9)."""
    over = 180.0 if max(lon for lon, _ in ring) > 180.0 else -180.0
    if min(lon for lon, _ in ring) >= -180.0 and over < 0.0:
        return [ring]
    parts = []
    for side, shift in ((1.0, 0.0), (-1.0, -math.copysign(360.0, over))):
        sign = side * math.copysign(1.0, -over)  # of what is kept: first the side within, then the one beyond
        kept: Ring = []
        for (lon, lat), (next_lon, next_lat) in pairwise(ring):
            if sign * (lon - over) >= 0.0:
                kept.append((lon + shift, lat))
            if (lon - over) * (next_lon - over) < 0.0:
                share = (over - lon) / (next_lon - lon)
                kept.append((over + shift, lat + share * (next_lat - lat)))
        if len(kept) > 2:
            parts.append([*kept, kept[0]])
    return parts


def _parts(path: Ring) -> list[Ring]:
    """A line of two points in parts that do not cross the antimeridian."""
    (lon, lat), (next_lon, next_lat) = path
    if -180.0 <= next_lon <= 180.0:
        return [path]
    edge = math.copysign(180.0, next_lon)
    middle = lat + (edge - lon) / (next_lon - lon) * (next_lat - lat)
    return [[(lon, lat), (edge, middle)], [(-edge, middle), (next_lon - 2.0 * edge, next_lat)]]


def _rounded(ring: Ring) -> list[list[float]]:
    return [[round(lon, DIGITS), round(lat, DIGITS)] for lon, lat in ring]


def _words(e: Told) -> str:
    """The event in a sentence for people."""
    if isinstance(e, Direction):
        text = f"{e.kind}, heard from here at {e.time_utc}, {compass_deg(e.azimuth_rad):.0f} degrees true"
        text += f", 1-sigma {math.degrees(e.azimuth_sigma_rad):.0f} degrees, distance not known"
    else:
        text = f"{e.kind}, {e.time_utc}, 1-sigma {e.semi_major_m:.1f} m by {e.semi_minor_m:.1f} m"
        text += f" at {math.degrees(e.orientation_rad) % 180.0:.0f} degrees"
    return text if e.confidence is None else f"{text}, confidence {e.confidence:.2f}"


def _area(e: Told) -> str:
    return "95 % sector" if isinstance(e, Direction) else "95 %"


# --- the formats --------------------------------------------------------------------------------------


def geojson(events: Sequence[Told]) -> str:
    """A FeatureCollection: for each event its point, with all that is known, its area, a bearing's line."""
    features = []
    for e in events:
        place = [round(_longitude(e.longitude_deg), DIGITS), round(e.latitude_deg, DIGITS)]
        if e.altitude_m is not None:
            place.append(round(e.altitude_m, 1))
        features.append(_feature("Point", place, _known(e)))
        parts = [[_rounded(part)] for part in _cut(outline(e))]
        shape = {"name": e.name, "kind": "sector" if isinstance(e, Direction) else "ellipse"}
        features.append(_shape("Polygon", parts, {**shape, "probability": 0.95}))
        if isinstance(e, Direction):
            lines = [_rounded(part) for part in _parts(line(e))]
            features.append(_shape("LineString", lines, {"name": e.name, "kind": "bearing"}))
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1, allow_nan=False) + "\n"


def _known(e: Told) -> dict[str, Any]:
    told = {"name": e.name, "kind": e.kind, "time_utc": e.time_utc, "confidence": _two(e.confidence)}
    if isinstance(e, Direction):
        return told | {
            "azimuth_true_deg": round(compass_deg(e.azimuth_rad), 1),
            "azimuth_sigma_deg": round(math.degrees(e.azimuth_sigma_rad), 1),
        }
    return told | {
        "semi_major_m": round(e.semi_major_m, 2),
        "semi_minor_m": round(e.semi_minor_m, 2),
        "orientation_deg": round(math.degrees(e.orientation_rad) % 180.0, 1),
    }


def _two(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _shape(kind: str, parts: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return (
        _feature(kind, parts[0], properties)
        if len(parts) == 1
        else _feature(f"Multi{kind}", parts, properties)
    )


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def gpx(events: Sequence[Told]) -> str:
    """Waypoints, and areas and bearings as tracks, which handheld receivers draw.

    Elements come in the schema's order, which readers may insist on.
    """
    root = ET.Element("gpx", version="1.1", creator="locagen-edge", xmlns="http://www.topografix.com/GPX/1/1")
    for e in events:
        point = ET.SubElement(root, "wpt", _lat_lon(e.longitude_deg, e.latitude_deg))
        if e.altitude_m is not None:
            _text(point, "ele", f"{e.altitude_m:.1f}")
        _text(point, "time", e.time_utc)
        _text(point, "name", e.name or e.kind)
        _text(point, "desc", _words(e))
        _text(point, "type", e.kind)
    for e in events:
        _track(root, f"{_area(e)} {e.name or e.kind}", outline(e))
        if isinstance(e, Direction):
            _track(root, f"{e.kind} {e.name}".strip(), line(e))
    return _document(root)


def _track(root: ET.Element, name: str, path: Ring) -> None:
    track = ET.SubElement(root, "trk")
    _text(track, "name", name)
    segment = ET.SubElement(track, "trkseg")
    for lon, lat in path:
        ET.SubElement(segment, "trkpt", _lat_lon(lon, lat))


def kml(events: Sequence[Told]) -> str:
    """For each event a folder with its point, its area and a bearing's line, on the ground."""
    root = ET.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ET.SubElement(root, "Document")
    _text(document, "name", "locagen-edge")
    style = ET.SubElement(document, "Style", id="ellipse")
    _text(ET.SubElement(style, "LineStyle"), "color", "ff0050ff")
    _text(ET.SubElement(style, "PolyStyle"), "color", "400050ff")
    for e in events:
        folder = ET.SubElement(document, "Folder")
        _text(folder, "name", e.name or e.kind)
        point = ET.SubElement(folder, "Placemark")
        _text(point, "name", e.name or e.kind)
        _text(point, "description", _words(e))
        _text(ET.SubElement(point, "TimeStamp"), "when", e.time_utc)
        _text(ET.SubElement(point, "Point"), "coordinates", _corners([(e.longitude_deg, e.latitude_deg)]))
        shapes = _shapes(folder, _area(e))
        for part in _cut(outline(e)):
            boundary = ET.SubElement(ET.SubElement(shapes, "Polygon"), "outerBoundaryIs")
            _text(ET.SubElement(boundary, "LinearRing"), "coordinates", _corners(part))
        if isinstance(e, Direction):
            shapes = _shapes(folder, e.kind)
            for part in _parts(line(e)):
                _text(ET.SubElement(shapes, "LineString"), "coordinates", _corners(part))
    return _document(root)


def _shapes(folder: ET.Element, name: str) -> ET.Element:
    area = ET.SubElement(folder, "Placemark")
    _text(area, "name", name)
    _text(area, "styleUrl", "#ellipse")
    return ET.SubElement(area, "MultiGeometry")


def _corners(path: Ring) -> str:
    """Longitudes within -180 to 180, the edge as it is: a part that was cut ends there."""
    return " ".join(f"{_within(lon):.{DIGITS}f},{lat:.{DIGITS}f}" for lon, lat in path)


def _within(longitude_deg: float) -> float:
    return longitude_deg if abs(longitude_deg) <= 180.0 else _longitude(longitude_deg)


def _lat_lon(lon: float, lat: float) -> dict[str, str]:
    return {"lat": f"{lat:.{DIGITS}f}", "lon": f"{_longitude(lon):.{DIGITS}f}"}


def _text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = NOT_XML.sub("\ufffd", text)


def _document(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


FORMATS: dict[str, Callable[[Sequence[Told]], str]] = {
    ".geojson": geojson,
    ".json": geojson,
    ".gpx": gpx,
    ".kml": kml,
}
"""Writers by the file's ending."""
