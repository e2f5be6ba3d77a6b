"""The command line as its user meets it: in a process of its own."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import shutil
import socket
import struct
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import ROOT
from scenes import heard

from locagen_edge.settings import Settings

FIELDS = {"t_s", "azimuth_deg", "elevation_deg", "sigma_deg", "snr_db", "call", "estimator"}


def cli(*arguments: str | Path, **more) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error", **more}
    return subprocess.run(
        [sys.executable, "-m", "locagen_edge", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        env=environment,
        check=False,
    )


def fails(code: int, says: str, *arguments: str | Path) -> None:
    """Ends with this code, with `says` in a text for people, one line per fault, on the error stream."""
    done = cli(*arguments)
    assert done.returncode == code, done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    if code == 1:
        lines = [line for line in done.stderr.splitlines() if not line.startswith(("I ", "W "))]
        assert all(line.startswith("locagen-edge: ") for line in lines), done.stderr


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Two seconds of a caller at 57 degrees, 20 dB, 16 bit, 10 kHz, three channels."""
    path = tmp_path_factory.mktemp("wav") / "call.wav"
    samples = heard(Settings(), np.radians(57.0), -0.3, 20.0, 20_000)
    soundfile.write(path, samples.T, 10_000, subtype="PCM_16")
    return path


@pytest.fixture(scope="module")
def on_delays(tmp_path_factory) -> Path:
    """Settings whose estimator needs no noise before the call."""
    path = tmp_path_factory.mktemp("settings") / "on-delays.toml"
    path.write_text('[bearing]\nestimator = "far-field"\n')
    return path


# --- help and usage


@pytest.mark.parametrize(
    "command", [[], ["run"], ["replay"], ["record"], ["log"], ["fuse"], ["devices"], ["check"], ["calibrate"]]
)
def test_help_is_there(command):
    done = cli(*command, "--help")
    assert done.returncode == 0
    assert "usage: locagen-edge" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["devices", "--settings", "x.toml"],
        ["replay"],
        ["run", "--seconds", "0"],
        ["run", "--seconds", "x"],
        ["replay", "a", "--format", "xml"],
        ["record", "--seconds", "-1"],
    ],
)
def test_wrong_usage_is_exit_code_2(arguments):
    fails(2, "usage:", *arguments)


def test_the_version_is_the_packages():
    from locagen_edge import __version__

    assert cli("--version").stdout == f"locagen-edge {__version__}\n"


# --- replay


def test_replay_gives_a_json_line_per_hop(recording, on_delays):
    done = cli("replay", recording, "--settings", on_delays)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == (20_000 - 1024) // 512 + 1
    for number, line in enumerate(lines):
        assert line.keys() >= FIELDS
        assert line["t_s"] == pytest.approx(number * 0.0512)
        assert line["azimuth_deg"] == pytest.approx(57.0, abs=2.0)
        assert line["estimator"] == "far-field"
        assert isinstance(line["call"], bool)


def test_replay_gives_a_table_too(recording, on_delays):
    done = cli("replay", recording, "--settings", on_delays, "--format", "table")
    head, *rows = done.stdout.splitlines()
    assert set(head.split()) >= FIELDS
    column = head.split().index("azimuth_deg")
    assert all(float(row.split()[column]) == pytest.approx(57.0, abs=2.0) for row in rows)
    assert all(len(row) >= head.rindex("estimator") for row in rows)


def test_replay_obeys_the_settings(recording, tmp_path):
    settings = tmp_path / "s.toml"
    settings.write_text('[audio]\nchannel_map = [1, 2, 0]\nhop = 1024\n[bearing]\nestimator = "hyperbolic"\n')
    lines = [
        json.loads(line) for line in cli("replay", recording, "--settings", settings).stdout.splitlines()
    ]
    assert {line["estimator"] for line in lines} == {"hyperbolic"}
    assert lines[1]["t_s"] == pytest.approx(0.1024)
    # channels turned round by one: the bearing turns by a third
    assert np.median([line["azimuth_deg"] for line in lines]) == pytest.approx(57.0 - 120.0 + 360.0, abs=3.0)


