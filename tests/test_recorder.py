"""Recordings: the same bearings again, bit for bit, whatever loss of power or full disk befalls them."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import ROOT
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from locagen_edge.errors import SourceError, StorageError
from locagen_edge.framing import as_captured
from locagen_edge.jsonl import encode, read
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table, load
from locagen_edge.sim.scene import frames as sim_frames
from locagen_edge.stages import mic
from locagen_edge.stages.mic import capture, wav_frames
from locagen_edge.store import part as parts
from locagen_edge.store import recorder as recorders
from locagen_edge.store.recorder import MB, Recorder
from locagen_edge.store.wav import HEADER, WavWriter, mend
from locagen_edge.types import Frame


def make(record: dict | None = None, **sections) -> Settings:
    return from_table({"record": {"free_mb": 0, **(record or {})}, **sections})


def sounds(directory: Path) -> list[Path]:
    return sorted(directory.glob("*.wav"))


def assert_same(live: list[Frame], again: list[Frame]) -> None:
    """All that the live run had, at the same times from its first frame on; what its end cut may follow."""
    assert len(live) > 10
    assert len(live) <= len(again)
    for a, b in zip(live, again, strict=False):
        assert a.samples.tobytes() == b.samples.tobytes()
        assert (a.rate_hz, a.start, a.overruns) == (b.rate_hz, b.start, b.overruns)
        assert a.t_ns - live[0].t_ns == b.t_ns - again[0].t_ns


# --- the same again


class Card:
    """int16 noise of four channels at 48 kHz in made-up time, read at odd moments; sound is lost twice."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.now = 7_000_000_000
        self.begin = self.now
        self.polls = self.done = self.lost = 0
        self.latency = 0.4

    def now_ns(self) -> int:
        return self.now

    def wait(self, seconds: float) -> bool:
        self.now += round(self.rng.uniform(0.2, 1.8) * seconds * 1e9)
        self.polls += 1
        if self.polls == 60:
            self.lost += 10_000  # in silence
        return self.polls > 150

    @property
    def read_available(self) -> int:
        behind_ns = self.rng.integers(0, 2_000_000)
        return max(round((self.now - behind_ns - self.begin) * 48e-6) - self.lost - self.done, 0)

    def read(self, rows: int):
        self.done += rows
        return self.rng.integers(-9000, 9000, (rows, 4), dtype=np.int16), self.polls == 30


def test_a_cards_recording_gives_its_frames_again_with_their_times_and_losses(tmp_path):
    settings = make(
        {"part_s": 0.3},
        audio={"source": "alsa", "device_channels": 4, "channel_map": [3, 0, 1]},
    )
    recorder = Recorder(tmp_path, settings)
    recorder.gap(0)  # as `run --record` begins
    card = Card()
    live = list(capture(card, settings, card.wait, card.now_ns, recorder))
    recorder.close()
    assert len(sounds(tmp_path)) > 5
    assert soundfile.info(sounds(tmp_path)[0]).subtype == "PCM_16"
    assert soundfile.info(sounds(tmp_path)[0]).channels == 4
    assert sum(f.overruns for f in live) == 2
    steps = np.diff([f.t_ns for f in live])
    assert len(set(steps)) > len(steps) / 2  # a clock that is worth keeping
    assert_same(live, list(wav_frames(sounds(tmp_path), settings)))


@pytest.mark.parametrize("estimator", ["far-field", "steered", "model:tdoa-mlp"])
def test_a_recording_replays_to_the_bearings_of_the_live_run(tmp_path, estimator):
    settings = make({"part_s": 0.7}, bearing={"estimator": estimator}, audio={"channel_map": [2, 0, 1]})
    recorder = Recorder(tmp_path, settings)
    pipeline = Pipeline(settings)
    live = [asdict(pipeline.process(frame)) for frame in islice(sim_frames(settings, recorder), 60)]
    recorder.close()
    beside = load(sounds(tmp_path)[0].with_suffix(".toml"))
    assert beside == settings
    pipeline = Pipeline(beside)
    again = [asdict(pipeline.process(frame)) for frame in wav_frames(sounds(tmp_path), beside)]
    assert any(e["track"] for e in live)
    assert len(again) == len(live)
    for a, b in zip(live, again, strict=True):
        a.pop("truth"), b.pop("truth")
        assert repr_of(a) == repr_of(b)


