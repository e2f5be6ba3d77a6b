"""The black box: nothing is lost that the disk can take, no bound is passed, and no disk stops the daemon."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from peers import free_port
from scenes import heard
from test_daemon import running, source, until

from locagen_edge.framing import as_captured
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table, load
from locagen_edge.sim.scene import frames as sim_frames
from locagen_edge.stages.mic import wav_frames
from locagen_edge.store import blackbox, flac, wav
from locagen_edge.store.blackbox import BlackBox, directory_of
from locagen_edge.store.journal import Journal, records, size
from locagen_edge.store.logbook import chosen, row
from locagen_edge.store.plain import plain
from locagen_edge.types import Detection, Estimate, Frame, Track

HOP_NS = 51_200_000
FIRST: Estimate = Pipeline(Settings()).process(next(sim_frames(Settings())))
TRACK = Track(1.0, 0.05, -0.3, 0.1, 0.6, 0.0, 0.9)
"""confirmed"""


def is_confirmed(track: Track) -> bool:
    """The black box is told what a call is; here, this."""
    return track.confidence > 0.5


def estimate(number: int, *, track: Track | None = None, call: bool = False, faults=()) -> Estimate:
    return replace(
        FIRST,
        t_ns=number * HOP_NS,
        start=number * 512,
        track=track,
        tracks=() if track is None else (track,),
        detection=Detection(call, 7.0, -30.0),
        faults=faults,
    )


def frame(number: int) -> Frame:
    """Sample n of microphone m is n + m / 4 in some millionths."""
    at = number * 512 + np.arange(1024)[np.newaxis, :] + np.arange(3)[:, np.newaxis] / 4
    return Frame((at * 1e-6).astype(np.float32), 10_000.0, number * HOP_NS, number * 512)


def kept(directory: Path, estimates: list[Estimate], frames=frame, **log) -> list[dict]:
    """What a box keeps of these."""
    settings = from_table({"log": {"directory": str(directory), **log}})
    box = BlackBox(directory, settings, is_confirmed)
    for each in estimates:
        while box._worker.waiting >= blackbox.WAITING:  # the test is faster than sound
            os.sched_yield()
        box.hear(frames(each.t_ns // HOP_NS), each)
    assert box.close(20)
    assert box.lost == 0
    return list(records(directory))


def of(found: list[dict], kind: str, event: str = "") -> list[dict]:
    return [r for r in found if r["type"] == kind and r.get("event", "") == event]


# --- the journal


def record_of(number: int, length: int) -> dict:
    return {"type": "x", "number": number, "text": "x" * length}


@given(
    lengths=st.lists(st.integers(0, 3000), max_size=60),
    part=st.integers(50, 1000),
    parts=st.floats(2, 8),
    starts=st.sets(st.integers(0, 60)),
)
def test_no_record_of_any_size_passes_the_bound_and_the_newest_are_kept(
    tmp_path_factory, lengths, part, parts, starts
):
    directory = tmp_path_factory.mktemp("log")
    total = round(parts * part)
    journal = Journal(directory, total, part)
    taken = []
    for number, length in enumerate(lengths):
        if number in starts:
            journal.close()
            journal = Journal(directory, total, part)
        record = record_of(number, length)
        if journal.append(record):
            taken.append(record)
            assert size(directory) <= total
        else:
            assert length + 50 > total
    journal.close()
    found = list(records(directory)) if any(directory.iterdir()) else []
    assert found == taken[len(taken) - len(found) :]
    assert bool(found) == bool(taken)


@given(cut=st.floats(0, 1))
def test_a_log_torn_anywhere_is_read_up_to_there_and_gone_on_with(tmp_path_factory, cut):
    directory = tmp_path_factory.mktemp("log")
    journal = Journal(directory, 10**6, 10**5)
    written = [record_of(number, 20) for number in range(10)]
    for record in written:
        journal.append(record)
    journal.close()
    path = directory / "log-000001.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[: round(cut * len(whole))])
    left = list(records(directory))
    assert left == written[: len(left)]
    assert len(left) == whole[: round(cut * len(whole))].count(b"\n")
    journal = Journal(directory, 10**6, 10**5)
    journal.append(record_of(99, 5))
    journal.close()
    again = list(records(directory))
    assert again[:-1] in (left, written[: len(left) + 1])  # cut right before the newline, it was whole
    assert again[-1]["number"] == 99


def test_what_is_no_text_is_passed_over(tmp_path):
    (tmp_path / "log-000001.jsonl").write_bytes(b'\xff\x00\n{"type":"x"}\n17\n{"type":')
    assert list(records(tmp_path)) == [{"type": "x"}]


# --- what is kept


def test_every_field_of_an_estimate_is_kept_by_its_name():
    pose = {f.name.replace("_rad", "_deg") for f in dataclasses.fields(Estimate)}
    found = plain(replace(FIRST, track=TRACK))
    assert found.keys() == pose
    assert found["track"].keys() == {f.name.replace("_rad", "_deg") for f in dataclasses.fields(Track)}
    assert found["track"]["azimuth_deg"] == pytest.approx(math.degrees(1.0), abs=1e-3)
    assert found["track"]["elevation_deg"] == pytest.approx(math.degrees(-0.3), abs=1e-3)
    json.dumps(found, allow_nan=False)


@given(azimuth=st.floats(-math.pi, math.pi), sigma=st.floats(0, math.inf))
def test_an_azimuth_is_kept_from_0_to_360_and_what_is_no_number_as_null(azimuth, sigma):
    found = plain(replace(TRACK, azimuth_rad=azimuth, azimuth_sigma_rad=sigma))
    turn = math.degrees(azimuth) - found["azimuth_deg"]
    assert abs(turn - 360.0 * round(turn / 360.0)) < 1e-3
    assert 0.0 <= found["azimuth_deg"] <= 360.0
    assert (found["azimuth_sigma_deg"] is None) == math.isinf(math.degrees(sigma))


def test_several_callers_are_told_apart_by_their_ids(tmp_path):
    def heard(number: int, *ids: int) -> Estimate:
        return replace(estimate(number), tracks=tuple(replace(TRACK, id=each) for each in ids))

    both = [heard(n, 5, 9) for n in range(10)]
    one = [heard(n, 9) for n in range(10, 20)]
    found = kept(tmp_path, both + one)
    assert [r["track"]["id"] for r in of(found, "call", "begin")] == [5, 9]
    assert [(r["track"]["id"], r["t_ns"] // HOP_NS) for r in of(found, "call", "end")] == [(5, 9), (9, 19)]


def test_every_bearing_while_something_calls_and_one_a_second_else(tmp_path):
    quiet = [estimate(n) for n in range(100)]
    calling = [estimate(n, call=True) for n in range(100, 150)]
    tracked = [estimate(n, track=TRACK) for n in range(150, 200)]
    found = of(kept(tmp_path, quiet + calling + tracked), "bearing")
    assert [r["start"] // 512 for r in found if r["start"] < 100 * 512] == [0, 20, 40, 60, 80]
    assert [r["start"] // 512 for r in found][-100:] == list(range(100, 200))


def test_a_call_begins_when_it_is_confirmed_and_ends_with_its_track(tmp_path):
    def track(age_s: float, sigma: float, id: int = 1) -> Track:
        return replace(TRACK, age_s=age_s, azimuth_sigma_rad=sigma, id=id)

    young = [estimate(n, track=replace(track(0.05 * n, 0.1), confidence=0.2)) for n in range(10)]
    grown = [estimate(n, track=track(0.05 * n, 0.1 - 0.001 * n)) for n in range(10, 40)]
    other = [estimate(n, track=track(0.05 * (n - 30), 0.1, id=2)) for n in range(40, 60)]
    gone = [estimate(n) for n in range(60, 70)]
    found = kept(tmp_path, young + grown + other + gone)
    begins, ends = of(found, "call", "begin"), of(found, "call", "end")
    assert [(r["call"], r["t_ns"] // HOP_NS) for r in begins] == [(1, 10), (2, 40)]
    assert [(r["call"], r["t_ns"] // HOP_NS) for r in ends] == [(1, 39), (2, 59)]
    assert [r["begin_t_ns"] // HOP_NS for r in ends] == [10, 40]
    assert [r["begin_utc"] for r in ends] == [r["utc"] for r in begins]
    assert ends[0]["best"]["azimuth_sigma_deg"] == pytest.approx(math.degrees(0.1 - 0.039), rel=1e-4)
    assert ends[0]["track"]["azimuth_deg"] == pytest.approx(math.degrees(1.0), rel=1e-4)
    assert ends[0]["snippet"] is None


def test_a_call_that_the_end_of_the_daemon_cuts_is_ended(tmp_path):
    found = kept(tmp_path, [estimate(n, track=TRACK) for n in range(5)])
    assert [r["type"] for r in found[-2:]] == ["call", "stop"]
    assert found[-2]["event"] == "end"


def test_a_fault_that_flickers_is_one_and_one_that_went_is_told(tmp_path):
    flickers = [estimate(n, faults=("microphone 1: dead",) if n % 7 == 0 else ()) for n in range(100)]
    well = [estimate(n) for n in range(100, 250)]
    found = kept(tmp_path, flickers + well)
    assert [r["text"] for r in of(found, "fault", "begin")] == ["microphone 1: dead"]
    (end,) = of(found, "fault", "end")
    assert 5.0 < (end["t_ns"] - 98 * HOP_NS) * 1e-9 < 5.2


def test_states_are_kept_when_they_change(tmp_path):
    box = BlackBox(tmp_path, Settings(), is_confirmed)
    for up in (False, False, True, True, False):
        box.watch(link={"up": up, "error": ""}, source={"fault": ""})
    assert box.close(20)
    found = list(records(tmp_path))
    assert [r["up"] for r in found if r["type"] == "link"] == [False, True, False]
    assert len([r for r in found if r["type"] == "source"]) == 1


def test_what_was_set_and_commanded_in_flight_is_kept_in_words(tmp_path):
    box = BlackBox(tmp_path, Settings(), is_confirmed)
    for on, changed in (
        (True, {}),
        (True, {"LG_ARRAY_YAW": 90.0, "LG_TX_ADSB": 1.0}),
        (False, {}),
        (False, {}),
    ):
        box.watch(listening={"on": on}, parameters=changed)
    assert box.close(20)
    kinds = ("listening", "parameters")
    words = [row(r).split("  ", 1)[1].split() for r in records(tmp_path) if r["type"] in kinds]
    assert [" ".join(w) for w in words] == [
        "listening listening",
        "parameters as in the settings file",
        "parameters LG_ARRAY_YAW 90, LG_TX_ADSB 1",
        "listening told to stop listening",
        "parameters as in the settings file",
    ]


def test_start_holds_the_settings(tmp_path):
    found = kept(tmp_path, [])
    assert from_table(found[0]["settings"]).log.directory == str(tmp_path)
    assert [r["type"] for r in found] == ["start", "stop"]


# --- the sound of calls


def calls_of(directory: Path) -> list[Path]:
    return sorted((directory / "calls").glob("*.flac"))


def test_a_snippet_holds_what_came_before_the_call_and_after_it(tmp_path):
    quiet = [estimate(n) for n in range(100)]
    calling = [estimate(n, track=TRACK) for n in range(100, 140)]
    after = [estimate(n) for n in range(140, 200)]
    found = kept(tmp_path, quiet + calling + after, snippets=True, before_s=2.0, after_s=1.0)
    (path,) = calls_of(tmp_path)
    (end,) = of(found, "call", "end")
    assert end["snippet"] == path.stem
    sound, rate = soundfile.read(path, dtype="float32")
    assert rate == 10_000
    number = np.rint(sound[:, 0] * 1e6)
    assert (np.diff(number) == 1).all()  # every sample once, in order
    heard = 100 * 512 + 1024  # the end of the frame in which the call was confirmed
    assert 2.0 <= (heard - number[0]) * 1e-4 < 2.0 + 0.11
    over = 139 * 512 + 1024
    assert 1.0 <= (number[-1] + 1 - over) * 1e-4 < 1.0 + 0.11


def test_a_snippet_replays_to_its_sound_and_tells_of_a_gap(tmp_path):
    settings = from_table({"audio": {"channel_map": [1, 2, 0]}})
    heard = list(islice(sim_frames(settings), 60))
    holed = [*heard[:30], replace(heard[35], overruns=1), *heard[36:]]
    estimates = {f.t_ns: estimate(k, track=TRACK) for k, f in enumerate(holed)}
    box = BlackBox(
        tmp_path,
        from_table({"audio": {"channel_map": [1, 2, 0]}, "log": {"snippets": True, "before_s": 30}}),
        is_confirmed,
    )
    for each in holed:
        box.hear(each, estimates[each.t_ns])
    assert box.close(20)
    (path,) = calls_of(tmp_path)
    again = list(wav_frames(path, settings))
    assert sum(f.overruns for f in again) == 1
    assert len(again) == len(holed)
    for a, b in zip(holed, again, strict=True):
        assert np.abs(a.samples - b.samples).max() <= 2.0**-23  # 24 bits
        assert a.t_ns - holed[0].t_ns == b.t_ns - again[0].t_ns


def test_a_snippet_of_a_calibrated_array_replays_to_the_bearings_of_the_day(tmp_path):
    """Channels that are late and loud are mended once: what was heard is told by the settings beside it."""
    late = {"delays_s": [0.0, 50e-6, -30e-6], "gains_db": [0.0, 3.0, -2.0]}
    sections = {"array": late, "audio": {"channel_map": [1, 2, 0]}, "bearing": {"estimator": "far-field"}}
    captured = as_captured(heard(Settings(), 0.7, -0.5, 20.0, 20_480), (1, 2, 0))
    soundfile.write(tmp_path / "day.wav", captured, 10_000, subtype="FLOAT")
    settings = from_table({**sections, "log": {"snippets": True, "before_s": 30}})
    pipeline, box = Pipeline(settings), BlackBox(tmp_path, settings, is_confirmed)
    live = []
    for number, each in enumerate(wav_frames(tmp_path / "day.wav", settings)):
        live.append(pipeline.process(each).bearing.azimuth_rad)
        box.hear(each, estimate(number, track=TRACK))
    assert box.close(20)
    (path,) = calls_of(tmp_path)
    beside = load(path.with_suffix(".toml"))
    assert replace(beside, array=settings.array) == settings
    pipeline = Pipeline(beside)
    again = [pipeline.process(each).bearing.azimuth_rad for each in wav_frames(path, beside)]
    # 24 bits of FLAC: far less than a thousandth of a degree
    np.testing.assert_allclose(np.degrees(again), np.degrees(live), atol=1e-3)


def test_a_snippet_has_the_settings_that_its_call_began_with(tmp_path):
    settings = from_table({"log": {"snippets": True, "before_s": 0.5, "after_s": 0.2}})
    turned = replace(settings, array=replace(settings.array, mount_deg=(0.0, 0.0, 90.0)))
    box = BlackBox(tmp_path, settings, is_confirmed)
    for number in range(90):
        if number == 20:  # a call goes on from 10 to 30
            box.apply(turned)
        box.hear(frame(number), estimate(number, track=TRACK if number % 40 in range(10, 30) else None))
    assert box.close(20)
    assert [load(path.with_suffix(".toml")) for path in calls_of(tmp_path)] == [settings, turned]


def test_what_a_loss_of_power_left_is_packed_with_the_next_call(tmp_path):
    kept(tmp_path, [estimate(n, track=TRACK) for n in range(40)], snippets=True)
    (whole,) = calls_of(tmp_path)
    rows, rate = soundfile.read(whole, dtype="float32")
    torn = whole.with_name("20200101T000000Z-0001.wav.part")
    soundfile.write(torn, rows, rate, format="WAV", subtype="FLOAT")
    torn.write_bytes(wav.header(rate, rows.shape[1], "float32", 0) + rows.tobytes())
    kept(tmp_path, [estimate(n, track=TRACK) for n in range(40)], snippets=True)
    found = calls_of(tmp_path)
    assert len(found) == 3
    assert np.array_equal(soundfile.read(found[0], dtype="float32")[0], rows)
    assert not [p for p in (tmp_path / "calls").iterdir() if p.suffix in (".wav", ".part")]


def test_sound_that_cannot_be_packed_stays_as_it_is(tmp_path, monkeypatch):
    path = tmp_path / "a.wav"
    soundfile.write(path, np.zeros((10, 9), np.float32), 10_000)
    assert flac.pack(path) == path, "more channels than FLAC has"
    soundfile.write(path, np.zeros((10, 3), np.float32), 10_000)

    def full(file, *_, **__):
        Path(file).write_bytes(b"fLaC")
        raise soundfile.LibsndfileError(2)

    with monkeypatch.context() as patch:
        patch.setattr(soundfile, "write", full)
        with pytest.raises(OSError, match=r"a\.wav"):
            flac.pack(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.wav"]
    assert flac.pack(path).name == "a.flac"
    assert [p.name for p in tmp_path.iterdir()] == ["a.flac"]


def test_snippets_stay_under_their_bounds(tmp_path):
    settings = {"snippets": True, "longest_s": 2.0, "snippets_mb": 0.8, "before_s": 0.5, "after_s": 0.2}
    many = [estimate(n, track=TRACK if n % 30 < 15 else None) for n in range(300)]
    endless = [estimate(n, track=TRACK) for n in range(300, 420)]
    kept(tmp_path, many + endless, **settings)
    files = list((tmp_path / "calls").iterdir())
    assert sum(p.stat().st_size for p in files) <= 800_000
    assert len(calls_of(tmp_path)) >= 3
    assert soundfile.info(calls_of(tmp_path)[-1]).duration == pytest.approx(2.0, abs=0.11)


def test_a_folder_for_snippets_that_cannot_be_costs_no_record(tmp_path, caplog):
    (tmp_path / "calls").touch()
    many = [estimate(n, track=TRACK if n % 30 < 15 else None) for n in range(90)]
    found = kept(tmp_path, many, snippets=True)
    assert len(of(found, "call", "end")) == 3
    assert len([r for r in caplog.records if "the sound of calls is not kept" in r.message]) == 1


# --- a disk that fails


@pytest.fixture
def full(tmp_path) -> Path:
    (tmp_path / "log-000001.jsonl").symlink_to("/dev/full")
    return tmp_path


def test_a_full_disk_is_told_once_and_counted(full, caplog):
    box = BlackBox(full, Settings(), is_confirmed)
    for number in range(50):
        box.hear(frame(number), estimate(number, call=True))
    assert box.close(20)
    assert box.lost == 52  # start and stop too
    told = [r.message for r in caplog.records]
    assert told == [f"{full}: the log is not written: No space left on device"]


def test_a_disk_with_room_again_is_written_to_again(full, caplog, monkeypatch):
    monkeypatch.setattr(blackbox, "RETRY_S", 0.0)
    box = BlackBox(full, Settings(), is_confirmed)
    for number in range(10):
        box.hear(frame(number), estimate(number, call=True))
    while box.lost < 11:
        os.sched_yield()
    (full / "log-000001.jsonl").unlink()
    for number in range(10, 20):
        box.hear(frame(number), estimate(number, call=True))
    assert box.close(20)
    found = list(records(full))
    assert found[0]["type"] == "lost"
    assert found[0]["records"] == 11
    assert [r["start"] // 512 for r in of(found, "bearing")] == list(range(10, 20))
    assert caplog.messages[0].endswith("the log is not written: No space left on device")
    assert len([m for m in caplog.messages if "not written" in m]) == 1


@pytest.mark.parametrize("where", ["under a file", "/proc/nowhere"])
def test_a_place_that_cannot_be_written_to_stops_nothing(tmp_path, where, caplog):
    (tmp_path / "file").touch()
    directory = tmp_path / "file" / "log" if where == "under a file" else Path(where)
    box = BlackBox(directory, from_table({"log": {"snippets": True}}), is_confirmed)
    for number in range(30):
        box.hear(frame(number), estimate(number, track=TRACK))
    assert box.close(20)
    assert box.lost == 34  # with start, stop, and the call's two
    assert len([m for m in caplog.messages if "the log is not written" in m]) == 1


# --- in the daemon


def test_no_bearing_is_lost_while_the_link_is_down(tmp_path):
    settings = from_table(
        {
            "mavlink": {"link": f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"},
            "bearing": {"estimator": "far-field"},  # which needs no noise first
            "detection": {"snr_db": -20},
            "log": {"directory": str(tmp_path)},
        }
    )
    spoken = []

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            process = daemon.pipeline.process

            def listening(*arguments) -> Estimate:
                spoken.append(process(*arguments))
                return spoken[-1]

            daemon.pipeline.process = listening
            await until(lambda: len(spoken) > 40 and daemon.links.last_error)
            assert not daemon.links.up
            await asyncio.sleep(1.1)  # a second of states

    asyncio.run(test())
    found = list(records(tmp_path))
    due = [e.t_ns for e in spoken if e.track is not None or e.detection.call]
    assert len(due) > 20
    assert {r["t_ns"] for r in of(found, "bearing")} >= set(due)
    assert [r["up"] for r in found if r["type"] == "link"] == [False]
    assert found[-1]["type"] == "stop"


def test_without_a_place_no_log_is_kept(monkeypatch, tmp_path):
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert directory_of(Settings()) is None
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/a:{tmp_path}/b")
    assert directory_of(Settings()) == tmp_path / "a"
    assert directory_of(from_table({"log": {"directory": "/x"}})) == Path("/x")


def cli(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "locagen_edge", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"},
        check=False,
    )


def test_a_killed_daemon_leaves_a_log_that_reads_and_a_sound_that_is_mended(tmp_path):
    settings = tmp_path / "s.toml"
    settings.write_text(f'[log]\ndirectory = "{tmp_path}/state"\nsnippets = true\n')
    process = subprocess.Popen(
        [sys.executable, "-m", "locagen_edge", "run", "--quiet", "--settings", str(settings)],
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    log = tmp_path / "state" / "log-000001.jsonl"
    try:
        while process.poll() is None and not (log.exists() and log.read_bytes().count(b'"bearing"') > 20):
            os.sched_yield()
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    done = cli("log", tmp_path / "state")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["utc", "type", "what"]
    assert "sim source, steered estimator" in lines[1]
    assert "1 begins" in done.stdout
    jsonl = cli("log", tmp_path / "state", "--type", "bearing", "--format", "jsonl", "--last", "3")
    assert [json.loads(line)["type"] for line in jsonl.stdout.splitlines()] == ["bearing"] * 3


def test_a_log_that_is_not_there_is_one_line(tmp_path):
    done = cli("log", tmp_path / "nowhere")
    assert done.returncode == 1
    assert done.stdout == ""
    assert (
        done.stderr == f"locagen-edge: {tmp_path}/nowhere: there is no such folder; is log.directory set?\n"
    )


@pytest.mark.parametrize("command", ["log", "fuse"])
def test_a_folder_without_a_log_is_one_line(command, tmp_path):
    (tmp_path / "notes.jsonl").write_text("{}\n")
    done = cli(command, tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr == f"locagen-edge: {tmp_path}: there is no log (log-*.jsonl) in this folder\n"


@pytest.mark.parametrize("arguments", [["--since", "yesterday"], ["--last", "0"], ["--type", "x"]])
def test_wrong_usage_of_log_is_exit_code_2(arguments):
    assert cli("log", *arguments).returncode == 2


# --- for a person


def test_every_type_has_words(tmp_path):
    found = kept(
        tmp_path,
        [estimate(n, track=TRACK, call=True, faults=("microphone 1: dead",)) for n in range(3)],
        snippets=True,
    )
    rows = [row(r) for r in found]
    assert any("1 begins   57.3° ±2.9° el -17° confidence 0.90  snr 7.0 dB" in line for line in rows)
    assert any("1 ends after 0.1 s" in line and "calls/" in line for line in rows)
    assert any("! microphone 1: dead" in line for line in rows)
    assert not any("{" in line for line in rows)


KEYS = st.sampled_from(["type", "utc", "event", "track", "settings", "text"])


@given(st.dictionaries(KEYS, st.text() | st.none() | st.sampled_from(["call", "fault", "start", "begin"])))
def test_no_record_breaks_the_table(record):
    assert "\n" not in row(record)
    list(chosen([record], set(), datetime(2026, 1, 2, tzinfo=UTC)))


def test_since_and_types_choose():
    old = {"type": "call", "utc": "2026-01-01T00:00:00+00:00"}
    new = {"type": "call", "utc": "2026-01-03T00:00:00+00:00"}
    bearing = {**new, "type": "bearing"}
    assert list(chosen([old, new, bearing, {}], set(), datetime(2026, 1, 2, tzinfo=UTC))) == [new]
    assert list(chosen([old, bearing], {"bearing"}, None)) == [bearing]