def test_recordings_of_other_settings_are_not_replayed_as_one(recording, tmp_path):
    """A session of another yaw would be told by the first one's; links are nothing to a replay."""
    for name, text in (("a", ""), ("b", "# another day\n[mavlink]\nrate_hz = 7\n"), ("c", "")):
        (tmp_path / f"{name}.wav").write_bytes(recording.read_bytes())
        (tmp_path / f"{name}.toml").write_text(f"{text}[bearing]\nestimator = 'far-field'\n")
    done = cli("replay", tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["estimator"] == "far-field"
    (tmp_path / "c.toml").write_text("[bearing]\nestimator = 'far-field'\n[array]\nmount_deg = [0, 0, 90]\n")
    says = f"{tmp_path}/c.toml: array.mount_deg other than in {tmp_path}/a.toml: replay them one by one"
    fails(1, says, "replay", tmp_path)
    done = cli("replay", tmp_path, "--settings", tmp_path / "c.toml")
    assert done.returncode == 0, done.stderr


def test_replay_ends_quietly_when_its_reader_does(recording):
    command = f"{sys.executable} -m locagen_edge replay {recording} | head -1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Error" not in done.stderr
    assert len(done.stdout.splitlines()) == 1


def test_replay_shows_progress_on_a_terminal_and_nowhere_else(recording, tmp_path):
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with (tmp_path / "out").open("w") as out:
        subprocess.run(
            [sys.executable, "-m", "locagen_edge", "replay", str(recording)],
            stdout=out,
            stderr=follower,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            timeout=60,
            check=True,
        )
    os.close(follower)
    shown = os.read(leader, 65536).decode()
    os.close(leader)
    assert "100%" in shown
    assert "of sound" in shown
    assert "%" not in cli("replay", recording).stderr


def test_silence_replays_as_null(tmp_path):
    path = tmp_path / "silence.wav"
    soundfile.write(path, np.zeros((20_000, 3)), 10_000)
    lines = [json.loads(line) for line in cli("replay", path).stdout.splitlines()]
    assert {line["azimuth_deg"] for line in lines} == {None}
    assert lines[-1]["faults"] == ["no microphone hears anything"]


def test_bad_files_are_told_in_one_line(tmp_path):
    missing = tmp_path / "missing.wav"
    fails(1, "missing.wav: there is no such file", "replay", missing)
    empty = tmp_path / "empty.wav"
    empty.touch()
    fails(1, "empty.wav: is empty", "replay", empty)
    text = tmp_path / "text.wav"
    text.write_text("this is not a recording, but somebody's notes\n" * 100)
    fails(1, "text.wav: is not audio", "replay", text)
    stereo = tmp_path / "stereo.wav"
    soundfile.write(stereo, np.zeros((20_000, 2)), 10_000)
    fails(1, "stereo.wav: has 2 channels, but audio.channel_map names channel 2", "replay", stereo)
    slow = tmp_path / "slow.wav"
    soundfile.write(slow, np.zeros((20_000, 3)), 8_000)
    fails(1, "8000 Hz carries sound up to 4000 Hz", "replay", slow)
    short = tmp_path / "short.wav"
    soundfile.write(short, np.zeros((500, 3)), 10_000)
    fails(1, "less than one frame", "replay", short)


def test_a_recording_that_is_cut_short_is_used_as_far_as_it_goes(recording, tmp_path):
    cut = tmp_path / "cut.wav"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    done = cli("replay", cut)
    assert done.returncode == 0, done.stderr
    assert "cut short" in done.stderr
    assert 15 < len(done.stdout.splitlines()) < 20


# --- output that cannot be written


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", command.replace("locagen-edge", f"{sys.executable} -m locagen_edge")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("arguments", ["replay {}", "run --seconds 1.5"])
def test_a_full_disk_is_one_line(recording, arguments):
    done = shell(f"locagen-edge {arguments.format(recording)} > /dev/full")
    assert done.returncode == 1
    assert "locagen-edge: output: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr


def test_closed_output_and_poor_terminals_are_borne(recording):
    assert shell(f"locagen-edge replay {recording} >&-").returncode == 0
    done = shell(f"locagen-edge replay {recording} 2>&-")
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) > 30
    assert shell(f"locagen-edge replay {recording} >&- 2>&-").returncode == 0
    assert shell("locagen-edge replay nowhere.wav 2>&-").returncode == 1
    assert shell("locagen-edge replay 2>&-").returncode == 2
    done = shell("PYTHONIOENCODING=ascii locagen-edge run --seconds 1.5")
    assert done.returncode == 0, done.stderr
    assert "bearing" in done.stdout


