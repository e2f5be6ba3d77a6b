"""What weights may do to the bearing, and what they may not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import cut, heard

from locagen_edge.geometry import direction, wrap
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.propagation import plane_wave
from locagen_edge.sim.scene import Scene
from locagen_edge.stages.bearing.steered import SteeredLocator
from locagen_edge.types import F32, Bearing, Estimate, Mask, Tdoa

SETTINGS = from_table({})
ALIKE = from_table({"steered": {"weigh": False}})
"""all bins count alike, unless a mask says otherwise"""
RATE_HZ = SETTINGS.audio.rate_hz
NO_DELAYS = Tdoa(np.full(3, np.nan), np.full(3, np.inf), np.zeros(3))
FREQUENCY_HZ = np.fft.rfftfreq(SETTINGS.audio.frame, 1.0 / RATE_HZ)
LOW, HIGH = 1.0, -1.0
"""azimuths of the caller below 2 kHz and of the one above 2.5 kHz"""


def two_callers() -> F32:
    """(3, n): two seconds of noise, then both callers, the lower one louder by 6 dB."""
    rng = np.random.default_rng(1)
    n = 3 * RATE_HZ
    sound = 0.01 * rng.standard_normal((3, n))
    spectrum = np.fft.rfft(rng.standard_normal(n))
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    for azimuth, inside, gain in ((LOW, f < 2000.0, 0.2), (HIGH, (f > 2500.0) & (f < 4500.0), 0.1)):
        call = np.fft.irfft(spectrum * inside, n)
        call[: 2 * RATE_HZ] = 0.0
        u = direction(azimuth, -0.3)
        sound += gain * plane_wave(call, RATE_HZ, SETTINGS.mic_array.positions_m, u, SETTINGS.speed_m_s)
    return sound.astype(np.float32)


def located(weight: F32 | None, settings: Settings = ALIKE) -> Bearing:
    """The strongest in the last frame."""
    locate = SteeredLocator(settings)
    for frame in cut(SETTINGS, two_callers()):
        mask = None if weight is None else Mask(frame.t_ns, weight, weight[np.newaxis], 0.0)
        best = locate(frame, NO_DELAYS, SETTINGS.hop_s, mask)[0]
        locate.settle(best.evidence is not None and best.evidence.ratio >= SETTINGS.detection.evidence)
    return best


def error_deg(bearing: Bearing, azimuth: float) -> float:
    assert bearing.azimuth_rad is not None
    return abs(math.degrees(wrap(bearing.azimuth_rad - azimuth)))


def test_the_mask_says_whose_bins_they_are() -> None:
    ones = np.ones(len(FREQUENCY_HZ), dtype=np.float32)
    assert error_deg(located(None), LOW) < 3.0
    assert error_deg(located(ones), LOW) < 3.0
    assert error_deg(located((FREQUENCY_HZ > 2300.0).astype(np.float32)), HIGH) < 3.0


def test_a_mask_of_ones_changes_nothing_and_one_of_zeros_hides_nothing() -> None:
    plain = located(None)
    for weight in (1.0, 0.0):
        masked = located(np.full(len(FREQUENCY_HZ), weight, dtype=np.float32))
        assert masked.azimuth_rad == pytest.approx(plain.azimuth_rad, abs=1e-6)
        assert masked.evidence == plain.evidence
    ones = located(np.ones(len(FREQUENCY_HZ), dtype=np.float32), SETTINGS)
    plain = located(None, SETTINGS)
    assert (ones.azimuth_rad, ones.evidence) == (plain.azimuth_rad, plain.evidence)


def test_less_is_known_from_fewer_bins() -> None:
    half = located((FREQUENCY_HZ < 1000.0).astype(np.float32))
    assert half.azimuth_sigma_rad > located(None).azimuth_sigma_rad


def heard_by(settings: Settings, sound: F32) -> list[Estimate]:
    pipeline = Pipeline(settings)
    return [pipeline.process(frame) for frame in cut(settings, sound)]


def with_frame_scores(settings: Settings, sound: F32) -> tuple[list[Estimate], list[F32]]:
    pipeline = Pipeline(settings)
    pairs = [(pipeline.process(frame), pipeline._locate.frame_scores()) for frame in cut(settings, sound)]
    return [estimate for estimate, _ in pairs], [scores for _, scores in pairs if scores is not None]


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_no_weights_make_a_call_or_hide_one(kind: str) -> None:
    """Rotors for 10 s, then a second of screaming at -10 dB: all that decides is the same to the bit."""
    scene = from_table({"sim": {"call_s": 1.0, "pause_s": 9.0, "snr_db": -10.0, "turn_deg_s": 0.0}})
    sound = Scene(scene).render(22 * RATE_HZ)
    plain, plain_scores = with_frame_scores(ALIKE, sound)
    weighed, scores = with_frame_scores(from_table({"denoise": {"kind": kind}}), sound)
    assert [e.bearing.evidence for e in weighed] == [e.bearing.evidence for e in plain]
    assert [e.detection for e in weighed] == [e.detection for e in plain]
    np.testing.assert_array_equal(scores, plain_scores)
    assert any(e.detection.call for e in plain[200:])
    if kind == "none":  # the mask may leave too little to place anybody by
        assert [e.bearing.azimuth_rad for e in weighed] != [e.bearing.azimuth_rad for e in plain]


def test_noise_that_comes_from_elsewhere_and_is_no_louder_is_nobodys_call() -> None:
    """Learnt above 2.5 kHz from one side, it comes from the other while somebody calls below 2 kHz."""
    rng = np.random.default_rng(3)
    n = 4 * RATE_HZ
    spectrum = np.fft.rfft(rng.standard_normal(n))
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    calling = np.arange(n) >= 3 * RATE_HZ
    sound = 0.003 * rng.standard_normal((3, n))
    high, low = (np.fft.irfft(spectrum * inside, n) for inside in ((f > 2500.0) & (f < 4500.0), f < 2000.0))
    for azimuth, part in (
        (2.5, 0.05 * high * ~calling),
        (HIGH, 0.05 * high * calling),
        (LOW, 0.01 * low * calling),
    ):
        u = direction(azimuth, -0.3)
        sound += plane_wave(part, RATE_HZ, SETTINGS.mic_array.positions_m, u, SETTINGS.speed_m_s)
    for settings, place in ((ALIKE, HIGH), (SETTINGS, LOW)):
        told = heard_by(settings, sound.astype(np.float32))[-1]
        assert told.detection.call
        assert error_deg(told.bearing, place) < 3.0


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_a_loud_caller_is_where_he_is(kind: str) -> None:
    rng = np.random.default_rng(2)
    call = heard(SETTINGS, 0.7, -0.3, 15.0, RATE_HZ)
    noise = 0.01 * rng.standard_normal((3, 3 * RATE_HZ)).astype(np.float32)
    last = heard_by(from_table({"denoise": {"kind": kind}}), np.concatenate([noise, call], axis=1))[-1]
    assert last.detection.call
    assert error_deg(last.bearing, 0.7) < 3.0


def test_a_denoiser_comes_and_goes_in_flight() -> None:
    """Changed between two frames, it says from then on what it would have said from the beginning."""
    sound = heard(SETTINGS, 0.7, -0.3, 15.0, 2 * RATE_HZ)
    by_wave = {"denoise": {"kind": "wave"}, "bearing": {"estimator": "far-field"}}
    plain, wave = from_table(by_wave | {"denoise": {"kind": "none"}}), from_table(by_wave)
    pipeline, always = Pipeline(plain), Pipeline(wave)
    for frame in cut(SETTINGS, sound[:, :RATE_HZ]):
        pipeline.process(frame)
    pipeline.apply(wave)
    for frame in cut(SETTINGS, sound[:, RATE_HZ:]):
        changed, fresh = pipeline.process(frame), always.process(frame)
    np.testing.assert_array_equal(changed.tdoa.delay_s, fresh.tdoa.delay_s)
    pipeline.apply(plain)
    last = pipeline.process(frame)
    np.testing.assert_array_equal(last.tdoa.delay_s, Pipeline(plain).process(frame).tdoa.delay_s)
