"""The truth about channels, from their signals alone: what is wrong is named, what is right never accused."""

import math
import subprocess
import sys
from itertools import islice

import numpy as np
import pytest
import soundfile
from conftest import ROOT
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scenes import cut, heard, rotor_recording

from locagen_edge.geometry import direction
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.framer import Framer
from locagen_edge.pipeline import Pipeline
from locagen_edge.resampling import Resampler
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.scene import frames as sim_frames

ON_DELAYS = {"bearing": {"estimator": "far-field"}}
SQUARE = [[0.05, 0.05, 0.0], [0.05, -0.05, 0.0], [-0.05, -0.05, 0.0], [-0.05, 0.05, 0.0]]
SCALENE = [[0.08, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.04, 0.0]]


def made(positions=None, **sections):
    if positions is None:
        return from_table(ON_DELAYS | sections)
    array = {"positions_m": positions}
    return from_table(
        ON_DELAYS | {"array": array, "audio": {"channel_map": list(range(len(positions)))}} | sections
    )


def faults(settings, samples):
    """After all of the sound."""
    pipeline = Pipeline(settings)
    told = ()
    for frame in cut(settings, samples):
        told = pipeline.process(frame).faults
    return told


# --- between channels


@pytest.mark.parametrize("mic", [0, 1, 2])
@pytest.mark.parametrize("snr_db", [5.0, 30.0])
def test_an_inverted_microphone_is_named(mic, snr_db):
    settings = made()
    samples = heard(settings, 1.0, -0.3, snr_db, 30_000)
    samples[mic] *= -1.0
    assert faults(settings, samples) == (f"microphone {mic}: inverted, its two wires are swapped",)


@pytest.mark.parametrize("mic", [0, 3])
def test_an_inverted_microphone_of_four_is_named(mic):
    settings = made(SQUARE)
    samples = heard(settings, -2.0, -0.3, 10.0, 30_000)
    samples[mic] *= -1.0
    assert faults(settings, samples) == (f"microphone {mic}: inverted, its two wires are swapped",)


@pytest.mark.parametrize("call", ["scream", "speech", "knock"])
def test_a_call_is_enough_to_tell_and_its_pauses_are_borne(call):
    settings = made(sim={"call": call, "snr_db": 15.0})
    pipeline = Pipeline(settings)
    for frame in islice(sim_frames(settings), 150):
        frame.samples[1] *= -1.0
        told = pipeline.process(frame).faults
    assert told == ("microphone 1: inverted, its two wires are swapped",)
    assert pipeline.channels_judged


@pytest.mark.parametrize("samples_late", [-40, 12, 100])
def test_a_channel_out_of_step_is_named(samples_late):
    settings = made()
    samples = heard(settings, 1.0, -0.3, 10.0, 30_000)
    samples[2] = np.roll(samples[2], samples_late)
    assert faults(settings, samples) == (
        "microphone 2: out of step, far too early or too late for its place",
    )


@pytest.mark.parametrize("azimuth", np.linspace(-3.0, 3.0, 7))
def test_an_array_larger_than_it_says_is_told_from_any_side(azimuth):
    """A sound from about the array's own height: some pair is in line with it."""
    real = made()
    believed = made([[x / 2 for x in row] for row in real.array.positions_m])
    told = faults(believed, heard(real, azimuth, -0.2, 15.0, 30_000))
    assert told == ("delays longer than array.positions_m allows: channels swapped, wrong places or rate",)


def test_a_device_of_another_rate_stretches_delays_and_is_told():
    """Twice the samples in every second, as of a 96 kHz card that is taken for 48."""
    settings = made()
    fast = made(audio={"rate_hz": 20_000})
    samples = heard(fast, 0.5, 0.0, 20.0, 60_000)
    assert any("wrong places or rate" in text for text in faults(settings, samples))


def test_a_microphone_that_hears_another_world_is_named():
    settings = made()
    samples = heard(settings, 1.0, -0.3, 20.0, 30_000)
    samples[1] = 0.05 * np.random.default_rng(5).standard_normal(30_000)
    assert faults(settings, samples) == ("microphone 1: hears nothing of what the others hear",)


def test_swapped_channels_of_unequal_sides_are_told_where_their_delays_are_impossible():
    """Swapped, they seem to come from u' instead of u: where that is longer than 1, from nowhere."""
    settings = made(SCALENE)
    baselines = settings.mic_array.baselines_m[:, :2]
    p = np.array(SCALENE)[[0, 2, 1], :2]
    swapped = np.array([p[i] - p[j] for i, j in settings.mic_array.pairs])
    seen = set()
    for azimuth in np.arange(-3.0, 3.0, 0.5):
        there = np.linalg.lstsq(baselines, swapped @ direction(azimuth)[:2], rcond=None)[0]
        told = faults(settings, heard(settings, azimuth, 0.0, 20.0, 20_000)[[0, 2, 1]])
        if np.linalg.norm(there) > 1.2:
            assert "array.positions_m" in told[0]
        elif np.linalg.norm(there) < 0.95:
            assert told == ()
        seen.add(bool(told))
    assert seen == {True, False}


