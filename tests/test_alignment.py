"""Channels made alike: late ones come in step, however the stream is cut, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.alignment import HALF, Aligner
from locagen_edge.settings import from_table
from locagen_edge.sim.propagation import delayed
from locagen_edge.sim.synth import band_noise
from locagen_edge.stages.mic import wav_frames

RATE = 10_000


def sound(n: int = 8000, seed: int = 0) -> np.ndarray:
    """In the default band, without an edge."""
    return band_noise(n, RATE, 300.0, 4700.0, np.random.default_rng(seed)) * np.hanning(n)


def through(aligner: Aligner, rows: np.ndarray, cuts: list[int] | tuple[int, ...] = ()) -> np.ndarray:
    parts = np.split(rows, sorted(cuts))
    return np.concatenate([*(aligner.push(part) for part in parts), aligner.flush(rows[:0])])


@given(
    st.lists(st.floats(-0.005, 0.005), min_size=2, max_size=4),
    st.lists(st.integers(0, 8000), max_size=6),
)
def test_late_channels_come_in_step_however_the_stream_is_cut(delays, cuts):
    clean = sound()
    late = delayed(clean, np.array(delays) * RATE).T.astype(np.float32)
    rows = through(Aligner(delays, (), RATE, len(delays)), late, cuts)
    assert rows.shape == late.shape
    # 60 dB is what the window was chosen for
    assert np.mean((rows - clean[:, None]) ** 2) < 1e-6 * np.mean(clean**2)


def test_a_channel_that_is_early_is_put_back():
    clean = sound()
    rows = through(Aligner([0.0, -2e-4], (), RATE, 2), delayed(clean, np.array([0.0, -2.0])).T)
    assert np.abs(rows[:, 1] - rows[:, 0]).max() < 1e-3 * np.abs(clean).max()


def test_nothing_to_do_is_nothing_done():
    rows = sound().astype(np.float32)[:, None].repeat(3, axis=1)
    for delays, gains in (((), ()), ((0.0, 0.0, 0.0), ()), ((), (0.0, 0.0, 0.0))):
        assert np.array_equal(through(Aligner(delays, gains, RATE, 3), rows), rows)


@pytest.mark.parametrize("delays", [(), (0.0, 1e-5)])
def test_a_loud_channel_is_brought_down(delays):
    clean = sound()
    rows = np.stack([clean, clean * 10 ** (6.0 / 20.0)], axis=1).astype(np.float32)
    level = np.sqrt(np.mean(through(Aligner(delays, (0.0, 6.0), RATE, 2), rows) ** 2, axis=0))
    assert level[1] == pytest.approx(level[0], rel=1e-3)


def test_what_is_not_a_number_spoils_the_filters_length_of_its_own_channel():
    rows = sound().astype(np.float32)[:, None].repeat(2, axis=1)
    rows[4000, 1] = np.nan
    bad = np.isnan(through(Aligner((0.0, 1e-5), (), RATE, 2), rows))
    assert not bad[:, 0].any()
    assert bad[:, 1].any()
    assert np.abs(np.flatnonzero(bad[:, 1]) - 4000).max() <= HALF + 1


def test_a_cleared_stream_remembers_nothing():
    aligner, fresh = (Aligner((0.0, 1e-5), (), RATE, 2) for _ in range(2))
    rows = sound().astype(np.float32)[:, None].repeat(2, axis=1)
    aligner.push(rows[::-1])
    aligner.clear()
    assert np.array_equal(through(aligner, rows), through(fresh, rows))


@pytest.mark.parametrize("rate", [10_000, 48_000])
def test_a_recording_comes_in_step_and_at_its_time(tmp_path, rate):
    """Frames of late, loud channels, corrected, are those of good ones."""
    clean = np.interp(np.arange(2 * rate) / rate, np.arange(2 * RATE) / RATE, sound(2 * RATE)) * 0.1
    good, bad = tmp_path / "good.wav", tmp_path / "bad.wav"
    delays, gains = [0.0, 30e-6, -55e-6], [0.0, 3.0, -2.0]
    late = delayed(clean, np.array(delays) * rate) * 10 ** (np.array(gains)[:, None] / 20)
    soundfile.write(good, np.stack([clean] * 3, axis=1), rate, subtype="FLOAT")
    soundfile.write(bad, late.T, rate, subtype="FLOAT")
    settings = from_table({"array": {"delays_s": delays, "gains_db": gains}})
    frames, wanted = list(wav_frames(bad, settings)), list(wav_frames(good, from_table({})))
    assert [f.t_ns for f in frames] == [f.t_ns for f in wanted]
    error = np.array([f.samples for f in frames]) - np.array([f.samples for f in wanted])
    assert np.mean(error**2) < 1e-5 * np.mean(clean**2)  # what lies above the band is not held to 60 dB
