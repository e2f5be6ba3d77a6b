"""The denoisers as they fly: nothing shifts, nothing leaks from one microphone or moment into another."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfilt

from locagen_edge.errors import SettingsError
from locagen_edge.framing import Framer
from locagen_edge.highpass import BLOCK, HighPass
from locagen_edge.models import load_network
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim import calls
from locagen_edge.sim.rotors import rotor
from locagen_edge.stages.denoise import (
    CHUNK,
    FLOOR,
    HIGH_PASS_HZ,
    LOOKAHEAD,
    MASK_DELAY,
    RATE_HZ,
    SMOOTH_STEPS,
    STEP,
    WAVE_DELAY,
    MaskDenoiser,
    MaskStream,
    NoiseSpectrum,
    Presence,
    WaveDenoiser,
    WaveStream,
    decision_directed,
    finite,
)

WAVE = from_table({"denoise": {"kind": "wave"}})
MASK = from_table({"denoise": {"kind": "mask"}})
MICS = 3


def frames(sound: np.ndarray, overruns: int = 0) -> list:
    framer = Framer(1024, 512, len(sound), RATE_HZ)
    framer.gap(overruns) if overruns else None
    return framer.push(sound.astype(np.float32))


def rotors(n: int, seed: int, level: float = 0.05) -> np.ndarray:
    """(MICS, n), each microphone its own."""
    made = [rotor(0.5, RATE_HZ, 4700.0, np.random.default_rng([seed, mic])) for mic in range(MICS)]
    return level * np.stack([np.concatenate(list(islice(one, n // 7000 + 2)))[:n] for one in made])


def whistle(n: int, level: float) -> np.ndarray:
    return level * calls.whistle(n, RATE_HZ, 4700.0, np.random.default_rng(3))


class Passing:
    """A mask network that keeps everything."""

    def zeros(self, **_: int) -> list:
        return [np.zeros(1, np.float32)]

    def __call__(self, inputs: list) -> list:
        return [np.ones_like(inputs[0]), inputs[-1]]


class Delaying:
    """A waveform network that keeps this much of the sound, WAVE_DELAY later."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def zeros(self, mics: int) -> list:
        return [np.zeros((mics, WAVE_DELAY), np.float32)]

    def __call__(self, inputs: list) -> list:
        both = np.concatenate(inputs[::-1], axis=1)
        return [np.float32(self.gain) * both[:, :CHUNK], both[:, CHUNK:]]


# --- presence and floor -------------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30), st.floats(0.0, 0.5), st.floats(1e-6, 1.0))
@settings(max_examples=30)
def test_keeping_more_is_never_less_of_a_call(shares: list[float], more: float, noise: float) -> None:
    share = np.array([shares])
    low, high = (Presence(1, (2.0, 4.0))(x, noise) for x in (share, np.minimum(share + more, 1.0)))
    assert ((low >= 0.0) & (high <= 1.0) & (low <= high)).all()


def test_presence_is_smooth_over_its_steps() -> None:
    """After SMOOTH_STEPS of a share of 1 it has come 1 - 1/e of the way from nothing."""
    share = np.ones((1, SMOOTH_STEPS))
    half = 1.0 - (1.0 - 1.0 / SMOOTH_STEPS) ** SMOOTH_STEPS
    at_db = 10.0 * np.log10(half)
    assert Presence(1, (at_db - 1.0, at_db + 1.0))(share)[0, -1] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(("kept", "left"), [(0.0, FLOOR), (0.01, FLOOR), (1.0, 1.0)])
def test_the_floor_is_the_sound_as_it_came(kept: float, left: float) -> None:
    """A network that finds nothing leaves its input, 20 dB down; one that keeps all leaves it as it is."""
    sound = np.random.default_rng(1).standard_normal((MICS, 10 * CHUNK)).astype(np.float32)
    out = WaveStream(Delaying(kept), MICS)(sound)  # type: ignore[arg-type]
    settled = 4 * CHUNK
    wanted = left * sound[:, settled - WAVE_DELAY : -WAVE_DELAY]
    np.testing.assert_allclose(out[:, settled:], wanted, atol=1e-5)