# --- channels by themselves


@pytest.mark.parametrize("gain", [1.0, 0.5, -1.0, -0.1])
def test_one_signal_on_two_channels_is_told_whatever_its_level_and_sign(gain):
    settings = made()
    samples = heard(settings, 1.0, -0.3, 10.0, 30_000)
    samples[2] = np.rint(gain * samples[1] * 32768) / 32768
    assert faults(settings, samples) == (
        "microphones 1 and 2: the same signal twice, check audio.channel_map",
    )


def test_a_sound_that_reaches_two_microphones_at_once_is_no_signal_twice():
    """In line with neither, and loud: 40 dB over the microphones' own noise."""
    settings = made()
    for azimuth in np.linspace(-math.pi, math.pi, 13):
        assert faults(settings, heard(settings, azimuth, 0.0, 40.0, 10_000)) == ()


# --- nothing is accused that is right


@examples(max_examples=12)
@given(
    call=st.sampled_from(["white", "speech", "scream", "whistle", "tone", "knock", "instrument"]),
    snr_db=st.sampled_from([-10.0, 0.0, 10.0, 40.0]),
    azimuth_deg=st.floats(-180, 180),
    turn_deg_s=st.floats(-90, 90),
    rotors=st.sampled_from([0, 4, 6]),
    seed=st.integers(0, 1000),
)
def test_no_scene_accuses_good_microphones(call, snr_db, azimuth_deg, turn_deg_s, rotors, seed):
    sim = {
        "call": call, "snr_db": snr_db, "azimuth_deg": azimuth_deg, "turn_deg_s": turn_deg_s,
        "rotors": rotors, "seed": seed, "noise_dbfs": -60.0,
    }  # fmt: skip
    settings = made(sim=sim)
    pipeline = Pipeline(settings)
    for frame in islice(sim_frames(settings), 60):
        assert pipeline.process(frame).faults == ()


def test_recorded_rotors_accuse_nobody(recordings):
    side = 0.055
    positions = [[side, -side, 0.0], [side, side, 0.0], [-side, side, 0.0], [-side, -side, 0.0]]
    settings = made(positions)
    sound = Resampler(48_000, 10_000, 4).flush(np.ascontiguousarray(rotor_recording(recordings).T))
    pipeline = Pipeline(settings)
    frames = cut(settings, sound.T)
    assert len(frames) > 80
    for frame in frames:
        assert pipeline.process(frame).faults == ()


# --- told


def test_a_fault_is_told_once_and_again_only_when_it_comes_back():
    component, framer = Component(Settings().mavlink), Framer()
    fault = "microphone 1: inverted, its two wires are swapped"
    told = []
    for tick in range(600):
        there = (fault,) if 10 < tick < 250 or tick > 400 else ()
        for data in component.due(tick * 0.1, Status(hearing=True, track=None, snr_db=0.0, faults=there)):
            messages = [dialect.decode(packet.raw) for packet in framer.feed(data)]
            told += [tick for m in messages if m.get_type() == "STATUSTEXT" and m.text == fault]
    assert [10 < told[0] < 20, 400 < told[1] < 410, len(told)] == [True, True, 2]


def check(tmp_path, samples, seconds="2"):
    sound, settings = tmp_path / "a.wav", tmp_path / "s.toml"
    soundfile.write(sound, samples.T, 10_000, subtype="FLOAT")
    settings.write_text(
        f'[audio]\nsource = "wav"\nfile = "{sound}"\nloop = true\n[bearing]\nestimator = "far-field"\n'
        '[mavlink]\nlink = "udpout:127.0.0.1:9"\n'
    )
    return subprocess.run(
        [sys.executable, "-m", "locagen_edge", "check", "--seconds", seconds, "--settings", settings],
        cwd=ROOT, text=True, capture_output=True, timeout=60, check=False,
    )  # fmt: skip


def test_check_names_an_inverted_microphone(tmp_path):
    samples = heard(Settings(), 1.0, -0.3, 20.0, 40_000)
    samples[2] *= -1.0
    done = check(tmp_path, samples)
    assert done.returncode == 1
    assert "WRONG  microphones: microphone 2: inverted, its two wires are swapped" in done.stdout
    assert "not judged" not in done.stdout


def test_check_says_what_it_could_not_judge(tmp_path):
    samples = 1e-3 * np.random.default_rng(0).standard_normal((3, 40_000))
    done = check(tmp_path, samples, "1")
    assert done.returncode == 0, done.stdout
    assert "no sound was common to all microphones: order, sign and spacing are not judged" in done.stdout
