"""Field recordings: a stand-in folder made by the scene, its labels, and everything wrong with labels."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
import soundfile

from locagen_edge.errors import DatasetError
from locagen_edge.geodesy import north_east_down_m
from locagen_edge.lab.cli import main
from locagen_edge.lab.evaluate import evaluate
from locagen_edge.lab.labels import COLUMNS, read_labels
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.scene import Scene

SECONDS = 12


def scene_of(**sim) -> Settings:
    calm = {"call": "white", "rotors": 0, "snr_db": 20.0, "height_m": 0.0, "call_s": 1.5, "pause_s": 1.0}
    return from_table({"sim": {**calm, **sim}})


def record(folder, name, settings: Settings, seconds=SECONDS) -> list[dict]:
    """A recording by the scene, and labels in the middle of calls, with the scene's own truth."""
    rate_hz = settings.audio.rate_hz
    scene = Scene(settings)
    soundfile.write(folder / name, scene.render(seconds * rate_hz).T, rate_hz, subtype="PCM_16")
    rows = []
    for k in range(1, int(seconds / 2.5)):
        time_s = 2.5 * k + 0.75
        truth = scene.truth(time_s * rate_hz)
        rows.append({
            "file": name,
            "time_s": time_s,
            "azimuth_deg": round(math.degrees(truth.azimuth_rad), 3),
            "range_m": round(truth.range_m, 3),
        })  # fmt: skip
    return rows


def write_csv(folder, rows) -> None:
    names = [name for name in COLUMNS if any(name in row for row in rows)]
    with (folder / "labels.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Two recordings of a caller who goes slowly: a label is up to half a hop, 26 ms, from its frame."""
    folder = tmp_path_factory.mktemp("field")
    rows = record(folder, "far.wav", scene_of(turn_deg_s=4.0))
    rows += record(
        folder, "near.wav", scene_of(azimuth_deg=200.0, turn_deg_s=-4.0, distance_m=0.6, snr_db=30.0)
    )
    write_csv(folder, rows)
    return folder


def test_a_field_like_the_twin_is_told_to_be_one(field, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "--recordings", str(field), "--out", str(tmp_path / "out")])
    assert ended.value.code == 0
    assert "6 labels" in capsys.readouterr().out
    result = json.loads((tmp_path / "out" / "report.json").read_text())
    told = result["statistics"]
    # the scene's microphones are where they should be, the twin's off by up to a millimetre: 0.4 degrees
    assert told["mean_deg"] < 0.8  # one frame's sigma under these rotors is 0.6
    assert abs(told["bias_deg"]) < 0.3
    assert told["within_twin_95"] >= 5 / 6  # of six labels, each with 95 %
    assert told["without_bearing"] == 0
    near = [row for row in result["labels"] if row["file"] == "near.wav"]
    assert all(row["error_m"] is None or abs(row["error_m"]) < 0.3 for row in near)
    far = [row for row in result["labels"] if row["file"] == "far.wav"]
    assert not any(row["range_observable"] for row in far)
    assert np.mean([row["twin_deg"] for row in far]) == pytest.approx(0.4, abs=0.15)
    assert told["range_compared"] == sum(row["error_m"] is not None for row in near) > 0
    assert told["range_mean_m"] < 0.2
    assert told["twin_range_share"] < 0.5
    text = (tmp_path / "out" / "report.md").read_text()
    assert "nan" not in text
    assert text.count("| labels.csv:") == len(result["labels"])
    assert (tmp_path / "out" / "error.png").read_bytes().startswith(b"\x89PNG")