def test_the_floor_opens_and_closes_without_a_click() -> None:
    """What the gain does between two samples is at most a STEP's part of all it can do."""
    network = Delaying(0.0)
    stream = WaveStream(network, 1)  # type: ignore[arg-type]
    gains = []
    for network.gain in [0.0] * 4 + [1.0] * 4 + [0.0] * 4:
        gains.append(stream(np.ones((1, CHUNK), np.float32))[0])
    found = np.concatenate(gains)[CHUNK:]
    inner = np.delete(np.abs(np.diff(found)), np.arange(1, 11) * CHUNK - 1)  # this network itself clicks
    assert inner.max() <= 1.0 / STEP + 1e-6
    assert found.max() == pytest.approx(1.0, abs=1e-5)
    assert found[-1] == pytest.approx(FLOOR, abs=1e-5)


@given(st.lists(st.floats(0.0, 1e12), min_size=2, max_size=40))
@settings(max_examples=30)
def test_wieners_gain_is_one_stream_however_it_is_cut(values: list[float]) -> None:
    power = np.array(values)[:, np.newaxis]
    whole, kept = decision_directed(power, np.zeros(1))
    first, between = decision_directed(power[:1], np.zeros(1))
    rest, last = decision_directed(power[1:], between)
    np.testing.assert_array_equal(whole, np.concatenate([first, rest]))
    np.testing.assert_array_equal(kept, last)
    assert ((whole > 0.0) & (whole <= 1.0)).all()


# --- the high-pass ------------------------------------------------------------------------------------


def test_the_high_pass_is_butterworths_however_it_is_cut() -> None:
    sound = np.random.default_rng(1).standard_normal((2, 20 * BLOCK)).astype(np.float32)
    one = HighPass(HIGH_PASS_HZ, RATE_HZ, 2)
    parts = np.concatenate([one(sound[:, : 4 * BLOCK]), one(sound[:, 4 * BLOCK :])], axis=1)
    sections = butter(4, HIGH_PASS_HZ, "highpass", fs=RATE_HZ, output="sos")
    np.testing.assert_allclose(parts, sosfilt(sections, sound), atol=2e-6)  # float32 out
    one.reset()
    np.testing.assert_array_equal(one(sound[:, :BLOCK]), parts[:, :BLOCK])


# --- wave ---------------------------------------------------------------------------------------------


def test_frames_hold_what_the_whole_stream_gives_and_say_when_it_was() -> None:
    sound = rotors(8 * CHUNK, 1) + whistle(8 * CHUNK, 0.1)
    network = load_network(WAVE.denoise.wave, WAVE)
    high_passed = HighPass(HIGH_PASS_HZ, RATE_HZ, MICS)(sound.astype(np.float32))
    whole = WaveStream(network, MICS)(high_passed)
    denoise = WaveDenoiser(WAVE)
    for frame in frames(sound):
        clean = denoise(frame)
        first = frame.start  # whole[k] belongs to the sample k - WAVE_DELAY
        np.testing.assert_allclose(clean.samples, whole[:, first : first + 1024], atol=1e-6)
        assert clean.start == frame.start - WAVE_DELAY
        assert clean.t_ns == frame.t_ns - 6_400_000


def test_a_call_keeps_its_place_in_time() -> None:
    """Loud and alone, it comes out as it went in, WAVE_DELAY later: no microphone is shifted."""
    sound = np.stack([np.roll(whistle(40 * CHUNK, 0.1), shift) for shift in (0, 1, 2)])
    sound += 1e-3 * np.random.default_rng(1).standard_normal(sound.shape)
    clean = WaveStream(load_network(WAVE.denoise.wave, WAVE), MICS)(sound.astype(np.float32))
    late = np.pad(sound, ((0, 0), (WAVE_DELAY, 0)))[:, : sound.shape[1]]
    for given_, out in zip(late[:, 4000:], clean[:, 4000:], strict=True):
        lags = [float(np.roll(given_, lag)[9:-9] @ out[9:-9]) for lag in range(-3, 4)]
        assert np.argmax(lags) == 3


