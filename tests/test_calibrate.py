"""`locagen-edge calibrate`: from a recording to settings that bear better, and what it says if it cannot."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import soundfile

from locagen_edge.calibration import off_m
from locagen_edge.cli import main
from locagen_edge.geometry import equilateral, wrap
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table, load
from locagen_edge.sim.propagation import delayed
from locagen_edge.sim.scene import Scene
from locagen_edge.stages.mic import wav_frames
from locagen_edge.types import F64

RATE = 10_000
NOMINAL = equilateral().positions_m
LATE = np.array([0.0, 10e-6, -10e-6])
LOUD = np.array([0.0, 1.5, -2.5])
TURN_DEG_S = 12.0


def true_positions(seed: int = 3) -> F64:
    """2 mm off per axis in the plane."""
    positions = NOMINAL.copy()
    positions[:, :2] += 0.002 * np.random.default_rng(seed).standard_normal((3, 2))
    return positions


def record(path: Path, *, positions: F64 | None = None, late: F64 = LATE, loud: F64 = LOUD, rate: int = RATE,
           seconds: float = 35.0, **sim) -> Scene:  # fmt: skip
    """A sound walked around the array, clockwise from 40 degrees; more of `sim` as in the settings."""
    rows = (true_positions() if positions is None else positions).tolist()
    scene = {"call": "white", "pause_s": 0.0, "turn_deg_s": TURN_DEG_S, "distance_m": 3.0, "height_m": 0.0}
    scene |= {"rotors": 0, "snr_db": 15.0, "noise_dbfs": -40.0, **sim}
    table = {"array": {"positions_m": rows}, "audio": {"rate_hz": rate}, "sim": scene}
    rendered = Scene(from_table(table))
    sound = np.stack([
        delayed(channel, np.array([by * rate]))[0] * 10 ** (gain / 20)
        for channel, by, gain in zip(rendered.render(round(seconds * rate)), late, loud, strict=True)
    ])  # fmt: skip
    soundfile.write(path, sound.T, rate, subtype="PCM_24")
    return rendered


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("walk") / "walk.wav"
    record(path)
    return path


@pytest.fixture(scope="module")
def angles(walk) -> Path:
    """Where the sound was, every five seconds, to a degree."""
    path = walk.parent / "angles.csv"
    lines = [f"{t},{round((40 + TURN_DEG_S * t) % 360)}" for t in range(0, 36, 5)]
    path.write_text("\n".join(["time_s,azimuth_deg", *lines]) + "\n")
    return path


def call(capsys, *arguments: str | Path) -> tuple[int, str, list[str]]:
    """Exit code, output, and the error stream's lines without the program's name."""
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", *map(str, arguments)])
    out, err = capsys.readouterr()
    lines = err.splitlines()
    if ended.value.code == 1:
        assert lines
        assert all(line.startswith("locagen-edge: ") for line in lines), err
    return int(ended.value.code or 0), out, [line.removeprefix("locagen-edge: ") for line in lines]


def refused(capsys, says: str, *arguments: str | Path) -> None:
    code, _, lines = call(capsys, *arguments)
    assert code == 1
    assert any(says in line for line in lines), lines


# --- what it finds


def check_found(path: Path, positions: F64) -> Settings:
    """To what was promised: 0.3 mm of shape, 1 us, and the level to 0.1 dB."""
    settings = load(path)
    ours, true = (p[:, :2] - p[:, :2].mean(axis=0) for p in (settings.mic_array.positions_m, positions))
    assert off_m(ours, true) < 3e-4
    assert np.abs(np.array(settings.array.delays_s) - LATE).max() < 1e-6
    assert np.abs(np.array(settings.array.gains_db) - LOUD).max() < 0.1
    return settings


@pytest.mark.parametrize(
    ("sim", "options"),
    [
        ({}, ["--distance-m", "3"]),
        ({}, []),
        ({"snr_db": 5.0}, []),
        ({"call": "speech", "call_s": 4.0, "pause_s": 0.2, "turn_deg_s": 8.0}, []),
        ({"turn_deg_s": -12.0, "distance_m": 10.0}, ["--sense", "anticlockwise"]),
    ],
)
def test_positions_delays_and_gains_are_found(tmp_path, capsys, sim, options):
    wav, new = tmp_path / "walk.wav", tmp_path / "new.toml"
    record(wav, **sim, seconds=50.0 if "call" in sim else 35.0)
    code, out, errors = call(capsys, wav, "--write", new, *options)
    assert code == 0, errors
    settings = check_found(new, true_positions())
    # the rotation is that of the nominal positions, and the tolerance knows it
    assert 3e-4 < settings.array.tolerance_m < 3e-3
    assert "directions  unknown, over 360 of 360 degrees" in out
    assert out.splitlines()[-1] == f"written     {new}"


def test_a_recording_at_the_cards_rate_and_a_very_late_channel(tmp_path, capsys):
    """200 us is two thirds of the longest delay: the lags have to be wider than the array's."""
    wav, new = tmp_path / "walk.wav", tmp_path / "new.toml"
    late = np.array([0.0, 2e-4, 0.0])
    record(wav, late=late, rate=48_000, seconds=31.0)
    code, _, errors = call(capsys, wav, "--write", new, "--margin", "2.5")
    assert code == 0, errors
    assert np.abs(np.array(load(new).array.delays_s) - late).max() < 1e-6