def test_an_array_that_is_turned_shows_as_a_common_turn(field, tmp_path) -> None:
    with (field / "labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    turned = tmp_path / "turned"
    turned.mkdir()
    (turned / "far.wav").symlink_to(field / "far.wav")
    for row in rows:
        row["azimuth_deg"] = float(row["azimuth_deg"]) - 10.0
    write_csv(turned, [row for row in rows if row["file"] == "far.wav"])
    told = evaluate(turned, LabSettings())["statistics"]
    assert told["bias_deg"] == pytest.approx(10.0, abs=0.3)
    assert told["mean_without_bias_deg"] < 0.3


def test_places_by_gps_and_lines_of_json_are_the_same_labels(field, tmp_path) -> None:
    wanted = read_labels(field)[0]
    heading = 30.0
    bearing = wanted.azimuth_rad + math.radians(heading)
    metre_deg = 1.0 / 111_320.0  # of latitude; of longitude over the cosine
    place = {
        "lat": 47.0 + wanted.range_m * math.cos(bearing) * metre_deg,
        "lon": 8.0 + wanted.range_m * math.sin(bearing) * metre_deg / math.cos(math.radians(47.0)),
        "array_lat": 47.0, "array_lon": 8.0, "heading_deg": heading,
    }  # fmt: skip
    (tmp_path / "far.wav").symlink_to(field / "far.wav")
    row = {"file": "far.wav", "time_s": wanted.time_s, **place, "note": "by the barn"}
    (tmp_path / "labels.jsonl").write_text(json.dumps(row) + "\n\n")
    (found,) = read_labels(tmp_path)
    # the earth is no sphere: 0.4 % of the range, 0.2 degrees
    assert found.azimuth_rad == pytest.approx(wanted.azimuth_rad, abs=math.radians(0.3))
    assert found.range_m == pytest.approx(wanted.range_m, rel=0.005)


# GeographicLib 2.1, Geodesic.WGS84.Inverse: distance and azimuth at the first place
@pytest.mark.parametrize(
    ("first", "second", "distance_m", "azimuth_deg"),
    [
        ((47.0, 8.0), (47.0005, 8.0010), 94.202973, 53.838356),
        ((-33.9, 151.2), (-33.9004, 151.1995), 64.087943, -133.812777),
        ((64.1, -21.9), (64.1, -21.8990), 48.756793, 89.999550),
        ((0.0, 0.0), (0.0009, 0.0), 99.516848, 0.0),
    ],
)
def test_the_earth_is_that_of_wgs_84(first, second, distance_m, azimuth_deg) -> None:
    north, east, down = north_east_down_m(*second, 0.0, *first, 0.0)
    assert math.hypot(north, east) == pytest.approx(distance_m, abs=1e-5)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(azimuth_deg, abs=1e-5)
    assert down == pytest.approx(0.0, abs=1e-3)  # the surface falls away by d^2 / 2 R


def test_down_is_down() -> None:
    np.testing.assert_allclose(north_east_down_m(47.0, 8.0, 0.0, 47.0, 8.0, 60.0), [0, 0, 60.0], atol=1e-6)


HEAD = "file,time_s,azimuth_deg,range_m\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD + "far.wav,1,two,3\n", r"labels\.csv:2: azimuth_deg: 'two' is not a number"),
        (HEAD + "far.wav,nan,2,3\n", r"labels\.csv:2: time_s: 'nan' is not a finite number"),
        (HEAD + "far.wav,-1,2,3\n", r"labels\.csv:2: time_s: -1 is outside"),
        (HEAD + "far.wav,1,400,3\n", r"labels\.csv:2: azimuth_deg: 400 is outside"),
        (HEAD + "far.wav,1,2,-3\n", r"labels\.csv:2: range_m: -3 is outside"),
        (HEAD + "far.wav,,2,3\n", r"labels\.csv:2: time_s: is missing"),
        (HEAD + "far.wav,1,,3\n", r"labels\.csv:2: azimuth_deg: is missing, and for a place by GPS lat,"),
        (HEAD + ",1,2,3\n", r"labels\.csv:2: file: is missing"),
        (HEAD + "\nnear.wav,1,2,3\n", r"labels\.csv:3: file: there is no"),
        (HEAD + "far.wav,1,2\n", r"labels\.csv:2: 3 values for 4 columns"),
        (HEAD + "far.wav,13,2,3\n", r"labels\.csv:2: time_s: 13 is after the end of far\.wav, 12\.00 s long"),
        ("file,time,azimuth_deg\n", r"labels\.csv:1: time: unknown column; known are file, time_s"),
        (HEAD, "holds no label"),
    ],
)
def test_labels_that_cannot_be_used_are_refused_by_line_and_column(field, tmp_path, text, says) -> None:
    (tmp_path / "far.wav").symlink_to(field / "far.wav")
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(DatasetError, match=says):
        evaluate(tmp_path, LabSettings())


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", r"labels\.jsonl:1: is not JSON"),
        ("[1]", r"labels\.jsonl:1: is not an object"),
        ('{"file": "far.wav", "time_s": true, "azimuth_deg": 1}', r":1: time_s: True is not a finite number"),
        ('{"file": 3, "time_s": 1, "azimuth_deg": [1]}', r":1: azimuth_deg: \[1\] is not a number"),
        ('{"file": "far.wav", "t": 1}', r":1: t: unknown column"),
    ],
)
def test_lines_of_json_that_cannot_be_used_are_refused(field, tmp_path, text, says) -> None:
    (tmp_path / "far.wav").symlink_to(field / "far.wav")
    (tmp_path / "labels.jsonl").write_text(text + "\n")
    with pytest.raises(DatasetError, match=says):
        read_labels(tmp_path)


def test_all_faults_are_told_at_once_by_the_command(field, tmp_path, capsys) -> None:
    (tmp_path / "far.wav").symlink_to(field / "far.wav")
    (tmp_path / "labels.csv").write_text(HEAD + "far.wav,x,2,3\ngone.wav,1,999,3\n")
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "--recordings", str(tmp_path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[2] for line in lines] == ["2", "3", "3"]
    assert not (tmp_path / "out").exists()


def test_a_folder_without_labels_or_with_two_files_is_refused(tmp_path) -> None:
    with pytest.raises(DatasetError, match="neither of"):
        read_labels(tmp_path)
    for name in ("labels.csv", "labels.jsonl"):
        (tmp_path / name).write_text("")
    with pytest.raises(DatasetError, match="both of"):
        read_labels(tmp_path)
