"""`locagen-edge record` and `run --record` as their user meets them: in processes of their own."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import pytest
import soundfile
from conftest import ROOT
from pymavlink.dialects.v20 import common
from test_recorder import assert_same, settings_file, sounds, start

from locagen_edge.geometry import quaternion
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.parameters import keep, kept_file
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, load
from locagen_edge.sim.scene import frames as sim_frames
from locagen_edge.stages.mic import wav_frames
from locagen_edge.store.journal import records
from locagen_edge.store.plain import plain
from locagen_edge.store.wav import HEADER

__all__ = ["settings_file"]


def test_record_then_replay_of_the_folder(tmp_path, settings_file):
    folder = tmp_path / "parts"
    process = start(folder, "--settings", str(settings_file), "--seconds", "1.5")
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert f"1.5 s in {folder}, 0 overruns, 0.0 s of sound lost, 0 blocks not written" in out.replace(
        "1.6 s", "1.5 s"
    )
    assert err == ""  # no progress line where nobody watches
    replay = subprocess.run(
        [sys.executable, "-m", "locagen_edge", "replay", str(folder)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert f"settings: {sounds(folder)[0].with_suffix('.toml')}" in replay.stderr
    assert len(replay.stdout.splitlines()) in (28, 29)


def test_run_keeps_the_sound_that_its_bearings_came_from(tmp_path, settings_file):
    folder = tmp_path / "parts"
    more = f'[log]\ndirectory = "{tmp_path}/log"\n[bearing]\nestimator = "far-field"\n'
    more += f'[mavlink]\nstate_directory = "{tmp_path}"\n'
    settings_file.write_text(settings_file.read_text() + more)
    keep(kept_file(load(settings_file)), {"LG_ARRAY_YAW": 30.0})
    done = subprocess.run(
        [
            *(sys.executable, "-m", "locagen_edge", "run", "--quiet", "--seconds", "2.5"),
            *("--settings", str(settings_file), "--record", str(folder)),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    live = [r for r in records(tmp_path / "log") if r["type"] == "bearing"]
    settings = load(sounds(folder)[0].with_suffix(".toml"))
    assert settings.array.mount_deg[2] == 30.0, "as it was set over MAVLink"
    pipeline = Pipeline(settings)
    again = {f.start: plain(pipeline.process(f)) for f in wav_frames(sounds(folder), settings)}
    assert len(live) > 20
    for bearing in live:
        for what in ("tdoa", "bearing", "detection", "track", "faults"):
            assert bearing[what] == again[bearing["start"]][what]


def test_a_signal_ends_a_recording_whole(tmp_path, settings_file):
    process = start(tmp_path / "parts", "--settings", str(settings_file))
    while process.poll() is None and not list((tmp_path / "parts").glob("*.wav")):
        os.sched_yield()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert "replay" in out
    assert not list((tmp_path / "parts").glob("*.part"))


def test_a_disk_that_fills_up_ends_the_recording_whole_and_says_so(tmp_path, settings_file):
    """A limit on the size of files stands for the disk: both come in the middle of a write."""
    settings_file.write_text("[record]\nfree_mb = 0\n")
    folder = tmp_path / "parts"
    command = f"ulimit -f 120; exec {sys.executable} -m locagen_edge record"
    done = subprocess.run(
        ["bash", "-c", f"{command} --seconds 20 --output {folder} --settings {settings_file}"],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert done.returncode == 1
    assert f"locagen-edge: {folder}: File too large: the recording ends here" in done.stderr
    assert "Traceback" not in done.stderr
    (sound,) = sounds(folder)
    assert soundfile.info(sound).frames == (120 * 1024 - HEADER.size) // 12
    assert not list(folder.glob("*.part"))


def on_a_disk(options: str, tmp_path: Path, settings: Path) -> subprocess.CompletedProcess[str]:
    """`record` into a small file system of its own, whose files are copied out afterwards."""
    disk, out = tmp_path / "disk", tmp_path / "out"
    disk.mkdir()
    script = (
        f"mount -t tmpfs -o {options} none {disk} && echo mounted && {sys.executable} -m locagen_edge record "
        f"--seconds 20 --output {disk} --settings {settings}; code=$?; cp -r {disk} {out}; exit $code"
    )
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    if "mounted" not in done.stdout:
        pytest.skip("needs unshare and user namespaces")
    return done


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
def test_a_disk_without_room_keeps_what_it_took(tmp_path, settings_file):
    settings_file.write_text("[record]\nfree_mb = 0\npart_s = 1\n")
    done = on_a_disk("size=300k", tmp_path, settings_file)
    assert done.returncode == 1
    assert "No space left on device: the recording ends here" in done.stderr
    assert "Traceback" not in done.stderr
    found = sounds(tmp_path / "out")
    again = list(wav_frames(found, Settings()))
    assert len(again) * 512 * 12 > 200_000
    assert_same(list(islice(sim_frames(Settings()), len(again))), again)


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
def test_a_disk_that_may_not_be_written_to_is_one_line(tmp_path, settings_file):
    done = on_a_disk("ro", tmp_path, settings_file)
    assert done.returncode == 1
    disk = tmp_path / "disk"
    assert done.stderr == f"locagen-edge: {disk}: cannot be written to: Read-only file system\n"


@pytest.mark.parametrize("where", ["under a file", "no such disk"])
def test_a_folder_that_cannot_be_written_to_is_one_line(tmp_path, where):
    (tmp_path / "file").touch()
    folder = {"under a file": tmp_path / "file" / "parts", "no such disk": Path("/proc/parts")}[where]
    process = start(folder, "--seconds", "1")
    _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert err.startswith(f"locagen-edge: {folder}: cannot be written to: ")
    assert len(err.splitlines()) == 1


def test_a_source_that_is_not_there_is_one_line(tmp_path, settings_file):
    settings_file.write_text('[audio]\nsource = "wav"\nfile = "gone.wav"\n[record]\nfree_mb = 0\n')
    process = start(tmp_path / "parts", "--settings", str(settings_file))
    _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert err == "locagen-edge: gone.wav: there is no such file\n"
    assert list((tmp_path / "parts").iterdir()) == []


def test_record_keeps_the_vehicles_poses_where_asked_to(tmp_path):
    """An autopilot that says what it is asked for: nose to the west, 20 m up; a replay's frames know it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(0.02)
        path = tmp_path / "s.toml"
        path.write_text(
            f'[mavlink]\nlink = "udpout:127.0.0.1:{autopilot.getsockname()[1]}"\n[record]\nfree_mb = 0\n'
        )
        process = start(tmp_path / "parts", "--poses", "--seconds", "3", "--settings", str(path))
        mav, framer, wanted, said = common.MAVLink(None, 7, 1), Framer(), set(), set()
        begin_s, told_s = time.monotonic(), -1.0
        while process.poll() is None:
            with contextlib.suppress(TimeoutError):
                data, client = autopilot.recvfrom(2048)
                for message in (dialect.decode(packet.raw) for packet in framer.feed(data)):
                    said.add(message.get_type())
                    if message.get_type() == "COMMAND_LONG" and message.command == 511:
                        wanted.add(round(message.param1))
            ms = round((time.monotonic() - begin_s) * 1000) + 60_000
            messages = [common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)] if ms / 1000 - told_s > 1 else []
            told_s = ms / 1000 if messages else told_s
            if 31 in wanted:
                q = quaternion(0.0, 0.0, -math.pi / 2)
                messages.append(common.MAVLink_attitude_quaternion_message(ms, *q, 0, 0, 0))
            if 33 in wanted:
                place = (47 * 10**7, 8 * 10**7, 0, 20_000)
                messages.append(common.MAVLink_global_position_int_message(ms, *place, *[0] * 4))
            for message in messages if said else []:
                autopilot.sendto(bytes(message.pack(mav)), client)
        _, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert said <= {"HEARTBEAT", "COMMAND_LONG", "TIMESYNC"}
    frames = list(wav_frames(sounds(tmp_path / "parts"), load(path)))
    poses = [frame.pose for frame in frames if frame.pose is not None]
    assert len(poses) > len(frames) / 3
    assert poses[-1].height_m == pytest.approx(20.0, abs=0.1)
    assert poses[-1].attitude == pytest.approx(quaternion(0.0, 0.0, -math.pi / 2), abs=1e-3)