def test_the_written_settings_are_the_given_ones_but_for_the_array(walk, tmp_path, capsys):
    given, new = tmp_path / "given.toml", tmp_path / "new.toml"
    given.write_text("[audio]\nhop = 256\n[track]\ncoast_s = 3.5\n[array]\ndelays_s = [0.0, 5e-5, 0.0]\n")
    assert call(capsys, walk, "--settings", given, "--write", new)[0] == 0
    before, after = load(given), check_found(new, true_positions())
    assert (after.audio, after.track) == (before.audio, before.track)
    assert after.array != before.array
    text = new.read_text()
    assert "locagen-edge calibrate" in text.splitlines()[0]
    assert "# Which channel of the device" in text  # the manual stays
    assert sorted(p.name for p in tmp_path.iterdir()) == ["given.toml", "new.toml"]


def test_calibrating_what_is_calibrated_changes_nothing(walk, tmp_path, capsys):
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    call(capsys, walk, "--write", one)
    _, out, _ = call(capsys, walk, "--settings", one, "--write", two)
    first, second = load(one).array, load(two).array
    assert np.abs(np.array(first.positions_m) - np.array(second.positions_m)).max() < 2e-5
    assert second.delays_s == pytest.approx(first.delays_s, abs=1e-8)
    before, after = (float(word) for word in out.partition("residual")[2].replace("us", "").split()[0:4:3])
    assert before == pytest.approx(after, rel=0.05)


def test_a_walk_in_several_files_is_one(walk, angles, tmp_path, capsys):
    """Also by their folder; what lies across a seam is left out, and little changes."""
    folder, one, two = tmp_path / "walk", tmp_path / "one.toml", tmp_path / "two.toml"
    folder.mkdir()
    sound, rate = soundfile.read(walk, dtype="float32")
    for name, part in (("1.wav", sound[: 20 * rate]), ("2.wav", sound[20 * rate :])):
        soundfile.write(folder / name, part, rate, subtype="PCM_24")
    for files in ([folder / "1.wav", folder / "2.wav"], [folder]):
        call(capsys, walk, "--angles", angles, "--write", one)
        code, _, _ = call(capsys, *files, "--angles", angles, "--write", two)
        assert code == 0
        whole, parts = load(one).array, load(two).array
        assert np.abs(np.array(whole.positions_m) - np.array(parts.positions_m)).max() < 2e-5
        assert parts.delays_s == pytest.approx(whole.delays_s, abs=1e-7)
        assert "from '1.wav' and 1 more; the rest" in " ".join(two.read_text()[:400].split("\n# "))


def test_a_second_walk_counts_beside_the_first(walk, tmp_path, capsys):
    again = tmp_path / "again.wav"
    record(again, seed=2)
    usable = []
    for walks in ([walk], [walk, again]):
        code, out, _ = call(capsys, *walks)
        assert code == 0, out
        usable.append(int(out.partition("usable ")[2].partition(",")[0]))
    assert usable[1] > 1.9 * usable[0]