def repr_of(estimate: dict) -> str:
    return repr({k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in flat(estimate)})


def flat(tree: dict, path: str = ""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def test_a_looped_recording_is_recorded_with_its_seams(tmp_path):
    path = tmp_path / "loop.wav"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.5, 0.5, (16_000, 3)), 16_000)
    settings = make({"part_s": 0.4})
    recorder = Recorder(tmp_path / "parts", settings)
    live = list(islice(mic._wav_frames([path], settings, loop=True, tap=recorder), 50))
    recorder.close()
    assert_same(live, list(wav_frames(sounds(tmp_path / "parts"), settings)))


def test_no_frame_holds_sound_of_two_recordings(tmp_path):
    settings = make()
    for name, value in (("a", 0.25), ("b", 0.75)):
        soundfile.write(tmp_path / f"{name}.wav", np.full((5000, 3), value), 10_000)
    frames = list(wav_frames(sounds(tmp_path), settings))
    assert {np.unique(f.samples).tolist()[0] for f in frames} == {0.25, 0.75}
    assert all(len(np.unique(f.samples)) == 1 for f in frames)
    assert [f.t_ns for f in frames] == sorted({f.t_ns for f in frames})


def test_recordings_of_two_rates_are_refused_in_one_line(tmp_path):
    for name, rate in (("a", 10_000), ("b", 16_000)):
        soundfile.write(tmp_path / f"{name}.wav", np.zeros((5000, 3)), rate)
    with pytest.raises(SourceError, match=r"b\.wav: 16000 Hz, but what comes before it has 10000 Hz"):
        list(wav_frames(sounds(tmp_path), make()))


def test_what_lies_beside_by_chance_is_no_record_of_ours(tmp_path):
    path = tmp_path / "a.wav"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3)), 10_000)
    plain = list(wav_frames(path, make()))
    for text in (b'{"type":"bearing"}\n{"type":"gap","overruns":3}\n', b"\xff\x00", b'[1]\n{"rows":'):
        path.with_suffix(".blocks.jsonl").write_bytes(text)
        assert_same(plain, list(wav_frames(path, make())))


# --- a slow disk


def test_a_disk_that_is_too_slow_loses_blocks_and_counts_them(tmp_path, monkeypatch):
    settings = make()
    gate = threading.Event()
    write = parts.Part.write
    monkeypatch.setattr(parts.Part, "write", lambda *a: gate.wait(20) and write(*a))
    recorder = Recorder(tmp_path, settings)
    for number in range(math.ceil(recorders.WAITING_S * 10_000 / 512) + 40):
        recorder.block(np.full((512, 3), number, dtype=np.float32), 10_000, 0)
    assert recorder.progress().lost >= 39
    gate.set()
    while recorder._worker.waiting > 1:  # room again
        gate.wait(0.01)
    lost = recorder.progress().lost
    for _ in range(4):
        recorder.block(np.full((512, 3), -1, dtype=np.float32), 10_000, 0)
    recorder.close()
    frames = list(wav_frames(sounds(tmp_path), settings))
    (after,) = (f for f in frames if f.overruns)
    assert after.overruns == lost
    assert (after.samples == -1).all()  # nothing from before the loss


# --- loss of power


def wav_of(path: Path, sample: str, rows: np.ndarray) -> bytes:
    path.unlink(missing_ok=True)
    writer = WavWriter(path, 48_000, rows.shape[1], sample)
    writer.write(rows.astype(sample))
    writer.close()
    return path.read_bytes()


