"""Events on the map as files that map programs open: GPX 1.1, GeoJSON (RFC 7946), KML 2.2.

Each event is a point with its time, and the ellipse that holds the caller with 95 %: a polygon, in GPX, which
has none, a closed track. Coordinates are longitude, latitude in GeoJSON and KML, attributes in GPX.
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
from locagen_edge.sightings import EPOCH
from locagen_edge.types import Estimate, Position

SCALE_95 = math.sqrt(-2.0 * math.log(0.05))
"""Semi-axes of the 95 % ellipse over those of 1-sigma: 2.45."""
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


def export(events: Sequence[Event], path: Path) -> None:
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

    Raises `ExportError` at once where the file could not be written.
    """

    def __init__(self, path: Path) -> None:
        _check_ending(path)
        if not path.parent.is_dir():
            raise ExportError(f"{path}: there is no such folder")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise ExportError(f"{path}: may not be written")
        self.path = path
        self._events: dict[int, Event] = {}
        self.changed = False
        """since this was last set to False: whether there is something new to write"""

    def hear(self, estimate: Estimate, utc_ns: int) -> None:
        """What the pipeline made of a frame; `utc_ns` is the time of its first sample since 1970."""
        for track in estimate.tracks:
            position = estimate.position(track)
            if position is None:
                continue
            heard_ns = utc_ns + position.t_ns - estimate.t_ns - round(position.age_s * 1e9)
            told = event(position, heard_ns, name=f"caller {track.id}", confidence=track.confidence)
            if told is not None:
                self._events[track.id] = told
                if len(self._events) > MOST:
                    del self._events[next(iter(self._events))]
                self.changed = True

    @property
    def events(self) -> list[Event]:
        """In the order in which they were first heard."""
        return list(self._events.values())


# --- the ellipse --------------------------------------------------------------------------------------


def ellipse(e: Event) -> Ring:
    """The 95 % ellipse, counter-clockwise, longitudes without a jump: beyond +-180 where it crosses that."""
    angle = -2.0 * math.pi * np.arange(CORNERS) / CORNERS  # north, east turn clockwise
    along, aside = SCALE_95 * e.semi_major_m * np.cos(angle), SCALE_95 * e.semi_minor_m * np.sin(angle)
    cosine, sine = math.cos(e.orientation_rad), math.sin(e.orientation_rad)
    ring = []
    for north, east in zip(cosine * along - sine * aside, sine * along + cosine * aside, strict=True):
        lat, lon, _ = geodesy.moved(e.latitude_deg, e.longitude_deg, 0.0, np.array([north, east, 0.0]))
        centre = _longitude(e.longitude_deg)
        ring.append((centre + (lon - centre + 180.0) % 360.0 - 180.0, lat))
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


def _rounded(ring: Ring) -> list[list[float]]:
    return [[round(lon, DIGITS), round(lat, DIGITS)] for lon, lat in ring]


def _words(e: Event) -> str:
    """The event in a sentence for people."""
    text = f"{e.kind}, {e.time_utc}, 1-sigma {e.semi_major_m:.1f} m by {e.semi_minor_m:.1f} m"
    text += f" at {math.degrees(e.orientation_rad) % 180.0:.0f} degrees"
    return text if e.confidence is None else f"{text}, confidence {e.confidence:.2f}"


# --- the formats --------------------------------------------------------------------------------------


def geojson(events: Sequence[Event]) -> str:
    """A FeatureCollection: for each event its point, with all that is known, and its ellipse."""
    features = []
    for e in events:
        told = {
            "name": e.name,
            "kind": e.kind,
            "time_utc": e.time_utc,
            "confidence": e.confidence,
            "semi_major_m": round(e.semi_major_m, 2),
            "semi_minor_m": round(e.semi_minor_m, 2),
            "orientation_deg": round(math.degrees(e.orientation_rad) % 180.0, 1),
        }
        place = [round(_longitude(e.longitude_deg), DIGITS), round(e.latitude_deg, DIGITS)]
        if e.altitude_m is not None:
            place.append(round(e.altitude_m, 1))
        parts = [[_rounded(part)] for part in _cut(ellipse(e))]
        shape = (
            {"type": "Polygon", "coordinates": parts[0]}
            if len(parts) == 1
            else {"type": "MultiPolygon", "coordinates": parts}
        )
        features += [
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": told},
            {
                "type": "Feature",
                "geometry": shape,
                "properties": {"name": e.name, "kind": "ellipse", "probability": 0.95},
            },
        ]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1, allow_nan=False) + "\n"


def gpx(events: Sequence[Event]) -> str:
    """Waypoints, and the ellipses as closed tracks, which handheld receivers draw.

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
        track = ET.SubElement(root, "trk")
        _text(track, "name", f"95 % {e.name or e.kind}")
        segment = ET.SubElement(track, "trkseg")
        for lon, lat in ellipse(e):
            ET.SubElement(segment, "trkpt", _lat_lon(lon, lat))
    return _document(root)


def kml(events: Sequence[Event]) -> str:
    """For each event a folder with its point and its ellipse, both on the ground."""
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
        place = f"{_longitude(e.longitude_deg):.{DIGITS}f},{e.latitude_deg:.{DIGITS}f}"
        _text(ET.SubElement(point, "Point"), "coordinates", place)
        area = ET.SubElement(folder, "Placemark")
        _text(area, "name", "95 %")
        _text(area, "styleUrl", "#ellipse")
        shapes = ET.SubElement(area, "MultiGeometry")
        for part in _cut(ellipse(e)):
            ring = ET.SubElement(
                ET.SubElement(ET.SubElement(shapes, "Polygon"), "outerBoundaryIs"), "LinearRing"
            )
            corners = (f"{lon:.{DIGITS}f},{lat:.{DIGITS}f}" for lon, lat in part)
            _text(ring, "coordinates", " ".join(corners))
    return _document(root)


def _lat_lon(lon: float, lat: float) -> dict[str, str]:
    return {"lat": f"{lat:.{DIGITS}f}", "lon": f"{_longitude(lon):.{DIGITS}f}"}


def _text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = NOT_XML.sub("\ufffd", text)


def _document(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


FORMATS: dict[str, Callable[[Sequence[Event]], str]] = {
    ".geojson": geojson,
    ".json": geojson,
    ".gpx": gpx,
    ".kml": kml,
}
"""Writers by the file's ending."""