@pytest.mark.parametrize("estimator", ["far-field", "steered"])
def test_bearings_of_another_scene_become_as_good_as_the_tolerance(walk, angles, tmp_path, capsys, estimator):
    """2 mm and 10 us are some 3 degrees; what is left is the angles' own degree over their number, and the
    frames' noise."""
    given, new, held_out = tmp_path / "given.toml", tmp_path / "new.toml", tmp_path / "held-out.wav"
    given.write_text(f'[bearing]\nestimator = "{estimator}"\n')
    code, out, _ = call(
        capsys, walk, "--settings", given, "--angles", angles, "--angle-sigma-deg", "1", "--write", new
    )
    assert code == 0, out
    # calls with pauses, in which the steered estimator learns
    sim = {"call_s": 0.8, "pause_s": 0.8, "turn_deg_s": 25.0, "distance_m": 30.0, "height_m": 10.0, "seed": 9}
    scene = record(held_out, seconds=14.0, **sim)

    def error_deg(settings: Settings) -> float:
        pipeline, off = Pipeline(settings), []
        for frame in wav_frames(held_out, settings):
            truth = scene.truth(frame.start + 512)
            bearing = pipeline.process(frame).bearing
            calling = scene.truth(frame.start).calling and scene.truth(frame.start + 1024).calling
            if calling and bearing.azimuth_rad is not None:
                off.append(wrap(bearing.azimuth_rad - truth.azimuth_rad))
        assert len(off) > 50
        return math.degrees(float(np.sqrt(np.mean(np.square(off)))))

    before, after = error_deg(load(given)), error_deg(load(new))
    assert before > 2.0
    assert after < 0.7
    told = float(out.partition("with the old settings off by ")[2].partition("°")[0])
    assert told == pytest.approx(before, rel=0.3)


# --- what it says


def test_the_table_is_for_people(walk, angles, capsys):
    _, out, _ = call(capsys, walk, "--angles", angles)
    assert max(map(len, out.splitlines())) <= 110
    head = next(line for line in out.splitlines() if line.strip().startswith("microphone"))
    for word in ("x mm", "y mm", "z mm", "late us", "gain dB"):
        assert word in head
    assert "directions  known, over 360 of 360 degrees, 1.2 turns clockwise" in out
    assert "from 8 known angles" in out
    assert "as set" in out  # heights


def test_half_a_walk_is_told_and_not_written(tmp_path, capsys):
    wav, new = tmp_path / "half.wav", tmp_path / "new.toml"
    record(wav, seconds=15.0)
    code, out, lines = call(capsys, wav, "--write", new)
    assert code == 1
    assert "covers" in lines[0]
    assert "360" in out
    assert lines[-1] == "nothing is written"
    assert not new.exists()


def test_another_sense_than_told_is_two_swapped_channels(walk, capsys):
    refused(capsys, "two channels are swapped", walk, "--sense", "anticlockwise")
    assert call(capsys, walk, "--sense", "clockwise")[0] == 0


def test_known_angles_show_which_channels_are_swapped(walk, angles, tmp_path, capsys):
    swapped = tmp_path / "s.toml"
    swapped.write_text("[audio]\nchannel_map = [0, 2, 1]\n")
    code, out, _ = call(capsys, walk, "--angles", angles, "--settings", swapped)
    assert code == 0
    assert "microphone 1 where the settings have 2" in out


def edited(walk: Path, path: Path, change) -> Path:
    rows, rate = soundfile.read(walk)
    soundfile.write(path, change(rows), rate, subtype="PCM_24")
    return path


@pytest.mark.parametrize("inverted", [0, 2])
def test_an_inverted_channel_is_told(walk, tmp_path, capsys, inverted):
    sign = np.where(np.arange(3) == inverted, -1.0, 1.0)
    wav = edited(walk, tmp_path / "w.wav", lambda rows: rows * sign)
    refused(capsys, f"microphone {inverted}: inverted", wav)


def test_channels_that_are_no_microphones_are_told(walk, tmp_path, capsys):
    dead = edited(walk, tmp_path / "dead.wav", lambda rows: rows * [1.0, 1e-4, 1.0])
    refused(capsys, "microphone 1: dead", dead)
    twice = edited(walk, tmp_path / "twice.wav", lambda rows: rows[:, [0, 1, 1]])
    refused(capsys, "microphones 1 and 2: the same signal twice", twice)