@examples(max_examples=50)
@given(
    sample=st.sampled_from(["int16", "float32"]),
    channels=st.integers(1, 9),
    cut=st.floats(0, 1),
    n=st.integers(1, 99),
)
def test_a_file_cut_anywhere_is_mended_to_its_last_whole_row(tmp_path_factory, sample, channels, cut, n):
    path = tmp_path_factory.mktemp("wav") / "a.wav"
    rows = np.arange(n * channels).reshape(n, channels)
    whole = wav_of(path, sample, rows)
    keep = round(cut * len(whole))
    path.write_bytes(whole[:keep])
    left = mend(path)
    assert left == max(keep - HEADER.size, 0) // (channels * np.dtype(sample).itemsize)
    if left:
        again, rate = soundfile.read(path, dtype=sample, always_2d=True)
        assert rate == 48_000
        np.testing.assert_array_equal(again, rows[:left])


def start(directory: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "locagen_edge", "record", "--output", str(directory), *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"},
    )


@pytest.fixture
def settings_file(tmp_path) -> Path:
    path = tmp_path / "s.toml"
    path.write_text("[record]\npart_s = 0.6\nsync_s = 0.1\nfree_mb = 0\n")
    return path


def test_a_kill_loses_no_more_than_a_moment_and_the_next_start_mends(tmp_path, settings_file):
    folder = tmp_path / "parts"
    process = start(folder, "--settings", str(settings_file))
    try:
        while process.poll() is None and not any(p.stat().st_size > 4096 for p in second_part(folder)):
            os.sched_yield()
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert list(folder.glob("*.part"))
    done = start(folder, "--settings", str(settings_file), "--seconds", "0.3")
    _, err = done.communicate(timeout=30)
    assert done.returncode == 0, err
    assert "was not finished: mended" in err
    assert not list(folder.glob("*.part"))
    session = [p for p in sounds(folder) if next(read(beside(p)))["session"] == first_session(folder)]
    assert len(session) == 2
    settings = load(session[0].with_suffix(".toml"))
    again = list(wav_frames(session, settings))
    assert_same(list(islice(sim_frames(settings), len(again))), again)


def second_part(folder: Path) -> list[Path]:
    return list(folder.glob("*-0002.wav.part"))


def beside(path: Path) -> Path:
    return path.with_suffix(".blocks.jsonl")


def first_session(folder: Path) -> str:
    return next(read(beside(sounds(folder)[0])))["session"]


def test_what_another_process_is_writing_is_left_alone(tmp_path):
    settings = make()
    first = Recorder(tmp_path, settings)
    first.block(np.zeros((2000, 3), dtype=np.float32), 10_000, 0)
    while not list(tmp_path.glob("*.wav.part")):
        os.sched_yield()
    second = Recorder(tmp_path, settings)
    assert list(tmp_path.glob("*.wav.part"))
    second.block(np.zeros((2000, 3), dtype=np.float32), 10_000, 0)
    first.close()
    second.close()
    assert len(sounds(tmp_path)) == 2
    assert not list(tmp_path.glob("*.part"))


def test_a_damaged_header_is_kept_for_whoever_can_read_it(tmp_path, caplog):
    stem = tmp_path / "20260101T000000Z-0001"
    Path(f"{stem}.wav.part").write_bytes(bytes(5000))
    assert parts.recover(tmp_path) == []
    assert Path(f"{stem}.wav.damaged").stat().st_size == 5000
    assert "header is damaged" in caplog.text


# --- bounds


BLOCKS = st.lists(st.integers(1, 4000), min_size=5, max_size=60)


