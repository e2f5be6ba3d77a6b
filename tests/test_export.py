"""What map programs are given: well-formed, in their order of coordinates, whole or not there."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.cli import _export_news, _export_or_tell
from locagen_edge.errors import ExportError
from locagen_edge.export import (
    FORMATS,
    LINE_M,
    MOST,
    SCALE_95,
    SIGMAS_95,
    WIDEST_RAD,
    Callers,
    Direction,
    Event,
    ellipse,
    export,
    geojson,
    gpx,
    kml,
    line,
    sector,
)
from locagen_edge.geodesy import north_east_down_m
from locagen_edge.types import Bearing, Detection, Estimate, Pose, Position, Tdoa, Track, TrueBearing

GPX = {"g": "http://www.topografix.com/GPX/1/1"}
KML = {"k": "http://www.opengis.net/kml/2.2"}
T_NS = 1_750_000_000_123_456_789


def event(lat=47.1, lon=8.2, **more) -> Event:
    values = {"semi_major_m": 6.0, "semi_minor_m": 2.0, "orientation_rad": math.radians(30), **more}
    return Event(T_NS, lat, lon, **values)


def area(ring) -> float:
    """Twice the signed area, positive counter-clockwise."""
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairwise(ring))


EVENTS = st.builds(
    event,
    lat=st.floats(-89, 89),
    lon=st.floats(-180, 180),
    name=st.text(max_size=20),
    kind=st.text(min_size=1, max_size=20),
    confidence=st.none() | st.floats(0, 1),
    altitude_m=st.none() | st.floats(-400, 9000),
)


DIRECTIONS = st.builds(
    Direction,
    t_ns=st.just(T_NS),
    latitude_deg=st.floats(-89, 89),
    longitude_deg=st.floats(-180, 180),
    azimuth_rad=st.floats(-math.pi, math.pi),
    azimuth_sigma_rad=st.floats(0.001, 2.0),
    name=st.text(max_size=20),
    altitude_m=st.none() | st.floats(-400, 9000),
)


@given(st.lists(EVENTS | DIRECTIONS, max_size=3))
def test_every_format_parses_whatever_the_names_hold(events):
    assert len(ET.fromstring(gpx(events)).findall("g:wpt", GPX)) == len(events)
    assert len(ET.fromstring(kml(events)).findall(".//k:Folder", KML)) == len(events)
    shapes = sum(2 + isinstance(e, Direction) for e in events)
    assert len(json.loads(geojson(events))["features"]) == shapes


def test_names_come_back_as_they_were():
    name = """<b>&"Müller" ]]> 'x'"""
    assert ET.fromstring(gpx([event(name=name)])).findtext("g:wpt/g:name", namespaces=GPX) == name
    assert ET.fromstring(kml([event(name=name)])).findtext(".//k:Folder/k:name", namespaces=KML) == name
    assert json.loads(geojson([event(name=name)]))["features"][0]["properties"]["name"] == name


def test_gpx_holds_places_and_elements_in_the_order_of_its_schema():
    point = ET.fromstring(gpx([event(altitude_m=412.34, confidence=0.8)])).find("g:wpt", GPX)
    assert (float(point.get("lat")), float(point.get("lon"))) == (47.1, 8.2)
    assert [child.tag.partition("}")[2] for child in point] == ["ele", "time", "name", "desc", "type"]
    assert point.findtext("g:time", namespaces=GPX) == "2025-06-15T15:06:40.123Z"


def test_geojson_and_kml_say_longitude_first():
    point, shape = json.loads(geojson([event()]))["features"]
    assert point["geometry"] == {"type": "Point", "coordinates": [8.2, 47.1]}
    assert point["properties"]["time_utc"] == "2025-06-15T15:06:40.123Z"
    assert shape["geometry"]["type"] == "Polygon"
    root = ET.fromstring(kml([event()]))
    assert root.findtext(".//k:Point/k:coordinates", namespaces=KML) == "8.2000000,47.1000000"
    corners = root.findtext(".//k:LinearRing/k:coordinates", namespaces=KML).split()
    assert corners[0] == corners[-1]
    assert all(abs(float(corner.split(",")[0]) - 8.2) < 0.001 for corner in corners)


@given(EVENTS)
def test_the_ellipse_lies_at_2_45_sigma_closed_and_counter_clockwise(e):
    ring = ellipse(e)
    assert ring[0] == ring[-1]
    assert area([(lon - ring[0][0], lat) for lon, lat in ring]) > 0
    for lon, lat in ring:
        north, east, _ = north_east_down_m(lat, lon, 0, e.latitude_deg, e.longitude_deg, 0)
        cosine, sine = math.cos(e.orientation_rad), math.sin(e.orientation_rad)
        along, aside = north * cosine + east * sine, east * cosine - north * sine
        assert math.hypot(along / e.semi_major_m, aside / e.semi_minor_m) == pytest.approx(SCALE_95, rel=1e-3)


@pytest.mark.parametrize("lon", [179.99999, -179.99999, 180.0, -180.0])
def test_an_ellipse_over_the_antimeridian_is_cut_in_two(lon):
    shape = json.loads(geojson([event(lon=lon)]))["features"][1]["geometry"]
    assert shape["type"] == "MultiPolygon"
    whole = area([(x - lon, y) for x, y in ellipse(event(lon=lon))])
    parts = [part[0] for part in shape["coordinates"]]
    assert {math.copysign(1, part[0][0]) for part in parts} == {-1.0, 1.0}
    for part in parts:
        assert part[0] == part[-1]
        assert all(-180 <= x <= 180 for x, _ in part)
        assert max(x for x, _ in part) - min(x for x, _ in part) < 0.001
    shifted = [[(x - part[0][0], y - part[0][1]) for x, y in part] for part in parts]
    assert sum(map(area, shifted)) == pytest.approx(whole, rel=0.02)  # seven digits of degrees
    assert all(area(part) > 0 for part in shifted)


def from_vehicle(d: Direction, lon: float, lat: float) -> tuple[float, float]:
    """Distance and direction against the bearing, clockwise."""
    north, east, _ = north_east_down_m(lat, lon, 0, d.latitude_deg, d.longitude_deg, 0)
    off = math.atan2(east, north) - d.azimuth_rad
    return math.hypot(north, east), math.remainder(off, math.tau)


@given(DIRECTIONS)
def test_a_bearing_is_a_line_in_the_middle_of_its_sector(d):
    here, there = line(d)
    distance_m, off = from_vehicle(d, *there)
    assert distance_m == pytest.approx(LINE_M, rel=1e-4)
    assert off == pytest.approx(0.0, abs=1e-3)
    ring = sector(d)
    assert ring[0] == ring[-1] == here
    assert area([(lon - here[0], lat) for lon, lat in ring]) > 0
    half = min(SIGMAS_95 * d.azimuth_sigma_rad, WIDEST_RAD)
    (_, right), (_, left) = from_vehicle(d, *ring[1]), from_vehicle(d, *ring[-2])
    assert (right, left) == pytest.approx((half, -half), abs=1e-3)
    assert max(lon for lon, _ in ring) - min(lon for lon, _ in ring) < 1.0, "no jump over half the world"


@pytest.mark.parametrize("lon", [179.9999, -179.9999, 180.0, -180.0])
@pytest.mark.parametrize("azimuth", [math.pi / 2, -math.pi / 2])
def test_a_bearing_over_the_antimeridian_is_cut_in_two(lon, azimuth):
    d = Direction(T_NS, 47.0, lon, azimuth, 0.1)
    _, area_, bearing = (f["geometry"] for f in json.loads(geojson([d]))["features"])
    crosses = max(abs(x) for x, _ in line(d)) > 180.0
    assert bearing["type"] == ("MultiLineString" if crosses else "LineString")
    parts = bearing["coordinates"] if crosses else [bearing["coordinates"]]
    assert all(-180 <= x <= 180 for part in parts for x, _ in part)
    length = sum(abs(b[0] - a[0]) for a, b in parts)
    assert length == pytest.approx(abs(line(d)[1][0] - line(d)[0][0]), abs=1e-6)
    assert area_["type"] in ("Polygon", "MultiPolygon")


def test_a_bearing_alone_is_marked_as_such_in_every_format():
    d = Direction(T_NS, 47.1, 8.2, math.radians(-48.0), math.radians(3.0), name="caller 1", confidence=0.8)
    point, shape, bearing = json.loads(geojson([d]))["features"]
    assert point["geometry"]["coordinates"] == [8.2, 47.1]
    assert point["properties"]["kind"] == "bearing only"
    assert point["properties"]["azimuth_true_deg"] == 312.0
    assert point["properties"]["azimuth_sigma_deg"] == 3.0
    assert (shape["properties"]["kind"], bearing["properties"]["kind"]) == ("sector", "bearing")
    assert bearing["geometry"]["type"] == "LineString"
    root = ET.fromstring(gpx([d]))
    words = root.findtext("g:wpt/g:desc", namespaces=GPX)
    assert "312 degrees true, 1-sigma 3 degrees, distance not known" in words
    assert root.findtext("g:wpt/g:type", namespaces=GPX) == "bearing only"
    names = [t.findtext("g:name", namespaces=GPX) for t in root.findall("g:trk", GPX)]
    assert names == ["95 % sector caller 1", "bearing only caller 1"]
    root = ET.fromstring(kml([d]))
    assert len(root.findtext(".//k:LineString/k:coordinates", namespaces=KML).split()) == 2
    assert len(root.findall(".//k:Polygon", KML)) == 1


@pytest.mark.parametrize("ending", sorted(FORMATS))
def test_a_file_is_written_whole(tmp_path, ending):
    path = tmp_path / f"callers{ending.upper()}"
    export([event()], path)
    assert path.read_text() == FORMATS[ending]([event()])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def heard(t_ns: int, *places: tuple[int, float | None]) -> Estimate:
    """A frame with callers, by their ids and latitudes."""
    track = Track(1.0, 0.05, -0.3, 0.1, 0.6, 0.0, 0.9, confirmed=True)
    positions = tuple(
        Position(
            t_ns + 50_000_000, id, lat is not None, lat, None if lat is None else 8.0, 400.0, np.eye(2),
            1.0, 1.0, 0.0, 0.0, 0.1, age_s=0.2, looks=3,
        )
        for id, lat in places
    )  # fmt: skip
    tracks = tuple(replace(track, id=id) for id, _ in places)
    silence = Bearing(None, math.pi, None, math.pi, math.inf, "none")
    nothing = Tdoa(*[np.zeros(3)] * 3)
    return Estimate(
        t_ns,
        0,
        0,
        nothing,
        silence,
        Detection(False, 0.0, -60.0),
        None,
        (),
        None,
        tracks,
        positions=positions,
    )


def test_callers_keep_their_last_place_after_their_track(tmp_path):
    callers = Callers(tmp_path / "callers.geojson")
    callers.hear(heard(0, (1, None)), T_NS)
    assert not callers.changed
    callers.hear(heard(0, (1, 47.0)), T_NS)
    callers.hear(heard(10**9, (1, 47.2), (2, 47.3), (3, None)), T_NS + 10**9)
    callers.hear(heard(2 * 10**9), T_NS + 2 * 10**9)
    assert callers.changed
    assert [(e.name, e.latitude_deg) for e in callers.events] == [("caller 1", 47.2), ("caller 2", 47.3)]
    # when it was heard: the sound's middle, less its age
    assert callers.events[0].t_ns == T_NS + 10**9 + 50_000_000 - 200_000_000


def pointed_at(
    azimuth: float, *, place: bool = True, confirmed: bool = True, silent_s: float = 0.0
) -> Estimate:
    """A frame with one caller, heard from 47, 8 in a direction."""
    track = Track(
        1.0, 0.05, -0.3, 0.1, 0.6, silent_s, 0.9, 1, confirmed, TrueBearing(azimuth, 0.06, -0.3, 0.1)
    )  # fmt: skip
    pose = Pose(50_000_000, (1.0, 0.0, 0.0, 0.0), 47.0 if place else None, 8.0, 420.0)
    return replace(heard(0), tracks=(track,), pose=pose)


def test_a_caller_without_a_place_is_its_last_bearing_until_there_is_one(tmp_path):
    callers = Callers(tmp_path / "callers.geojson")
    callers.hear(pointed_at(1.0, confirmed=False), T_NS)
    callers.hear(pointed_at(1.0, place=False), T_NS)
    assert callers.events == [], "not confirmed, or from nowhere known"
    callers.hear(pointed_at(1.0), T_NS)
    callers.hear(pointed_at(1.2), T_NS)
    callers.hear(pointed_at(2.0, silent_s=0.5), T_NS)
    (told,) = callers.events
    assert (told.name, told.azimuth_rad, told.latitude_deg) == ("caller 1", 1.2, 47.0)
    assert told.t_ns == T_NS + 50_000_000
    callers.hear(heard(0, (1, 47.2)), T_NS)
    callers.hear(pointed_at(1.4), T_NS)
    (told,) = callers.events
    assert isinstance(told, Event), "a place once known stays"
    assert callers.changed


def test_callers_are_bounded(tmp_path):
    callers = Callers(tmp_path / "callers.geojson")
    for id in range(MOST + 5):
        callers.hear(heard(0, (id, 47.0)), T_NS)
    assert [e.name for e in callers.events] == [f"caller {id}" for id in range(5, MOST + 5)]


def test_an_export_that_fails_under_way_is_told_and_tried_again(tmp_path, caplog):
    callers = Callers(tmp_path / "callers.geojson")
    callers.hear(heard(0, (1, 47.0)), T_NS)
    callers.changed = False
    callers.path = tmp_path / "gone" / "callers.geojson"
    _export_or_tell(callers, callers.events)
    assert "cannot be written" in caplog.text
    assert callers.changed
    callers.path = tmp_path / "callers.geojson"
    _export_news(callers)
    assert "caller 1" in callers.path.read_text()


@pytest.mark.parametrize(
    ("name", "words"), [("callers.shp", "ending"), ("nowhere/callers.kml", "there is no such folder")]
)
def test_a_map_file_that_cannot_be_is_said_before_the_flight(tmp_path, name, words):
    with pytest.raises(ExportError, match=words):
        Callers(tmp_path / name)


def test_what_cannot_be_written_is_said(tmp_path):
    with pytest.raises(ExportError, match=r"\.geojson, \.json, \.gpx, \.kml"):
        export([event()], tmp_path / "callers.shp")
    with pytest.raises(ExportError, match="cannot be written"):
        export([event()], tmp_path / "nowhere" / "callers.kml")