def test_noise_and_silence_and_rotors_are_no_walk(tmp_path, capsys):
    noise = np.random.default_rng(0).standard_normal((20 * RATE, 3)) * 0.05
    for name, rows, says in (
        ("noise.wav", noise, "frames hold a sound that all microphones hear"),
        ("silence.wav", 0.0 * noise, "no microphone hears anything"),
    ):
        soundfile.write(tmp_path / name, rows, RATE)
        refused(capsys, says, tmp_path / name)
    hover = tmp_path / "hover.wav"
    record(hover, seconds=20.0, rotors=4, snr_db=-60.0, sensor_db=-20.0)
    assert call(capsys, hover)[0] == 1


def test_recordings_that_cannot_be_used_are_told(tmp_path, capsys):
    refused(capsys, "missing.wav: there is no such file", tmp_path / "missing.wav")
    stereo = tmp_path / "stereo.wav"
    soundfile.write(stereo, np.zeros((RATE, 2)), RATE)
    refused(capsys, "stereo.wav: has 2 channels", stereo)
    short = tmp_path / "short.wav"
    record(short, seconds=0.5)
    refused(capsys, "record a loud broad-band sound", short)
    text = tmp_path / "text.wav"
    text.write_text("no sound\n" * 100)
    refused(capsys, "text.wav: is not audio", text)


CSV = {
    "no such file": (None, "cannot be read"),
    "empty": ("", "line 1 has to be time_s,azimuth_deg"),
    "other columns": ("t,az\n0,0\n1,1\n", "line 1 has to be time_s,azimuth_deg"),
    "words": ("time_s,azimuth_deg\n0,north\n1,5\n", "line 2: azimuth_deg: 'north' is no number"),
    "not a number": ("time_s,azimuth_deg\nnan,0\n1,5\n", "line 2: time_s: 'nan' is no number"),
    "one line": ("time_s,azimuth_deg\n0,0\n", "holds 1 lines of angles; two are needed"),
    "backwards": ("time_s,azimuth_deg\n5,0\n1,5\n", "line 3: time_s: does not come after"),
    "too many": ("time_s,azimuth_deg\n0,0,0\n1,5\n", "line 2: 3 values for 2 columns"),
    "elevation": ("time_s,azimuth_deg,elevation_deg\n0,0,95\n1,5,0\n", "elevation_deg: '95' is no number"),
    "another time": ("time_s,azimuth_deg\n1000,0\n1010,5\n", "is time_s counted from the recording's begin"),
    "not text": (b"\xff\xfe\x00", "is not UTF-8 text"),
}


@pytest.mark.parametrize("name", CSV)
def test_nonsense_in_the_angles_is_told_by_line(walk, tmp_path, capsys, name):
    content, says = CSV[name]
    path = tmp_path / "angles.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(capsys, says, walk, "--angles", path)


def test_wrong_angles_are_no_confident_answer(walk, tmp_path, capsys):
    """Angles of another walk: fit nothing."""
    path = tmp_path / "angles.csv"
    path.write_text("time_s,azimuth_deg\n" + "".join(f"{t},{(200 - 31 * t) % 360}\n" for t in range(36)))
    assert call(capsys, walk, "--angles", path)[0] == 1


def test_options_that_cannot_be_are_told(walk, tmp_path, capsys):
    refused(capsys, "--margin 20: lags of", walk, "--margin", "20", "--settings", wide(tmp_path))
    refused(
        capsys, "new.toml: cannot be written: No such", walk, "--write", tmp_path / "nowhere" / "new.toml"
    )
    for option in (
        ["--margin", "0.5"],
        ["--elevation-deg", "90"],
        ["--distance-m", "0"],
        ["--sense", "left"],
    ):
        assert call(capsys, walk, *option)[0] == 2


def wide(tmp_path: Path) -> Path:
    path = tmp_path / "wide.toml"
    path.write_text("[array]\npositions_m = [[0.5, 0, 0], [-0.3, 0.4, 0], [-0.3, -0.4, 0]]\n")
    return path