def test_microphones_do_not_hear_each_other() -> None:
    sound = rotors(6 * CHUNK, 2)
    other = sound.copy()
    other[1] *= 3.0
    there, here = WaveDenoiser(WAVE), WaveDenoiser(WAVE)
    for a, b in zip(frames(sound), frames(other), strict=True):
        np.testing.assert_allclose(there(a).samples[[0, 2]], here(b).samples[[0, 2]], atol=1e-6)


def test_what_is_no_number_stays_none_and_is_forgotten() -> None:
    sound = rotors(12 * CHUNK, 3)
    broken = sound.copy()
    broken[1, 2000:2003] = [np.nan, np.inf, -np.inf]
    whole, denoise = WaveDenoiser(WAVE), WaveDenoiser(WAVE)
    for a, b in zip(frames(sound), frames(broken), strict=True):
        wanted, found = whole(a).samples, denoise(b).samples
        np.testing.assert_allclose(found[[0, 2]], wanted[[0, 2]], atol=1e-6)
        bad = ~np.isfinite(found[1])
        held = (a.start - WAVE_DELAY <= np.arange(2000, 2003)) & (
            np.arange(2000, 2003) < a.start - WAVE_DELAY + 1024
        )
        assert bad.sum() == held.sum()
    assert np.isfinite(found).all()


@given(
    st.lists(st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 3e38, 1e-40]), min_size=1, max_size=20)
)
@settings(max_examples=15)
def test_no_input_poisons_what_comes_later(values: list[float]) -> None:
    """After 1.5 s, all that a network remembers, the same sound gives nearly the same again."""
    network, quiet = load_network(WAVE.denoise.wave, WAVE), rotors(CHUNK, 4).astype(np.float32)
    stream = WaveStream(network, MICS)
    bad = np.resize(np.array(values, np.float32), (MICS, CHUNK))
    stream(finite(bad))
    for _ in range(34):
        found = stream(quiet)
    fresh = WaveStream(network, MICS)
    for _ in range(34):
        wanted = fresh(quiet)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_silence_and_a_dead_microphone_are_silent() -> None:
    denoise = WaveDenoiser(WAVE)
    sound = rotors(6 * CHUNK, 5)
    sound[2] = 0.0
    for frame in frames(sound):
        clean = denoise(frame).samples
        assert not clean[2].any()
    assert clean[0].any()


def test_after_a_gap_it_begins_anew() -> None:
    denoise = WaveDenoiser(WAVE)
    for frame in frames(rotors(6 * CHUNK, 6)):
        denoise(frame)
    after = frames(rotors(6 * CHUNK, 7), overruns=1)
    fresh = WaveDenoiser(WAVE)
    for frame in after:
        np.testing.assert_array_equal(denoise(frame).samples, fresh(frame).samples)


def test_clipped_sound_stays_within_reason() -> None:
    sound = np.clip(20.0 * rotors(8 * CHUNK, 8), -1.0, 1.0)
    denoise = WaveDenoiser(WAVE)
    loudest = max(float(np.abs(denoise(frame).samples).max()) for frame in frames(sound))
    assert loudest < 4.0


def test_the_pipeline_flies_with_it_and_still_tells_a_broken_microphone() -> None:
    pipeline = Pipeline(WAVE)
    sound = rotors(60 * CHUNK, 9)
    sound[1] = np.nan
    estimates = [pipeline.process(frame) for frame in frames(sound)]
    assert any("1" in fault for fault in estimates[-1].faults)
    silence = Pipeline(WAVE)
    for frame in frames(np.zeros((MICS, 8 * CHUNK))):
        assert silence.process(frame).bearing.azimuth_rad is None


# --- mask ---------------------------------------------------------------------------------------------


def test_a_mask_of_one_gives_the_sound_back_one_hop_late() -> None:
    stream = MaskStream(Passing(), MICS)  # type: ignore[arg-type]
    sound = np.random.default_rng(1).standard_normal((MICS, 10 * CHUNK)).astype(np.float32)
    parts = [stream(sound[:, k : k + CHUNK]) for k in range(0, sound.shape[1], CHUNK)]
    stream.reset()
    out = np.concatenate([stream.cleaned(*part) for part in parts], axis=1)
    np.testing.assert_allclose(out[:, MASK_DELAY:], sound[:, :-MASK_DELAY], atol=1e-5)


