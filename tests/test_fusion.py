"""Many vehicles, many callers, on the ground; and the files that carry them there."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from locagen_edge.cli import main
from locagen_edge.errors import ExportError
from locagen_edge.fusion import fuse
from locagen_edge.settings import PositionSettings
from locagen_edge.sightings import line as as_line
from locagen_edge.sightings import read
from locagen_edge.sim.flights import Errors, Flight, fly, line, miss_m
from locagen_edge.types import Sighting

SETTINGS = PositionSettings()
NOON_NS = 1_750_000_000 * 10**9
CALLERS = (np.array([40.0, 0.0]), np.array([-30.0, 45.0]))


def flight(rng, observer, caller, place_m, start_m, course_rad, seconds=6.0, **more) -> Flight:
    path = line(seconds, 2.0, np.array(start_m), 4.0, course_rad, 25.0)
    made = fly(path, place_m, Errors(), rng, observer=observer, caller=caller, **more)
    late = tuple(replace(look, t_ns=look.t_ns + NOON_NS) for look in made.sightings)
    return replace(made, sightings=late)


def two_by_two(seed, **more) -> list[Flight]:
    """Two vehicles hear two callers, and count them in opposite order."""
    rng = np.random.default_rng(seed)
    return [
        flight(rng, "A", 1, CALLERS[0], (0.0, -10.0), 1.5, **more),
        flight(rng, "A", 2, CALLERS[1], (0.0, -10.0), 1.5, **more),
        flight(rng, "B", 1, CALLERS[1], (20.0, 60.0), 3.0, **more),
        flight(rng, "B", 2, CALLERS[0], (20.0, 60.0), 3.0, **more),
    ]


def looks(flights) -> list[Sighting]:
    return [look for one in flights for look in one.sightings]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("elevations", [True, False])
def test_vehicles_that_count_differently_agree_on_who_is_who(seed, elevations):
    flights = two_by_two(seed, elevations=elevations)
    found = fuse(looks(flights), SETTINGS)
    assert {frozenset(fused.streams) for fused in found} == {
        frozenset({("A", 1), ("B", 2)}), frozenset({("A", 2), ("B", 1)}),
    }  # fmt: skip
    for fused in found:
        position = fused.position
        assert position.range_observable
        truth = flights[0] if ("A", 1) in fused.streams else flights[1]
        miss = math.hypot(*miss_m(truth, position.latitude_deg, position.longitude_deg))
        assert miss < 4.0 * position.semi_major_m
        assert fused.used + fused.unused == 24


def test_two_hovers_cross_where_neither_knows_the_range():
    rng = np.random.default_rng(5)
    bare = {"elevations": False, "heights": False}
    path = line(5.0, 2.0, np.zeros(2), 0.0, 0.0, 25.0)
    beside = replace(path, place_m=path.place_m + np.array([0.0, 40.0]))
    first = fly(path, CALLERS[0], Errors(), rng, observer="A", **bare)
    second = fly(beside, CALLERS[0], Errors(), rng, observer="B", like=first, **bare)
    for alone in (first, second):
        (fused,) = fuse(alone.sightings, SETTINGS)
        assert not fused.position.range_observable
    (fused,) = fuse(looks([first, second]), SETTINGS)
    assert fused.position.range_observable
    miss = math.hypot(*miss_m(first, fused.position.latitude_deg, fused.position.longitude_deg))
    assert miss < 4.0 * fused.position.semi_major_m


def test_two_tracks_of_one_vehicle_at_one_time_are_two_callers():
    one = flight(np.random.default_rng(6), "A", 1, CALLERS[0], (0.0, -10.0), 1.5)
    again = replace(one, sightings=tuple(replace(look, caller=2) for look in one.sightings))
    assert len(fuse(looks([one, again]), SETTINGS)) == 2


def test_a_track_that_broke_off_is_the_same_caller_later():
    rng = np.random.default_rng(7)
    one = flight(rng, "A", 1, CALLERS[0], (0.0, -10.0), 1.5)
    later = flight(rng, "A", 2, CALLERS[0], (0.0, 30.0), 1.5)
    shifted = replace(
        later, sightings=tuple(replace(look, t_ns=look.t_ns + 600 * 10**9) for look in later.sightings)
    )
    (fused,) = fuse(looks([one, shifted]), SETTINGS)
    assert set(fused.streams) == {("A", 1), ("A", 2)}


def test_the_order_of_lines_says_nothing():
    seen = looks(two_by_two(8))
    rng = np.random.default_rng(8)
    mixed = [seen[k] for k in rng.permutation(len(seen))]
    one, two = fuse(seen, SETTINGS), fuse(mixed, SETTINGS)
    assert [f.position.latitude_deg for f in one] == [f.position.latitude_deg for f in two]


def test_nothing_usable_gives_nobody():
    assert fuse([], SETTINGS) == ()
    bad = [replace(look, azimuth_rad=math.nan) for look in two_by_two(9)[0].sightings]
    assert fuse(bad, SETTINGS) == ()


# --- files --------------------------------------------------------------------------------------------


def test_records_of_other_types_are_passed_over(tmp_path):
    """Those of a black box."""
    look = looks(two_by_two(10))[0]
    path = tmp_path / "log-000001.jsonl"
    told = json.dumps({"type": "sighting", "utc": "x", **json.loads(as_line(look))})
    path.write_text('{"type": "start", "version": "1"}\n' + told + '\n{"type": "stop"}\n')
    assert len(list(read(path))) == 1


def test_a_line_comes_back_as_the_sighting(tmp_path):
    seen = looks(two_by_two(10))
    bare = replace(seen[0], altitude_m=None, height_m=None, elevation_rad=None)
    path = tmp_path / "A.jsonl"
    path.write_text("\n\n".join(as_line(look) for look in [*seen, bare]))
    for before, after in zip([*seen, bare], read(path), strict=True):
        assert abs(after.t_ns - before.t_ns) < 1000
        for name in Sighting.__slots__:
            if name != "t_ns":
                assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"azimuth_deg": None}, "lacks azimuth_deg"),
        ({"time_utc": "noon"}, "time_utc: 'noon' is no time like 2025"),
        ({"time_utc": None}, "time_utc: None is no time"),
        ({"latitude_deg": 91}, "latitude_deg: 91 is beyond 90"),
        ({"latitude_deg": "47"}, "latitude_deg: '47' is not a number"),
        ({"latitude_deg": math.nan}, "latitude_deg: nan is not a number"),
        ({"height_sigma_m": -1}, "height_sigma_m: -1 is below zero"),
        ({"caller": True}, "caller: True is not a number"),
    ],
)
def test_what_is_wrong_with_a_line_is_said_with_its_number(tmp_path, change, message):
    good = as_line(two_by_two(11)[0].sightings[0])
    path = tmp_path / "A.jsonl"
    path.write_text(f"{good}\n{json.dumps({**json.loads(good), **change})}\n")
    with pytest.raises(ExportError) as caught:
        list(read(path))
    assert str(caught.value).startswith(f"{path}:2: ")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"{", "is not JSON"), (b"[1]", "not a JSON object"), (b"\xff\xfe", "not a text")],
)
def test_what_is_no_sighting_at_all_is_said(tmp_path, content, message):
    path = tmp_path / "A.jsonl"
    path.write_bytes(content)
    with pytest.raises(ExportError, match=message):
        list(read(path))


def run(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return left.value.code, printed.out, printed.err


def test_the_command_prints_callers_and_writes_the_map(tmp_path, capsys):
    flights = two_by_two(12)
    for name, own in (("A", flights[:2]), ("B", flights[2:])):
        (tmp_path / f"{name}.jsonl").write_text("\n".join(map(as_line, looks(own))))
    output = tmp_path / "callers.geojson"
    code, out, err = run(capsys, "fuse", tmp_path / "A.jsonl", tmp_path / "B.jsonl", "-o", output)
    assert (code, err) == (0, "")
    assert out.startswith("caller 1: 4")
    assert len(out.splitlines()) == 2
    points = [f for f in json.loads(output.read_text())["features"] if f["geometry"]["type"] == "Point"]
    assert [p["properties"]["name"] for p in points] == ["caller 1", "caller 2"]


def test_the_command_says_what_it_does_not_know(tmp_path, capsys):
    rng = np.random.default_rng(13)
    path = line(5.0, 2.0, np.zeros(2), 0.0, 0.0, 25.0)
    bare = fly(path, CALLERS[0], Errors(), rng, heights=False)
    file = tmp_path / "A.jsonl"
    file.write_text("\n".join(map(as_line, bare.sightings)))
    code, out, _ = run(capsys, "fuse", file)
    assert code == 0
    assert "range not observable" in out
    file.write_text("")
    assert run(capsys, "fuse", file)[1].startswith("no caller")
    code, _, err = run(capsys, "fuse", tmp_path / "none.jsonl")
    assert code == 1
    assert err.startswith(f"locagen-edge: {tmp_path / 'none.jsonl'}: cannot be read")
    code, _, err = run(capsys, "fuse", file, "-o", tmp_path / "map.shp")
    assert code == 1
    assert ".kml" in err