# --- settings


def test_bad_settings_are_told_all_at_once(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("[audio]\nframe = 1000\nhopp = 3\n[bearing]\nestimator = 'guess'\n")
    for command in (["run"], ["replay", "x.wav"], ["check"]):
        done = cli(*command, "--settings", path)
        assert done.returncode == 1
        lines = done.stderr.splitlines()
        assert [line.split(":")[1].strip() for line in lines] == [
            "audio.hopp",
            "bearing.estimator",
            "audio.frame",
        ]


def test_missing_settings_and_models_are_told(tmp_path):
    fails(1, "nowhere.toml: cannot be read", "run", "--settings", tmp_path / "nowhere.toml")
    path = tmp_path / "model.toml"
    path.write_text('[bearing]\nestimator = "model:nope"\n')
    fails(1, "model nope: is not in", "run", "--settings", path)


# --- check


def test_check_finds_all_well_with_the_default_scene():
    done = cli("check", "--seconds", "0.5", "--settings", ROOT / "systemd" / "locagen-edge.toml")
    assert done.returncode == 0, done.stdout + done.stderr
    found = [line.split(":")[0] for line in done.stdout.splitlines()]
    assert [line.split()[0] for line in found] == ["ok"] * len(found)
    what = {line.split()[1] for line in found} - {"channels"}  # so short a time may hold no call
    assert what == {"settings", "models", "estimator", "microphones", "link"}


def test_check_says_what_is_wrong_and_exits_with_1(tmp_path):
    path = tmp_path / "dead.wav"
    samples = heard(Settings(), 1.0, -0.3, 20.0, 40_000)
    samples[1] = 0.0
    soundfile.write(path, samples.T, 10_000)
    settings = tmp_path / "s.toml"
    settings.write_text(
        f'[audio]\nsource = "wav"\nfile = "{path}"\n[mavlink]\nlink = "serial:{tmp_path}/ttyNONE:57600"\n'
    )
    done = cli("check", "--seconds", "3", "--settings", settings)
    assert done.returncode == 1
    wrong = [line for line in done.stdout.splitlines() if line.startswith("WRONG")]
    assert any("microphones: microphone 1: dead" in line for line in wrong), done.stdout
    assert any("link:" in line and "ttyNONE" in done.stdout for line in wrong), done.stdout


def test_check_hears_a_fault_however_short_the_time(tmp_path):
    path = tmp_path / "dead.wav"
    samples = heard(Settings(), 1.0, -0.3, 20.0, 40_000)
    samples[1] = 0.0
    soundfile.write(path, samples.T, 10_000)
    settings = tmp_path / "s.toml"
    settings.write_text(f'[audio]\nsource = "wav"\nfile = "{path}"\n')
    done = cli("check", "--seconds", "0.1", "--settings", settings)
    assert "WRONG  microphones: microphone 1: dead" in done.stdout
    assert done.returncode == 1


def test_check_goes_on_after_an_unfit_model(tmp_path):
    settings = tmp_path / "s.toml"
    settings.write_text('[bearing]\nestimator = "model:absent"\n')
    done = cli("check", "--seconds", "0.5", "--settings", settings)
    assert done.returncode == 1
    assert "WRONG  estimator: model absent" in done.stdout
    assert "ok     microphones" in done.stdout
    assert "link" in done.stdout


@pytest.mark.parametrize("kind", ["mask", "wave"])
def test_check_goes_on_without_a_denoiser_and_says_which_models_are_used(kind, tmp_path):
    models = tmp_path / "models"
    shutil.copytree(ROOT / "models", models)
    (models / f"denoise-{kind}.onnx").write_bytes(b"torn")
    (models / "tdoa-mlp.onnx").write_bytes(b"torn")
    settings = tmp_path / "s.toml"
    settings.write_text(f'[denoise]\nkind = "{kind}"\n[models]\ndirectory = "{models}"\n')
    done = cli("check", "--seconds", "0.5", "--settings", settings)
    assert done.returncode == 1
    models_told = [line for line in done.stdout.splitlines() if "  models: " in line]
    wrong = [line for line in models_told if line.startswith("WRONG")]
    unused = [line for line in models_told if line.endswith("(not used)")]
    assert len(wrong) == 1, done.stdout
    assert f"denoise-{kind}" in wrong[0]
    assert len(unused) == 1, done.stdout
    assert "tdoa-mlp" in unused[0]
    assert "ok     estimator: steered" in done.stdout
    assert f"WRONG  denoiser: model denoise-{kind}" in done.stdout
    assert "ok     microphones" in done.stdout
    assert "link: " in done.stdout


def test_check_knows_a_link_that_never_opened(tmp_path):
    """A listener whose queue is full answers nothing."""
    with socket.socket() as listener, contextlib.ExitStack() as stack:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        for _ in range(3):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                waiting.connect(listener.getsockname())
        settings = tmp_path / "s.toml"
        settings.write_text(f'[mavlink]\nlink = "tcp:127.0.0.1:{listener.getsockname()[1]}"\n')
        done = cli("check", "--seconds", "1", "--settings", settings)
    assert "WRONG  link: " in done.stdout, done.stdout


# --- the state of the service


@pytest.mark.parametrize("given", [None, "settings", "others"])
def test_by_hand_with_the_settings_of_the_service_what_it_was_told_over_mavlink_holds(tmp_path, given):
    """The same flight as the service's, recorded by hand; other settings have nothing to do with it."""
    installed, others, state = tmp_path / "settings", tmp_path / "others", tmp_path / "state"
    for path in (installed, others):
        path.write_text('[mavlink]\nlink = "udpout:127.0.0.1:9"\n')
    state.mkdir()
    (state / "parameters.toml").write_text("LG_TRK_COAST = 7.5\n")
    at_hand = f"""
import pathlib, sys
from locagen_edge import cli
cli.DEFAULT_PATH, cli.SERVICE_STATE = pathlib.Path({str(installed)!r}), pathlib.Path({str(state)!r})
cli.main(sys.argv[1:])
"""
    said = []
    for command in ("check", "run"):
        settings = [] if given is None else ["--settings", tmp_path / given]
        done = subprocess.run(
            [sys.executable, "-c", at_hand, command, "--seconds", "0.5", *settings],
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": str(tmp_path / "home")},
            check=False,
        )
        assert done.returncode == 0, done.stderr
        said.append(done.stdout + done.stderr)
    holds = f"track.coast_s is 7.5, not 2: LG_TRK_COAST in {state}/parameters.toml"
    assert [holds in text for text in said] == [given != "others"] * 2


# --- devices


def test_devices_lists_or_says_why_not():
    done = cli("devices")
    assert "Traceback" not in done.stderr
    if done.returncode == 0:
        assert done.stdout
    else:
        assert "PortAudio" in done.stderr


@pytest.mark.parametrize(
    ("link", "says"),
    [
        ("udpout:127.0.0.1:99999", "mavlink.link: port 99999 is not a number"),
        ("tcp:127.0.0.1:0", "mavlink.link: port 0 is not"),
    ],
)
def test_a_port_that_cannot_be_is_refused_in_one_line(tmp_path, link, says):
    path = tmp_path / "s.toml"
    path.write_text(f'[mavlink]\nlink = "{link}"\n')
    fails(1, says, "run", "--settings", path)


def test_a_key_that_others_may_read_is_refused_in_one_line(tmp_path):
    key, path = tmp_path / "key", tmp_path / "s.toml"
    key.write_text("a passphrase")
    key.chmod(0o644)
    path.write_text(f'[mavlink]\nsigning_key = "{key}"\n')
    fails(1, f"chmod 600 {key}", "run", "--settings", path)
    done = cli("check", "--seconds", "1", "--settings", path)
    assert f"WRONG  signing: mavlink.signing_key: {key}: others may read it" in done.stdout


def test_a_port_that_is_taken_is_told_while_the_daemon_goes_on(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        path = tmp_path / "s.toml"
        path.write_text(f'[mavlink]\nlink = "udpin:127.0.0.1:{taken.getsockname()[1]}"\n')
        done = cli("run", "--seconds", "1.5", "--settings", path)
    assert done.returncode == 0, done.stderr
    assert "down: Address already in use" in done.stderr
    assert "link down: Address already in use" in done.stdout