def hear(denoise: MaskDenoiser, sound: np.ndarray, call: bool) -> list:
    found = []
    for frame in frames(sound):
        found.append(denoise(frame))
        denoise.settle(call)
    return found


def test_before_the_noise_is_known_everything_passes() -> None:
    (first, *_) = hear(MaskDenoiser(MASK), rotors(8 * CHUNK, 1), True)
    assert (first.weight == 1.0).all()
    assert first.snr_db == -np.inf
    # calls teach nothing
    last = hear(MaskDenoiser(MASK), rotors(40 * CHUNK, 1), True)[-1]
    assert (last.weight == 1.0).all()


@pytest.fixture(scope="module")
def told() -> MaskDenoiser:
    denoise = MaskDenoiser(MASK)
    hear(denoise, rotors(60 * CHUNK, 1), False)
    return denoise


def in_stream(denoise: MaskDenoiser, sound: np.ndarray) -> list:
    """As new sound after a gap, the noise still known; nothing is learnt."""
    return [denoise(frame) for frame in frames(sound, overruns=1)]


def test_it_keeps_the_whistle_and_not_the_rotors(told: MaskDenoiser) -> None:
    n = 30 * CHUNK
    noise = in_stream(told, rotors(n, 2))[-1]
    call = in_stream(told, rotors(n, 2) + whistle(n, 0.15))[-1]
    bin_hz = RATE_HZ / 1024
    assert 2600.0 < call.weight[100:].argmax() * bin_hz + 100 * bin_hz < 3500.0
    assert noise.weight.mean() < 0.3
    assert call.snr_db > noise.snr_db + 10.0
    assert ((call.weight >= 0.0) & (call.weight <= 1.0)).all()
    assert call.weight.shape == (513,)
    assert call.masks.shape == (7 - LOOKAHEAD, 129)


def listen(sound: np.ndarray, noise_chunks: int) -> np.ndarray:
    """What a person hears of a stream whose first chunks are taken as noise, MASK_DELAY taken out."""
    stream = MaskStream(load_network(MASK.denoise.mask, MASK), MICS)
    out = []
    for first in range(0, sound.shape[1], CHUNK):
        spectra, mask = stream(sound[:, first : first + CHUNK].astype(np.float32))
        out.append(stream.cleaned(spectra, mask))
        if first < noise_chunks * CHUNK:
            stream.learn()
    return np.concatenate(out, axis=1)[:, MASK_DELAY:]


def test_a_person_hears_the_rotors_20_db_down_and_the_whistle() -> None:
    noise = rotors(120 * CHUNK, 1)
    call = whistle(120 * CHUNK, 0.1)
    call[: 80 * CHUNK] = 0.0
    out = listen(noise + call, 60)
    rest, calling = (slice(a * CHUNK, b * CHUNK) for a, b in ((62, 78), (90, 115)))

    def level(part: slice) -> float:
        return float(10.0 * np.log10(np.mean(out[:, part] ** 2) / np.mean(noise[:, part] ** 2)))

    assert level(rest) == pytest.approx(20.0 * np.log10(FLOOR), abs=1.5)  # it opens for moments
    gain = out[0, calling] @ call[calling] / (call[calling] @ call[calling])
    assert gain > 0.8


def test_every_microphone_is_heard_by_the_same_gain() -> None:
    sound = rotors(60 * CHUNK, 1)[:1] + whistle(60 * CHUNK, 0.05)
    out = listen(np.concatenate([sound, -0.5 * sound, sound]), 30)
    np.testing.assert_allclose(out[1], -0.5 * out[0], atol=1e-6)


