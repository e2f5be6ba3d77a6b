"""A flight past a caller, from sound to the map: what the link, the log, the recording and the export say."""

from __future__ import annotations

import asyncio
import json
import math
import re
import socket
import time
from collections.abc import AsyncGenerator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import flights
import pytest

from locagen_edge import cli
from locagen_edge.fusion import fuse
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table, sample
from locagen_edge.stages.mic import wav_frames
from locagen_edge.store.journal import records
from locagen_edge.types import Frame

SECONDS = 10.0
NEAR_M = 4.0
"""30 m away, flown past: compass and GPS of the settings alone are good for 2 m."""


def command(capsys, *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    shown = capsys.readouterr()
    assert end.value.code == 0, shown.err
    return shown.out


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> SimpleNamespace:
    """`run --record --export` on a flight's sound and poses, some times faster than it was flown."""
    folder = tmp_path_factory.mktemp("flight")
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    server.bind(("127.0.0.1", 0))
    settings = from_table(
        {
            "sim": {"snr_db": 10, "call": "speech"},
            "daemon": {"queue_frames": 1000},
            "mavlink": {"link": f"udpout:127.0.0.1:{server.getsockname()[1]}", "rate_hz": 10},
            "log": {"directory": str(folder / "log")},
            "position": {"vehicle": "heron"},
        }
    )
    (folder / "settings.toml").write_text(sample(settings))

    async def passing(settings: Settings, tap=None) -> AsyncGenerator[Frame, None]:
        for frame in flights.frames(settings, SECONDS, tap, time.monotonic_ns()):
            yield frame
            await asyncio.sleep(0.01)

    run = ["run", "--quiet", "--settings", folder / "settings.toml"]
    run += ["--record", folder / "sound", "--export", folder / "run.geojson"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("locagen_edge.sources.open_source", passing)
        with pytest.raises(SystemExit) as end:
            cli.main([str(argument) for argument in run])
    assert end.value.code == 0
    server.setblocking(False)
    framer, said = Framer(), []
    with server:
        try:
            while True:
                said += [dialect.decode(packet.raw) for packet in framer.feed(server.recv(4096))]
        except BlockingIOError:
            pass
    return SimpleNamespace(folder=folder, settings=settings, said=said)


def points(path: Path) -> list[dict]:
    features = json.loads(path.read_text())["features"]
    return [f for f in features if f["geometry"]["type"] == "Point"]


def assert_near(point: dict) -> None:
    longitude, latitude, altitude = point["geometry"]["coordinates"]
    assert flights.miss_m(latitude, longitude) < NEAR_M
    assert altitude == pytest.approx(flights.GROUND_M, abs=4.0)


def test_the_link_carries_the_place_as_message_and_in_a_tunnel(flown):
    told = [m for m in flown.said if m.get_type() == "LOCAGEN_POSITION"]
    tunnelled = [dialect.untunnel(m) for m in flown.said if m.get_type() == "TUNNEL"]
    in_tunnel = [m for m in tunnelled if m.get_type() == "LOCAGEN_POSITION"]
    assert len(told) == len(in_tunnel) > 3
    for last in (told[-1], in_tunnel[-1]):
        assert flights.miss_m(last.lat * 1e-7, last.lon * 1e-7) < NEAR_M
        assert last.alt * 1e-3 == pytest.approx(flights.GROUND_M, abs=4.0)
        assert last.looks > 10
        assert 0.5 < math.sqrt(last.covariance_nn) < NEAR_M
        assert last.flags & dialect.messages.LOCAGEN_POSITION_FLAGS_SIMULATED
        assert last.flags & dialect.messages.LOCAGEN_POSITION_FLAGS_CONFIRMED
    assert told[-1].covariance_nn < told[0].covariance_nn


def test_each_bearing_has_the_pose_of_its_moment_and_points_at_the_caller(flown):
    heard = [m for m in flown.said if m.get_type() == "LOCAGEN_BEARING" and m.event_id]
    assert len(heard) > 5
    for m in heard:
        away = flights.north_east_down_m(*flights.CALLER, 0.0, m.lat * 1e-7, m.lon * 1e-7, 0.0)
        assert away[0] == pytest.approx(flights.SOUTH_M, abs=0.1)
        off = (m.azimuth_true - math.degrees(math.atan2(away[1], away[0])) + 180.0) % 360.0 - 180.0
        assert abs(off) < 12.0  # a track's lag: the bearing turns by up to 18 degrees a second
        assert m.height == pytest.approx(flights.HEIGHT_M)


def test_the_operator_reads_how_far_it_is_once(flown):
    texts = [m.text for m in flown.said if m.get_type() == "STATUSTEXT"]
    placed = [t for t in texts if re.fullmatch(r"Call heard: \d{3} deg true, \d+ m \+-\d+ m, conf \d\.\d", t)]
    assert len(placed) == 1
    distance_m = int(re.search(r"(\d+) m \+", placed[0])[1])
    assert 20 < distance_m < 55


def test_the_export_of_the_run_is_near_the_truth_and_of_today(flown):
    (point,) = points(flown.folder / "run.geojson")
    assert_near(point)
    heard = datetime.fromisoformat(point["properties"]["time_utc"])
    assert abs(datetime.now(UTC) - heard) < timedelta(minutes=5)


def test_the_log_has_the_place_with_the_call_and_the_looks_that_made_it(flown, capsys):
    kept = list(records(flown.folder / "log"))
    (end,) = [r for r in kept if r["type"] == "call" and r["event"] == "end"]
    assert flights.miss_m(end["position"]["latitude_deg"], end["position"]["longitude_deg"]) < NEAR_M
    looks = [r for r in kept if r["type"] == "sighting"]
    assert len(looks) == end["position"]["looks"]
    assert {r["observer"].split()[0] for r in looks} == {"heron"}
    shown = command(capsys, "log", flown.folder / "log")
    assert re.search(r"1 ends after .* at 4[67]\.\d{6}, [78]\.\d{6} ±\d m", shown)
    assert " sighting " not in shown


def test_the_log_of_a_vehicle_is_fused_on_the_ground(flown, capsys):
    path = flown.folder / "fused.geojson"
    shown = command(capsys, "fuse", flown.folder / "log", "-o", path)
    assert shown.startswith("caller 1: 4")
    assert "heron" in shown
    (point,) = points(path)
    assert_near(point)
    parts = sorted((flown.folder / "log").glob("log-*.jsonl"))
    assert command(capsys, "fuse", *parts) == shown  # files of all records, like the folder


def test_a_replayed_flight_gives_the_same_places(flown, capsys):
    path = flown.folder / "replay.gpx"
    lines = command(capsys, "replay", flown.folder / "sound", "--export", path).splitlines()
    again = {round(line["t_s"] * 10_000): line["callers"] for line in map(json.loads, lines)}
    told = [
        (r["start"], p)
        for r in records(flown.folder / "log")
        if r["type"] == "bearing"
        for p in r["positions"]
    ]
    assert len(told) > 50
    for start, position in told:
        (same,) = [c for c in again[start] if c["id"] == position["caller"]]
        for name in ("latitude_deg", "longitude_deg"):
            if position[name] is None:
                assert same[name] is None
            else:
                assert same[name] == pytest.approx(position[name], abs=1e-7)
    live = points(flown.folder / "run.geojson")[0]["properties"]["time_utc"]
    day = re.search(r"<time>(.*?)</time>", path.read_text())[1]
    apart = datetime.fromisoformat(day) - datetime.fromisoformat(live)
    assert abs(apart) < timedelta(milliseconds=5)


def test_poses_at_other_hops_lie_between_those_that_were_recorded(flown):
    settings = replace(flown.settings, audio=replace(flown.settings.audio, hop=400))
    found = list(wav_frames(sorted((flown.folder / "sound").glob("*.wav")), settings))
    assert sum(frame.pose is not None for frame in found) > 0.95 * len(found)
    for frame in found[1:-3]:
        true = flights.pose(frame.middle_ns * 1e-9, frame.middle_ns)
        assert frame.pose.t_ns == frame.middle_ns
        assert frame.pose.longitude_deg == pytest.approx(true.longitude_deg, abs=1e-7)  # a straight line
        assert frame.pose.attitude == pytest.approx(true.attitude, abs=1e-3)


def test_without_poses_there_are_bearings_and_no_place(flown):
    pipeline = Pipeline(flown.settings)
    heard = [pipeline.process(replace(f, pose=None)) for f in flights.frames(flown.settings, 3.0)]
    assert any(e.track for e in heard)
    assert not any(e.positions or e.sightings for e in heard)


def test_two_microphones_bear_and_place_nobody():
    """Their mirror image is as likely: on the wrong side of the line that is flown."""
    settings = from_table(
        {
            "array": {"positions_m": [[0, 0.05, 0], [0, -0.05, 0]]},
            "audio": {"channel_map": [0, 1]},
            "bearing": {"estimator": "two-mic"},
            "detection": {"snr_db": -20},
            "sim": {"snr_db": 20, "call": "white"},
        }
    )
    pipeline = Pipeline(settings)
    heard = [pipeline.process(f) for f in flights.frames(settings, 5.0)]
    assert any(e.track and e.track.confirmed and e.track.earth for e in heard)
    assert not any(e.positions or e.sightings for e in heard)


def test_calls_too_far_apart_for_one_track_are_one_caller_on_the_ground(flown):
    """2.5 s of silence end a track; what was seen of each adds up all the same."""
    settings = replace(flown.settings, sim=replace(flown.settings.sim, call_s=1.0, pause_s=2.5))
    pipeline = Pipeline(settings)
    looks = [look for f in flights.frames(settings, 12.0) for look in pipeline.process(f).sightings]
    assert len({look.caller for look in looks}) > 2
    (found,) = fuse(looks, settings.position)
    assert flights.miss_m(found.position.latitude_deg, found.position.longitude_deg) < NEAR_M