@examples(max_examples=25)
@given(blocks=BLOCKS, part_mb=st.floats(0.03, 0.1), when_full=st.sampled_from(["oldest", "stop"]))
def test_the_folder_never_holds_more_than_it_may(tmp_path_factory, blocks, part_mb, when_full):
    folder = tmp_path_factory.mktemp("parts")
    stranger = folder / "my notes.wav"
    stranger.write_bytes(bytes(1_000_000))
    settings = make({"part_mb": part_mb, "total_mb": 0.2, "when_full": when_full})
    recorder = Recorder(folder, settings)
    sizes = []
    write = recorder._write

    def watched(item):
        write(item)
        sizes.append(sum(p.stat().st_size for p in folder.iterdir() if p != stranger))

    recorder._worker._write = watched
    for rows in blocks:
        recorder.block(np.zeros((rows, 3), dtype=np.int16), 48_000, 0)
    recorder.close()
    assert max(sizes) <= 0.2 * MB
    assert stranger.stat().st_size == 1_000_000
    assert not list(folder.glob("*.part"))
    stranger.unlink()
    kept = sum(soundfile.info(p).frames for p in sounds(folder))
    if when_full == "oldest":
        assert not recorder.failure
        assert sounds(folder)[-1].stat().st_size > HEADER.size
    else:  # what came before the bound is all there
        assert bool(recorder.failure) == (kept < sum(blocks))
        assert not recorder.failure or "record.total_mb = 0.2 MB" in recorder.failure


def test_too_little_room_from_the_start_is_told(tmp_path):
    with pytest.raises(StorageError, match=r"MB are free on the disk, record\.free_mb = 1e\+08 MB"):
        Recorder(tmp_path, make({"free_mb": 1e8}))


def test_other_settings_begin_a_part_and_the_sound_goes_on(tmp_path):
    settings = make()
    turned = replace(settings, array=replace(settings.array, mount_deg=(0.0, 0.0, 90.0)))
    recorder = Recorder(tmp_path, settings)
    recorder.apply(replace(settings))  # equal: nothing begins
    live = []
    for number, frame in enumerate(islice(sim_frames(settings, recorder), 60)):
        if number in (20, 40):
            recorder.apply(turned if number == 20 else settings)
        live.append(frame)
    recorder.close()
    beside = [load(path.with_suffix(".toml")) for path in sounds(tmp_path)]
    assert beside == [settings, turned, settings]
    assert_same(live, list(wav_frames(sounds(tmp_path), settings)))


def test_levels_and_length_are_shown(tmp_path):
    recorder = Recorder(tmp_path, make())
    rows = np.zeros((4800, 2), dtype=np.int16)
    rows[::2, 1] = -16384
    recorder.block(rows, 48_000, 0)
    recorder.block(-rows, 48_000, 0)
    recorder.close()
    shown = recorder.progress()
    assert shown.seconds == pytest.approx(0.2)
    assert shown.peak.tolist() == [0.0, 0.5]
    np.testing.assert_allclose(shown.rms, [0.0, 0.5 * 0.5**0.5])
    assert shown.lost == 0
    assert recorder.progress().peak.tolist() == [0.0, 0.0]  # since the last time


def test_other_records_stand_between_and_disturb_nothing(tmp_path):
    settings = make()
    recorder = Recorder(tmp_path, settings)
    live = []
    for number, frame in enumerate(islice(sim_frames(settings, recorder), 30)):
        recorder.note({"type": "pose", "t_ns": number})
        live.append(frame)
    with pytest.raises(ValueError, match="JSON"):
        recorder.note({"type": "pose", "height_m": float("nan")})
    recorder.close()
    kept = [r for r in read(beside(sounds(tmp_path)[0])) if r["type"] == "pose"]
    assert [r["t_ns"] for r in kept] == list(range(30))
    assert_same(live, list(wav_frames(sounds(tmp_path), settings)))


def test_rows_as_captured_are_chosen_by_the_map_again():
    samples = np.arange(12, dtype=np.float32).reshape(3, 4)
    rows = as_captured(samples, (4, 0, 2))
    assert rows.shape == (4, 5)
    np.testing.assert_array_equal(rows[:, [4, 0, 2]].T, samples)


def test_a_line_is_one_line():
    assert encode({"text": "a\nb"}).count(b"\n") == 1