def test_silence_and_what_is_no_number_end_with_themselves() -> None:
    sound = rotors(120 * CHUNK, 1)
    broken = sound.copy()
    broken[:, 70 * CHUNK : 72 * CHUNK] = finite(np.full((MICS, 2 * CHUNK), np.inf, np.float32))
    broken[:, 72 * CHUNK : 74 * CHUNK] = 0.0
    whole, found = listen(sound, 60), listen(broken, 60)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:, 110 * CHUNK :], whole[:, 110 * CHUNK :], atol=2e-3)  # of 0.05


def test_level_does_not_matter() -> None:
    """All of it 40 dB quieter: the same mask. The floors of both are far below."""
    found = []
    for level in (1.0, 0.01):
        denoise = MaskDenoiser(MASK)
        hear(denoise, level * rotors(40 * CHUNK, 1), False)
        found.append(in_stream(denoise, level * (rotors(20 * CHUNK, 2) + whistle(20 * CHUNK, 0.1)))[-1])
    np.testing.assert_allclose(found[0].weight, found[1].weight, atol=1e-3)


@pytest.mark.parametrize("fault", [0.0, np.nan])
def test_a_microphone_that_fails_leaves_the_mask_to_the_others(told: MaskDenoiser, fault: float) -> None:
    n = 30 * CHUNK
    sound = np.tile(rotors(n, 2)[0] + whistle(n, 0.15), (MICS, 1))
    whole = in_stream(told, sound)
    broken = sound.copy()
    broken[2, 10 * CHUNK :] = fault
    failing = in_stream(told, broken)
    assert np.isfinite([mask.weight for mask in failing]).all()
    # the noise of each was learnt apart, so the mean over two of three is not quite that over all
    np.testing.assert_allclose(failing[-1].weight.mean(), whole[-1].weight.mean(), atol=0.1)


def test_silence_teaches_nothing_and_passes_untouched() -> None:
    denoise = MaskDenoiser(MASK)
    last = hear(denoise, np.zeros((MICS, 40 * CHUNK)), False)[-1]
    assert (last.weight == 1.0).all()
    noise = NoiseSpectrum(1, 100.0)
    noise.learn(np.zeros((1, 4, 129)))
    noise.learn(np.ones((1, 2, 129)))
    assert (noise.mean == 1.0).all()


def test_noise_is_a_mean_at_first_and_then_forgotten() -> None:
    noise = NoiseSpectrum(1, 50.0)
    noise.learn(np.concatenate([np.full((1, 1, 129), k) for k in (1.0, 2.0, 3.0)], axis=1))
    np.testing.assert_allclose(noise.mean, 2.0)
    noise.learn(np.full((1, 1000, 129), 7.0))
    np.testing.assert_allclose(noise.mean, 7.0, rtol=1e-6)


# --- settings -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("audio", "says"),
    [({"rate_hz": 16000}, "needs audio.rate_hz = 10000"), ({"hop": 256}, "multiples of 512, not 256")],
)
def test_what_the_networks_cannot_hear_is_refused(audio: dict, says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        from_table({"denoise": {"kind": "wave"}, "audio": audio})
    assert from_table({"audio": audio}).denoise.kind == "none"


@pytest.mark.parametrize("estimator", ["far-field", "hyperbolic", "model:tdoa-mlp"])
def test_a_mask_is_for_the_estimator_that_weighs(estimator: str) -> None:
    with pytest.raises(SettingsError, match=r"'mask' needs bearing\.estimator = 'steered'"):
        from_table({"denoise": {"kind": "mask"}, "bearing": {"estimator": estimator}})


def test_one_microphone_more_is_the_same_network() -> None:
    positions = [[0.05, 0.05, 0], [0.05, -0.05, 0], [-0.05, -0.05, 0], [-0.05, 0.05, 0]]
    four = from_table({"array": {"positions_m": positions}, "audio": {"channel_map": [0, 1, 2, 3]}})
    sound = rotors(4 * CHUNK, 1)
    (first, *_) = frames(np.concatenate([sound, sound[:1]]))
    clean = WaveDenoiser(replace(four, denoise=replace(four.denoise, kind="wave")))(first).samples
    np.testing.assert_allclose(clean[3], clean[0], atol=1e-6)
    assert isinstance(four, Settings)
