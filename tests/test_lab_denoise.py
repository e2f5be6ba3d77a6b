"""Denoisers in the workshop: what is measured, who is held out, and one small run from sounds to a model."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
import soundfile
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import to_db

from locagen_edge.errors import DatasetError, ModelError
from locagen_edge.geometry import direction
from locagen_edge.lab.denoise import bearings, evaluate, repeats, sounds
from locagen_edge.lab.denoise.callers import CALLERS
from locagen_edge.lab.denoise.cases import Case, cases, with_array
from locagen_edge.lab.denoise.mixes import Mixer, length
from locagen_edge.lab.denoise.peers import PEERS, peers, sound_of, spectra_of, wiener, wiener_plain
from locagen_edge.lab.denoise.publish import parity, publish, weights_of
from locagen_edge.lab.denoise.tune import halfway
from locagen_edge.lab.nets.mask import BINS, LOOKAHEAD, MaskNet
from locagen_edge.lab.nets.wave import STRIDE, WaveNet
from locagen_edge.lab.settings import LabSettings, read
from locagen_edge.models import default_directory, load_network
from locagen_edge.sim.levels import band_power
from locagen_edge.sim.rotors import rotor
from locagen_edge.stages.denoise import RATE_HZ

pytestmark = pytest.mark.usefixtures("few_sounds")
MOST_PARAMETERS = 100_000
NETS = {"wave": lambda: WaveNet(LabSettings().wave), "mask": lambda: MaskNet(LabSettings().mask)}


# --- the measure --------------------------------------------------------------------------------------


def pair(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    clean, noise = rng.standard_normal((2, 20_000)).astype(np.float32)
    return clean, noise - clean * float(noise @ clean / (clean @ clean))


@given(st.floats(0.01, 10.0), st.floats(0.05, 3.0))
@settings(max_examples=20)
def test_loudness_does_not_count_as_removal(scale: float, left: float) -> None:
    """Where `left` of orthogonal noise remains, SI-SDRi is -20 log10(left), at any loudness."""
    clean, noise = pair()
    sdr, improved, gain, _ = evaluate.score(clean + noise, scale * (clean + left * noise), clean)
    assert improved == pytest.approx(-20.0 * np.log10(left), abs=0.05)
    assert gain == pytest.approx(scale, rel=1e-3)
    assert sdr == pytest.approx(improved, abs=0.2)  # the input has 0 dB


def test_a_network_that_deletes_the_caller_is_found_out() -> None:
    clean, noise = pair()
    _, improved, gain, power = evaluate.score(clean + noise, 0.05 * noise, clean)
    assert power > 0.99  # "removes 99 % of the noise"
    assert abs(gain) < 0.01
    assert improved < -20.0
    _, improved, gain, _ = evaluate.score(clean + noise, np.zeros_like(clean), clean)
    assert (gain, improved) == (0.0, pytest.approx(0.0, abs=0.1))


@pytest.mark.parametrize("caller", list(CALLERS))
def test_what_cannot_be_heard_is_not_made_worse(caller: str) -> None:
    """At -40 dB under rotors nothing can be found, and then the output is the input."""
    s = LabSettings()
    rng = np.random.default_rng(5)
    made = rotor(0.5, float(s.audio.rate_hz), 4700.0, rng)
    noise = np.concatenate(list(islice(made, 8)))[:50_176].astype(np.float32)
    noise /= np.sqrt(np.mean(noise**2))
    call = CALLERS[caller](25_088, float(s.audio.rate_hz), 4700.0, rng).astype(np.float32)
    call /= np.sqrt(np.mean(call**2))
    sound, clean = Case(caller, "rotor", noise[:25_088], noise[25_088:], call).mixture(-40.0)
    inner = slice(1024, -1024)
    out = evaluate.mask_method("denoise-mask", s)(sound, 25_088)[25_088:]
    _, improved, _, _ = evaluate.score(sound[25_088:][inner], out[inner], clean[inner])
    assert improved >= evaluate.WORSE_DB


# --- networks -----------------------------------------------------------------------------------------


def test_the_first_layer_starts_as_a_frame_that_reconstructs_exactly() -> None:
    net = NETS["wave"]()
    torch.nn.init.constant_(net.leave.bias, 50.0)
    torch.nn.init.zeros_(net.leave.weight)
    sound = torch.randn(2, 20 * STRIDE)
    with torch.no_grad():
        out = net(sound, *net.start(2))[0]
    torch.testing.assert_close(out[:, STRIDE:], sound[:, :-STRIDE], atol=1e-5, rtol=0)


def test_the_waveform_network_is_causal() -> None:
    net = NETS["wave"]()
    sound = torch.randn(1, 20 * STRIDE)
    other = sound.clone()
    other[:, 10 * STRIDE :] += 1.0
    with torch.no_grad():
        a, b = (net(x, *net.start(1))[0] for x in (sound, other))
    torch.testing.assert_close(a[:, : 10 * STRIDE], b[:, : 10 * STRIDE], atol=0, rtol=0)
    assert not torch.equal(a, b)


def test_the_mask_sees_as_far_ahead_as_it_says() -> None:
    net = NETS["mask"]()
    relative = torch.rand(1, 12, BINS) + 0.5
    other = relative.clone()
    other[:, 8:] *= 3.0
    noise = torch.ones(1, BINS)
    with torch.no_grad():
        a, b = (net(x, noise, *net.start())[0] for x in (relative, other))
    # what is given at step k is the mask of k - LOOKAHEAD, and nothing after k is known
    torch.testing.assert_close(a[:, :8], b[:, :8], atol=0, rtol=0)
    assert not torch.equal(a[:, 8], b[:, 8])
    assert LOOKAHEAD == 3


@pytest.mark.parametrize("kind", list(NETS))
def test_the_file_by_chunks_is_the_network_at_once(kind: str, tmp_path) -> None:
    torch.manual_seed(1)
    net = NETS[kind]().eval()
    facts = publish(kind, net, tmp_path, LabSettings(), "- story\n")
    assert facts["parity"] < 1e-5
    assert facts["parameters"] <= MOST_PARAMETERS
    kept = weights_of(kind, tmp_path)
    assert all(torch.equal(kept[name], value) for name, value in net.state_dict().items())
    assert "story" in (tmp_path / f"{kind}.md").read_text()
    with pytest.raises(ModelError, match="no-such"):
        weights_of("no-such", tmp_path)


@pytest.mark.parametrize("kind", list(NETS))
def test_what_came_with_the_program_is_what_was_trained(kind: str) -> None:
    s = LabSettings()
    name = f"denoise-{kind}"
    net = NETS[kind]()
    net.load_state_dict(weights_of(name, default_directory()))
    assert parity(net.eval(), load_network(name, s)) < 1e-5
    assert sum(p.numel() for p in net.parameters()) <= MOST_PARAMETERS


# --- sounds and mixes ---------------------------------------------------------------------------------


def folder_of(path, count: int, seconds: float) -> None:
    for k in range(count):
        rng = np.random.default_rng(k)
        target = path / f"{k:02}.wav"
        target.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(target, 0.1 * rng.standard_normal(int(seconds * 16_000)), 16_000)


def test_no_recording_is_in_two_parts(tmp_path) -> None:
    folder_of(tmp_path / "calls" / "shout", 10, 1.0)
    folder_of(tmp_path / "noise", 6, 2.0)
    (tmp_path / "s.toml").write_text(
        f'[mixes]\ncalls = "{tmp_path / "calls"}"\nnoise = "{tmp_path / "noise"}"\nclip_s = 0.6\n'
        'before_s = 0.5\ndrones = ["0[0-4]*"]\nheld_out = ["01*", "03*"]\n'
    )
    parts = {part: sounds.corpus(read(tmp_path / "s.toml"), part) for part in sounds.PARTS}
    heard = {part: {x.tobytes() for x in c.calls["shout"]} for part, c in parts.items()}
    assert sum(len(x) for x in heard.values()) == len(set().union(*heard.values())) == 10
    assert set(parts["train"].drones) == set(parts["validate"].drones) == {"00.wav", "02.wav", "04.wav"}
    assert set(parts["test"].drones) == {"01.wav", "03.wav"}
    assert len(parts["train"].background) == 1
    assert set(CALLERS) < set(parts["train"].calls)


def test_own_noise_is_parted_or_refused() -> None:
    s = LabSettings()
    long, short = np.arange(600_000, dtype=np.float32), np.zeros(60_000, np.float32)
    ((tuned,), (held,)) = sounds.own_parts(s, [long])
    np.testing.assert_array_equal(np.concatenate([tuned, held]), long)
    assert len(held) == 150_000
    tuned_on, judged = sounds.own_parts(s, [short + k for k in range(8)])
    assert (len(tuned_on), len(judged)) == (6, 2)
    with pytest.raises(DatasetError, match="a minute is better"):
        sounds.own_parts(s, [short])


def test_mixes_have_the_snr_asked_for(small) -> None:
    s = read(small)
    corpus = sounds.corpus(s, "train")
    batch = Mixer(s, corpus, 1, 6).batch(40)
    call, mixture = batch.call.numpy(), batch.mixture.numpy()
    assert mixture.shape == (40, 3, length(s))
    calling = call.any(axis=1)
    noise = mixture - call[:, None]
    # microphone 0's noise has mean square 1: the call's tells the SNR
    np.testing.assert_allclose(np.mean(noise[:, 0] ** 2, axis=1), 1.0, rtol=1e-3)
    snr_db = 10.0 * np.log10(np.mean(call[calling] ** 2, axis=1))
    assert -15.01 <= snr_db.min() < -5.0
    assert 5.0 < snr_db.max() <= 15.01
    assert np.isfinite(batch.reference.numpy()).all()


def test_cases_are_the_same_for_everyone_and_heard_by_an_array(small) -> None:
    s = read(small)
    first, again = (list(cases(s, 1)) for _ in range(2))
    assert {c.kind for c in first} == set(CALLERS)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.mixture(3.0)[0], b.mixture(3.0)[0])
    whistle = next(c for c in first if c.kind == "whistle")
    rng = np.random.default_rng(1)
    mixture, call = with_array(whistle, s.mic_array, RATE_HZ, s.speed_m_s, np.radians(30.0), 60.0, rng)
    assert mixture.shape == (3, len(whistle.before) + len(whistle.call))
    # microphone 0 lies ahead, nearest to a caller at 30 degrees or so: it hears first
    delay = s.mic_array.delays_s(np.array([np.cos(np.radians(30.0)), 0.5, 0.0]), s.speed_m_s)
    assert_delays(call, delay, s)


def assert_delays(call: np.ndarray, delay_s: np.ndarray, s: LabSettings) -> None:
    """Phase of the cross-spectrum at its strongest bin against t_j - t_i."""
    spectra = np.fft.rfft(call, axis=1)
    at = np.abs(spectra[0]).argmax()
    hertz = at * RATE_HZ / call.shape[1]
    for (i, j), wanted in zip(s.mic_array.pairs, delay_s, strict=True):
        phase = np.angle(spectra[j, at] * np.conj(spectra[i, at]) * np.exp(2j * np.pi * hertz * wanted))
        assert abs(phase) < 0.05


def test_what_is_tuned_stays_halfway_to_what_it_was() -> None:
    base, tuned = ({"w": torch.full((2,), x)} for x in (1.0, 4.0))
    assert torch.equal(halfway(base, tuned)["w"], torch.full((2,), 2.5))
    assert torch.equal(halfway(base, base)["w"], base["w"])


# --- peers --------------------------------------------------------------------------------------------


def test_spectra_go_back_to_the_sound() -> None:
    sound = np.random.default_rng(1).standard_normal(5000).astype(np.float32)
    np.testing.assert_allclose(sound_of(spectra_of(sound), 5000), sound, atol=1e-5)


@pytest.mark.parametrize("method", [wiener, wiener_plain])
def test_wiener_helps_a_tone_in_white_noise(method) -> None:
    rng = np.random.default_rng(1)
    noise = 0.1 * rng.standard_normal(40_000).astype(np.float32)
    clean = np.zeros(40_000, np.float32)
    clean[20_000:] = 0.1 * np.sin(0.6 * np.pi * np.arange(20_000))
    out = method(noise + clean, 20_000)
    _, improved, gain, _ = evaluate.score((noise + clean)[20_000:], out[20_000:], clean[20_000:])
    assert improved > 4.0
    assert gain > 0.8


def test_packages_that_are_missing_are_named() -> None:
    found, missing = peers()
    assert set(found) | set(missing) == set(PEERS)
    assert all(why.startswith("pip install ") for why in missing.values())


def test_a_case_says_where_its_call_is() -> None:
    call = np.ones(1024, np.float32)
    one = Case("x", "y", np.zeros(512, np.float32), np.zeros(1024, np.float32), call)
    sound, clean = one.mixture(0.0)
    np.testing.assert_allclose(sound[-1024:], clean)
    assert clean[0] == pytest.approx(10.0 ** (-30.0 / 20.0))


# --- bearings -----------------------------------------------------------------------------------------


def test_sound_for_bearings_has_its_snr_and_its_direction(small) -> None:
    s = read(small)
    (event,) = bearings.events(s, 1)
    u = direction(event.azimuth_rad, bearings.ELEVATION_RAD)
    for field in bearings.FIELDS:
        noise, call = bearings.sound_of(s, event, field)
        n = len(event.call)
        assert noise.shape == call.shape
        assert not call[:, :-n].any()
        powers = [band_power(sound[:, -n:], s.audio.rate_hz) for sound in (noise, call)]
        assert to_db(powers[0]) == pytest.approx(to_db(powers[1])) == pytest.approx(bearings.LEVEL_DBFS)
    p = s.mic_array.positions_m
    assert_delays(call[:, -n:], np.array([(p[i] - p[j]) @ u for i, j in s.mic_array.pairs]) / s.speed_m_s, s)


def test_a_caller_calls_five_times_from_one_place_as_loud_each_time(small) -> None:
    s = read(small)
    (caller,) = repeats.callers(s, 1)
    noise, calls = repeats.sound_of(s, caller, "near rotors")
    rate_hz = s.audio.rate_hz
    assert noise.shape == calls.shape == (s.mic_array.mics, 70 * rate_hz)
    ends = [start + len(call) for start, call in zip(caller.starts, caller.calls, strict=True)]
    assert caller.starts[0] >= bearings.BEFORE_S * rate_hz
    assert caller.end == ends[-1] <= 70 * rate_hz
    gaps = [later - end for later, end in zip(caller.starts[1:], ends[:-1], strict=True)]
    assert len(gaps) == 4
    assert min(gaps) >= repeats.PAUSE_S * rate_hz
    u = direction(caller.event.azimuth_rad, bearings.ELEVATION_RAD)
    p = s.mic_array.positions_m
    delays_s = np.array([(p[i] - p[j]) @ u for i, j in s.mic_array.pairs]) / s.speed_m_s
    assert to_db(band_power(noise, rate_hz)) == pytest.approx(bearings.LEVEL_DBFS)
    for start, end in zip(caller.starts, ends, strict=True):
        one = calls[:, start:end]
        assert to_db(band_power(one, rate_hz)) == pytest.approx(bearings.LEVEL_DBFS)
        assert_delays(one, delays_s, s)
        calls[:, start:end] = 0.0
    assert not calls.any()


def test_the_confidence_interval_is_wilsons() -> None:
    low, high = bearings.wilson(5, 10)
    assert (low, high) == pytest.approx((0.2366, 0.7634), abs=1e-4)  # Brown, Cai & DasGupta (2001), p = 1/2
    assert bearings.wilson(0, 10)[0] == pytest.approx(0.0, abs=1e-12)
    assert bearings.wilson(10, 10)[1] == pytest.approx(1.0)
