"""What befalls a process: signals at any moment, suspension, a clock that is set, a CPU that is taken."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from alsa.card import VirtualCard
from conftest import ROOT
from test_daemon import running, source, until, with_link

from locagen_edge.mavlink.component import is_confirmed
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.scene import frames as sim_frames
from locagen_edge.stages.mic import wav_frames
from locagen_edge.store.blackbox import BlackBox
from locagen_edge.store.journal import records
from locagen_edge.store.recorder import Recorder


def start(*arguments: object, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "locagen_edge", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error", **environment},
    )


def obeys(process: subprocess.Popen[str]) -> bool:
    """Whether the process has begun to listen to SIGTERM: before, it is the interpreter that starts."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


# --- SIGTERM


@pytest.fixture
def settings_file(tmp_path) -> Path:
    path = tmp_path / "s.toml"
    path.write_text(
        f'[mavlink]\nlink = "udpout:127.0.0.1:9"\nstate_directory = "{tmp_path}/state"\n'
        f'[log]\ndirectory = "{tmp_path}/log"\n[record]\nfree_mb = 0\nsync_s = 0.1\n'
    )
    return path


@pytest.mark.parametrize("command", ["run", "record"])
def test_sigterm_at_any_stage_ends_cleanly(tmp_path, settings_file, command):
    """From the imports over the first sound to the end: code 0, no traceback, nothing half-written."""
    pick = random.Random(command)
    out = tmp_path / "parts"
    option = {"run": ("--record", out), "record": ("--output", out)}[command]
    for moment in [0.0, *np.linspace(0.0, 1.6, 6)]:
        process = start(command, "--settings", settings_file, *option)
        while not obeys(process) and process.poll() is None:
            os.sched_yield()
        time.sleep(moment + pick.uniform(0, 0.2) if moment else 0.0)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=30)
        assert process.returncode == 0, (moment, err)
        assert "Traceback" not in err, (moment, err)
        assert not list(tmp_path.rglob("*.part")), moment
        assert not list(tmp_path.rglob("*.tmp")), moment
    for path in sorted(out.glob("*.wav")):
        assert list(wav_frames(path, Settings()))


def test_a_second_sigterm_changes_nothing(tmp_path, settings_file):
    process = start("run", "--settings", settings_file, "--record", tmp_path / "parts")
    for _ in range(3):
        process.stdout.readline()
    for _ in range(20):
        process.send_signal(signal.SIGTERM)
        time.sleep(0.01)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert not list(tmp_path.rglob("*.part"))


def test_what_is_asked_for_and_not_done_is_no_success(tmp_path):
    """`check` that is stopped has found nothing."""
    process = start("check", "--seconds", "30")
    process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in err


# --- suspended


def test_what_a_suspended_process_missed_is_a_gap_counted_and_told(library, tmp_path):
    card = VirtualCard(library, tmp_path, rate_hz=48_000)
    settings = tmp_path / "s.toml"
    settings.write_text(
        '[audio]\nsource = "alsa"\ndevice = "array4"\ndevice_channels = 4\n'
        '[bearing]\nestimator = "far-field"\n[mavlink]\nlink = "udpout:127.0.0.1:9"\n'
        "[record]\nfree_mb = 0\n"
    )
    process = start(
        "run", "--settings", settings, "--record", tmp_path / "parts",
        ALSA_CONFIG_PATH=str(card.directory / "asound.conf"),
    )  # fmt: skip
    for _ in range(3):
        process.stdout.readline()
    process.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    process.send_signal(signal.SIGCONT)
    for _ in range(3):
        process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert "1 overrun, " in out
    lost_s = float(out.split(" overrun, ")[1].split(" s of sound lost")[0])
    assert lost_s == pytest.approx(
        2.0, abs=0.6
    )  # less what the card's buffer kept, more what filled no frame
    assert "W since the start: 0 frames dropped, 1 overrun, " in err
    # and so it is in the recording: two stretches, each exactly in step
    frames = list(wav_frames(sorted((tmp_path / "parts").glob("*.wav")), Settings()))
    steps = np.diff([f.t_ns for f in frames]) * 1e-9
    (at,) = np.flatnonzero(steps > 0.5)
    assert frames[at + 1].overruns == 1
    assert np.delete(steps, at) == pytest.approx(0.0512, abs=0.003)


# --- a clock that is set


def test_a_wall_clock_that_jumps_changes_nothing_but_names(tmp_path, monkeypatch):
    """NTP sets it by years at the first fix: times inside are monotonic, and nothing is overwritten."""
    settings = from_table({"record": {"free_mb": 0, "part_s": 0.5}, "bearing": {"estimator": "far-field"}})
    jumps_s = iter([0.0, 3e8, -3e8, 86_400.0, -86_400.0] * 200)
    real_ns = time.time_ns

    class Jumping(datetime):
        @classmethod
        def now(cls, _tz=None):
            return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=next(jumps_s))

    pipeline = Pipeline(settings)
    plain = [pipeline.process(frame) for frame in islice(sim_frames(settings), 60)]

    monkeypatch.setattr("locagen_edge.store.part.datetime", Jumping)
    monkeypatch.setattr(time, "time_ns", lambda: real_ns() + round(next(jumps_s) * 1e9))
    monkeypatch.setattr(time, "time", lambda: time.time_ns() * 1e-9)
    recorder = Recorder(tmp_path / "parts", settings, utc=Jumping.now)
    box = BlackBox(tmp_path / "log", settings, is_confirmed)
    pipeline = Pipeline(settings)
    for frame, before in zip(islice(sim_frames(settings, recorder), 60), plain, strict=True):
        estimate = pipeline.process(frame)
        box.hear(frame, estimate)
        assert (estimate.t_ns, estimate.bearing.azimuth_rad) == (before.t_ns, before.bearing.azimuth_rad)
        assert (estimate.track is None) == (before.track is None)
    recorder.close()
    assert box.close(20)
    assert len(list((tmp_path / "parts").glob("*.wav"))) >= 5
    again = list(wav_frames(sorted((tmp_path / "parts").glob("*.wav")), settings))
    assert [f.start for f in again] == [e.start for e in plain]
    assert np.diff([f.t_ns for f in again]) == pytest.approx(51_200_000, abs=1)
    kept = [r for r in records(tmp_path / "log") if r["type"] == "bearing"]
    assert kept
    assert [r["start"] for r in kept] == sorted(r["start"] for r in kept)


# --- a neighbour that takes the CPU


def test_after_a_time_of_starvation_latency_recovers():
    """While the pipeline is starved, the oldest frames are dropped, and counted; later nothing waits."""
    settings = with_link(9, daemon={"queue_frames": 4}, bearing={"estimator": "far-field"})

    async def test() -> None:
        async with running(settings, sources=source(settings, pace_s=0.01)) as daemon:
            await until(lambda: daemon.counters.estimates > 5)
            process = daemon.pipeline.process
            daemon.pipeline.process = lambda *a: time.sleep(0.1) or process(*a)
            await until(lambda: daemon.counters.dropped > 20)
            assert daemon._queue.qsize() <= 4
            daemon.pipeline.process = process
            await until(lambda: daemon._queue.qsize() == 0)
            dropped, estimates = daemon.counters.dropped, daemon.counters.estimates
            await until(lambda: daemon.counters.estimates > estimates + 30)
            c = daemon.counters
            assert c.dropped == dropped
            assert c.frames - c.dropped - c.estimates <= 2  # nothing waits any more

    asyncio.run(test())
