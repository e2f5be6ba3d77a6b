"""Laws of the steered search: what it computes, what it finds, how well, and what it does with bad input.

The float64 reference is `reference_steered.py`. Fields are exact: plane waves delayed in frequency.
"""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_steered import Reference

from locagen_edge.errors import KernelError
from locagen_edge.geometry import direction, equilateral, wrap
from locagen_edge.kernel import Source, Steered

RATE, FRAME, SPEED = 10_000.0, 1024, 343.0
TRIANGLE = equilateral().positions_m
PYRAMID = np.vstack([TRIANGLE, [0.0, 0.0, -0.08]])
FIELD: dict[str, Any] = {"frame": FRAME, "rate_hz": RATE, "speed_m_s": SPEED}


def steered(positions: np.ndarray = TRIANGLE, **changes: Any) -> Steered:
    return Steered(positions, **(FIELD | changes))


def wave(
    rng: np.random.Generator,
    azimuth: float,
    elevation: float = 0.0,
    positions: np.ndarray = TRIANGLE,
    *,
    level: float = 0.1,
    band_hz: tuple[float, float] = (300.0, 4000.0),
    frame: int = FRAME,
) -> np.ndarray:
    """One frame of white noise in a band as a plane wave, rms `level`: four frames long, so nothing wraps."""
    f = np.fft.rfftfreq(4 * frame, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(4 * frame)) * ((f >= band_hz[0]) & (f <= band_hz[1]))
    early = positions @ direction(azimuth, elevation) / SPEED
    heard = np.fft.irfft(spectrum * np.exp(2j * np.pi * f * early[:, None]))[:, frame : 2 * frame]
    return level * heard / np.sqrt(np.mean(heard**2))


def hiss(rng: np.random.Generator, mics: int = 3, level: float = 0.01, frame: int = FRAME) -> np.ndarray:
    return level * rng.standard_normal((mics, frame))


def listen(found: Steered, samples: np.ndarray) -> int:
    return found.listen(samples.astype(np.float32))[1]


def learn(found: Steered, frames: list[np.ndarray]) -> None:
    for n, samples in enumerate(frames):
        listen(found, samples)
        found.learn(1 / (n + 1))


def heard(found: Steered, samples: np.ndarray, most: int = 1) -> tuple[Source, ...]:
    listen(found, samples)
    found.hear()
    return found.search(most)


def apart(source: Source, azimuth: float, elevation: float = 0.0) -> float:
    """Degrees on the sphere."""
    u = direction(source.azimuth_rad, source.elevation_rad) @ direction(azimuth, elevation)
    return math.degrees(math.acos(min(1.0, u)))


@st.composite
def configurations(draw: st.DrawFn) -> tuple[np.ndarray, dict[str, Any]]:
    mics = draw(st.integers(2, 8))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    positions = rng.uniform(-0.07, 0.07, (mics, 3))
    if draw(st.booleans()):
        positions[:, 2] = 0.02  # flat and level
    if draw(st.integers(0, 9)) == 0:
        positions[:, 1] = 0.0
    frame = 2 ** draw(st.integers(8, 11))
    low = draw(st.sampled_from([150.0, 300.0, 1000.0]))
    changes = FIELD | {
        "frame": frame,
        "band_hz": (low, low + draw(st.sampled_from([500.0, 2000.0, 3700.0]))),
        "taper": draw(st.sampled_from([0.0, 0.125, 0.5, 1.0])),
        "smooth_bins": draw(st.integers(0, 12)),
        "loading": draw(st.sampled_from([1e-4, 1e-3, 0.1])),
        "smear": draw(st.sampled_from([0.0, 0.03, 1.0])),
    }
    return positions, changes


@settings(max_examples=60, deadline=None)
@given(configurations(), st.integers(0, 2**32 - 1))
def test_agrees_with_the_reference(configuration: tuple[np.ndarray, dict[str, Any]], seed: int) -> None:
    positions, changes = configuration
    mics, frame = len(positions), changes["frame"]
    rng = np.random.default_rng(seed)
    reference, found = Reference(positions, **changes), steered(positions, **changes)
    assert found.first_bin == reference.k[0]
    assert len(found.frequency_hz) == len(reference.k)

    noise, weight, variance = np.zeros((len(reference.k), mics, mics), complex), 0.0, 0.0
    rumble = rng.uniform(0, 2 * np.pi)
    for share in (0.5, 0.2, 0.3, 0.3):
        samples = hiss(rng, mics, 0.02, frame) + wave(rng, rumble, -0.3, positions, level=0.05, frame=frame)
        samples = samples.astype(np.float32)
        assert listen(found, samples) == 0
        found.learn(share)
        bins = reference.bins(samples)
        # Rounding of a float32 FFT, beside the largest bin.
        np.testing.assert_allclose(found.bins(), bins, atol=3e-6 * np.abs(bins).max())
        noise = (1 - share) * noise + share * reference.cross(bins)
        weight = (1 - share) * weight + share
        variance = (1 - share) ** 2 * variance + share**2
    noise /= weight
    reference.noise_looks = reference.looks * weight**2 / variance
    np.testing.assert_allclose(found.noise(), noise, atol=1e-5 * np.abs(noise).max())

    # Strong enough for one clear maximum over the whole sphere.
    call = wave(rng, rng.uniform(0, 6.3), rng.uniform(-1.5, 0), positions, level=0.5, frame=frame)
    samples = (call + hiss(rng, mics, 0.02, frame)).astype(np.float32)
    (best,) = heard(found, samples)
    signal, loaded = reference.cross(reference.bins(samples)), reference.loaded(noise)
    # Rounding of squares of float32 bins, in bins that the window leaves nearly empty.
    np.testing.assert_allclose(found.gain(), reference.gain(signal, noise), atol=2e-3)
    score = reference.at(signal, loaded, best.azimuth_rad, best.elevation_rad)
    # float32 through two inverses; a null as deep as the loading loses that much of its digits.
    tolerance = max(1e-3, 4e-6 / changes["loading"])
    assert best.score == pytest.approx(score, rel=tolerance)
    # No direction of many is better, neither near nor far, by more than Newton's last step is worth.
    for _ in range(100):
        azimuth, elevation = rng.uniform(0, 2 * np.pi), math.asin(rng.uniform(-1, 0))
        assert reference.at(signal, loaded, azimuth, elevation) <= score * (1 + tolerance) + 0.1
        azimuth = best.azimuth_rad + rng.uniform(-0.05, 0.05)
        elevation = min(0.0, best.elevation_rad + rng.uniform(-0.05, 0.05))
        assert reference.at(signal, loaded, azimuth, elevation) <= score * (1 + tolerance) + 0.1


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([TRIANGLE, PYRAMID]))
def test_the_map_is_the_score_on_its_grid(seed: int, positions: np.ndarray) -> None:
    rng = np.random.default_rng(seed)
    samples = [hiss(rng, len(positions), 0.03) for _ in range(20)]
    samples.append(wave(rng, rng.uniform(0, 6.3), rng.uniform(-1.5, 0), positions) + samples[0])
    for smooth_bins in (0, 6):
        changes = FIELD | {"smooth_bins": smooth_bins}
        found, reference = steered(positions, **changes), Reference(positions, **changes)
        learn(found, samples[:-1])
        reference.noise_looks = reference.looks * len(samples[:-1])
        heard(found, samples[-1])
        scores = found.map()
        assert scores.shape == (len(found.elevation_rad), len(found.azimuth_rad))
        signal = reference.cross(reference.bins(samples[-1].astype(np.float32)))
        noise = reference.loaded(found.noise())
        expected = np.array(
            [
                [reference.at(signal, noise, float(a), float(e)) for a in found.azimuth_rad[::5]]
                for e in found.elevation_rad
            ]
        )
        # Without smoothing the grid has all bins: float32's rounding. With 6 bins each side, four bins are
        # added up under one denominator, of a matrix from 20 frames, and the average holds 12 bins, not 13.
        tolerance = 2e-4 if smooth_bins == 0 else 0.1
        np.testing.assert_allclose(scores[:, ::5], expected, atol=tolerance * expected.max())


@pytest.mark.parametrize("azimuth_deg", [0.0, 31.0, 90.0, 180.0, 233.0, 359.9])
@pytest.mark.parametrize("elevation_deg", [-10.0, -45.0, -80.0])
def test_signs_and_angles(azimuth_deg: float, elevation_deg: float) -> None:
    """A microphone nearer to the source hears earlier; FRD, clockwise, elevation positive up."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    for positions in (TRIANGLE, PYRAMID, TRIANGLE + np.array([1.0, -2.0, 0.5])):
        rng = np.random.default_rng(5)
        samples = wave(rng, azimuth, elevation, positions) + hiss(rng, len(positions), 0.001)
        (source,) = heard(steered(positions), samples)
        # 40 dB: hundredths of a degree, a tenth where the plane sees the elevation at a grazing angle.
        assert apart(source, azimuth, elevation) < 0.3
        assert -math.pi <= source.azimuth_rad <= math.pi
        assert source.score > 1e4


def test_above_and_below() -> None:
    """A flat array takes the lower of two mirror images, one in space knows."""
    rng = np.random.default_rng(1)
    up = math.radians(40)
    (source,) = heard(steered(), wave(rng, 1.0, up) + hiss(rng, level=0.001))
    assert apart(source, 1.0, -up) < 0.3
    (source,) = heard(steered(PYRAMID), wave(rng, 1.0, up, PYRAMID) + hiss(rng, 4, 0.001))
    assert apart(source, 1.0, up) < 0.3


def test_a_tilted_flat_array_means_the_lower_image() -> None:
    rng = np.random.default_rng(2)
    tilt = math.radians(20)
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    positions = TRIANGLE @ turn.T
    for azimuth, elevation in ((0.0, -0.8), (2.0, -0.5), (math.pi, -1.2)):
        samples = wave(rng, azimuth, elevation, positions) + hiss(rng, level=0.001)
        (source,) = heard(steered(positions), samples)
        assert apart(source, azimuth, elevation) < 0.3


@pytest.mark.parametrize("positions", [TRIANGLE, PYRAMID])
def test_straight_below_and_on_the_rim(positions: np.ndarray) -> None:
    mics = len(positions)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        for elevation in (-math.pi / 2, 0.0):
            samples = wave(rng, 0.7, elevation, positions) + hiss(rng, mics, 0.003)
            (source,) = heard(steered(positions), samples)
            assert np.isfinite([source.azimuth_rad, source.elevation_rad, *source.information]).all()
            assert np.isfinite(source.sigma_rad()).all()
            if elevation:
                assert apart(source, 0.7, elevation) < 1.0
            else:
                assert abs(wrap(source.azimuth_rad - 0.7)) < math.radians(0.5)
                # cos(elevation) is what a flat array measures: 8 degrees are one hundredth of it.
                assert abs(source.elevation_rad) < math.radians(8)


def test_noise_alone_scores_low_and_a_call_high() -> None:
    rng = np.random.default_rng(3)
    found = steered()
    learn(found, [hiss(rng) for _ in range(100)])
    alone = [source.score for _ in range(100) for source in heard(found, hiss(rng))]
    with_call = [
        source.score
        for _ in range(20)
        for source in heard(found, hiss(rng) + wave(rng, 1.0, level=0.005))  # -6 dB
    ]
    assert len(with_call) == 20
    # Measured 10 to 31, and 100 to 170.
    assert max(alone) < 50 < 80 < min(with_call)


def test_white_noise_of_unknown_level() -> None:
    """Nothing learnt: level and direction from the frame itself."""
    rng = np.random.default_rng(4)
    for level in (1e-4, 1e-2, 1.0):
        (source,) = heard(steered(), wave(rng, -2.0, -0.5, level=10 * level) + hiss(rng, level=level))
        assert apart(source, -2.0, -0.5) < 2.0
        # The bins' mean over 300-4700 Hz, and noise that reaches to 5 kHz: 20 dB and 5000 / 4400.
        assert 10 * math.log10(source.snr) == pytest.approx(20.6, abs=1.0)
    (source,) = heard(steered(), wave(rng, -2.0, -0.5))  # no noise at all
    assert apart(source, -2.0, -0.5) < 0.1


def test_the_number_of_frames_sharpens() -> None:
    """Four frames hold four times the information, overlapping ones less, and the score grows alike."""
    rng = np.random.default_rng(5)
    frames = [hiss(rng, level=0.1) + wave(rng, 1.0, -0.6) for _ in range(4)]
    values = []
    for hop, count in ((0, 1), (0, 4), (512, 4)):
        found = steered(hop=hop)
        learn(found, [hiss(rng, level=0.1) for _ in range(100)])
        for n, samples in enumerate(frames[:count]):
            listen(found, samples)
            found.hear(1 / (n + 1))
        (source,) = found.search()
        values.append((source.score, source.information[0]))
    one, four, overlapping = np.array(values)
    assert 3 < four[0] / one[0] < 5  # the frames' own spread at 0 dB
    assert 3 < four[1] / one[1] < 5
    # 1 + 2 * 3/4 * coherence^2 looks less; a quarter for windows that are nearly rectangular.
    np.testing.assert_allclose(overlapping / four, 1 / 1.35, rtol=0.05)


def test_a_strong_interferer_is_whitened_away() -> None:
    """A coherent noise 15 dB over the call, from elsewhere, learnt before."""
    rng = np.random.default_rng(6)
    loud = 0.1 * 10 ** (15 / 20)
    for trial in range(20):
        azimuth = rng.uniform(0, 2 * math.pi)
        other = azimuth + rng.choice([-1, 1]) * rng.uniform(1.2, 3.0)
        found = steered()
        learn(found, [wave(rng, other, -0.1, level=loud) + hiss(rng) for _ in range(60)])
        samples = wave(rng, azimuth, -0.4) + wave(rng, other, -0.1, level=loud) + hiss(rng)
        (source,) = heard(found, samples)
        assert abs(wrap(source.azimuth_rad - azimuth)) < math.radians(3), trial
        (without,) = heard(steered(), samples)
        assert abs(wrap(without.azimuth_rad - other)) < math.radians(20)


def test_two_sources() -> None:
    """Their directions are fitted together, their scores are those of one after the other."""
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(20):
        first = rng.uniform(0, 2 * math.pi)
        second = first + rng.uniform(1.4, 2 * math.pi - 1.4)
        found = steered()
        learn(found, [hiss(rng) for _ in range(60)])
        samples = wave(rng, first, -0.5) + wave(rng, second, -0.4, level=0.06) + hiss(rng)
        sources = heard(found, samples, 5)
        assert len(sources) == 2
        errors.append((abs(wrap(sources[0].azimuth_rad - first)), abs(wrap(sources[1].azimuth_rad - second))))
        assert sources[0].score == found.search(1)[0].score
        # The second alone: what nulling leaves of the first, and noise.
        (only, rest) = heard(found, wave(rng, first, -0.5) + hiss(rng), 2)
        assert rest.score < 0.02 * only.score
    # 20 and 16 dB over the hiss: measured medians 0.07 and 0.1 degrees. The worst is about 0.5.
    assert (np.degrees(np.median(errors, axis=0)) < 0.2).all()
    assert np.degrees(np.max(errors)) < 2


@pytest.mark.parametrize("snr_db", [0, 10, 20, 30, 40])
def test_asking_for_a_second_source_harms_the_first_little(snr_db: int) -> None:
    rng = np.random.default_rng(21)
    level = 0.1 * 10 ** (-snr_db / 20)
    errors: dict[int, list[float]] = {1: [], 2: []}
    found = steered()
    learn(found, [hiss(rng, level=level) for _ in range(100)])
    for _ in range(50):
        azimuth = rng.uniform(0, 2 * math.pi)
        heard(found, wave(rng, azimuth, -0.5) + hiss(rng, level=level))
        for most, values in errors.items():
            values.append(abs(wrap(found.search(most)[0].azimuth_rad - azimuth)))
    # Mostly to the last bit; a few times of fifty the second is taken for sure.
    assert np.mean(errors[2]) <= 1.3 * np.mean(errors[1])


def test_silence_and_what_was_learnt_from_it() -> None:
    silence = np.zeros((3, FRAME))
    rng = np.random.default_rng(8)
    found = steered()
    assert found.search() == ()
    assert not found.map().any()
    assert heard(found, silence) == ()
    assert not found.map().any()
    found.learn(0.5)
    assert not found.noise().any()
    assert heard(found, silence) == ()
    # R_n is nothing but its floor.
    (source,) = heard(found, wave(rng, 2.0, -0.7))
    assert apart(source, 2.0, -0.7) < 0.5
    assert np.isfinite([source.score, source.snr, *source.information]).all()


@pytest.mark.parametrize("loading", [1e-5, 1e-3, 0.01])
@pytest.mark.parametrize("positions", [TRIANGLE, PYRAMID, np.vstack([PYRAMID, PYRAMID * 1.7])])
def test_a_singular_noise_matrix(loading: float, positions: np.ndarray) -> None:
    """Learnt from one frame: of rank one in every bin."""
    rng = np.random.default_rng(9)
    mics = len(positions)
    found = steered(positions, loading=loading)
    listen(found, wave(rng, 0.5, -0.2, positions))
    found.learn(0.1)
    (source,) = heard(found, wave(rng, 3.0, -0.7, positions) + hiss(rng, mics, 0.001))
    assert np.isfinite([source.score, source.snr, *source.information]).all()
    assert apart(source, 3.0, -0.7) < 3.0


@pytest.mark.parametrize("scale", [1e-9, 1e-2, 1e3])
def test_scale_has_no_effect(scale: float) -> None:
    rng = np.random.default_rng(10)
    noise = [hiss(rng) for _ in range(30)]
    call = wave(rng, 1.0, -0.5) + hiss(rng)
    results = []
    for factor in (1.0, scale):
        found = steered(floor=1e-15)
        learn(found, [factor * samples for samples in noise])
        results.append(heard(found, factor * call))
    if scale < 1e-7:
        assert results[1] == ()  # under the floor
    else:
        assert results[1][0].score == pytest.approx(results[0][0].score, rel=1e-3)
        assert apart(results[1][0], results[0][0].azimuth_rad, results[0][0].elevation_rad) < 0.03


@pytest.mark.parametrize("fault", [np.nan, np.inf, -np.inf, 1e9, 1e30, 0.0, 1e-7])
@pytest.mark.parametrize("mic", [0, 1, 3])
def test_a_faulty_microphone_is_left_out(fault: float, mic: int) -> None:
    """Bad or dead, from the start or from now on: three good ones of four find the source as three would."""
    rng = np.random.default_rng(11)
    flat = np.vstack([TRIANGLE, [0.05, 0.05, 0.0]])
    noise = [hiss(rng, 4) for _ in range(20)]
    call = wave(rng, 1.0, -0.6, flat) + hiss(rng, 4)

    def broken(samples: np.ndarray) -> np.ndarray:
        samples = samples.copy()
        if abs(fault) < 1:
            samples[mic] = fault * rng.standard_normal(FRAME)
        else:
            samples[mic, 77] = fault
        return samples

    others = [m for m in range(4) if m != mic]
    three = steered(flat[others])
    learn(three, [samples[others] for samples in noise])
    (expected,) = heard(three, call[others])
    mask = 1 << mic if not abs(fault) < 1 else 0
    for from_the_start in (True, False):
        found = steered(flat)
        learn(found, [broken(samples) if from_the_start else samples for samples in noise])
        power, bad = found.listen(broken(call).astype(np.float32))
        assert bad == mask
        assert (power[mic] == 0) == bool(mask) or fault == 0
        found.hear()
        (source,) = found.search()
        # Another order of sums; from now on: the matrix of three within that of four.
        assert apart(source, expected.azimuth_rad, expected.elevation_rad) < 0.02
        assert source.score == pytest.approx(expected.score, rel=1e-3)
        # Healthy again, and nothing lingers.
        listen(found, call)
        found.hear()
        if not from_the_start:
            fresh = steered(flat)
            learn(fresh, noise)
            assert found.search() == heard(fresh, call)


def test_no_two_microphones_no_source() -> None:
    rng = np.random.default_rng(12)
    samples = hiss(rng)
    samples[:2, 5] = np.nan
    found = steered()
    assert listen(found, samples) == 3
    found.hear()
    assert found.search() == ()
    samples[:] = np.nan
    assert listen(found, samples) == 7
    found.hear()
    found.learn(0.3)
    assert found.search() == ()
    assert not found.bins().any()
    assert np.isfinite(found.noise()).all()


def test_two_microphones_measure_a_cone() -> None:
    rng = np.random.default_rng(13)
    positions = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    (source,) = heard(steered(positions), wave(rng, 1.0, 0.0, positions) + hiss(rng, 2, 0.001), 3)
    u = direction(source.azimuth_rad, source.elevation_rad)
    assert u[0] == pytest.approx(math.cos(1.0), abs=2e-3)
    assert max(source.sigma_rad()) > 0.5


def test_reset_forgets() -> None:
    rng = np.random.default_rng(14)
    frames = [hiss(rng) for _ in range(5)]
    call = wave(rng, 1.0, -0.5) + hiss(rng)
    found, fresh = steered(hop=512), steered(hop=512)
    learn(found, frames)
    heard(found, call, 2)
    found.reset()
    assert found.search() == ()
    assert not found.bins().any()
    assert not found.noise().any()
    assert heard(found, call, 2) == heard(fresh, call, 2)
    np.testing.assert_array_equal(found.map(), fresh.map())


def test_order_and_repetition() -> None:
    """Equal weights make a plain mean, whatever the order; a search changes nothing; share 0 neither."""
    rng = np.random.default_rng(15)
    frames = [hiss(rng) + wave(rng, 1.0, -0.5, level=0.02) for _ in range(6)]
    results = []
    for order in (range(6), range(5, -1, -1)):
        found = steered()
        for n, at in enumerate(order):
            listen(found, frames[at])
            found.hear(1 / (n + 1))
        (source,) = found.search()
        assert found.search() == (source,)
        listen(found, 100 * frames[0])
        found.hear(0.0)
        found.learn(0.0)
        assert found.search() == (source,)
        results.append(source)
    assert apart(results[0], results[1].azimuth_rad, results[1].elevation_rad) < 0.02
    assert results[0].score == pytest.approx(results[1].score, rel=1e-4)
    # share 1 forgets all before
    listen(found, frames[3])
    found.hear(1.0)
    assert found.search() == heard(steered(), frames[3])


def test_permuted_microphones_change_nothing() -> None:
    rng = np.random.default_rng(16)
    positions = rng.uniform(-0.06, 0.06, (6, 3))
    samples = wave(rng, 2.0, -0.4, positions) + hiss(rng, 6, 0.02)
    (plain,) = heard(steered(positions), samples)
    order = [3, 5, 0, 1, 4, 2]
    (permuted,) = heard(steered(positions[order]), samples[order])
    assert apart(permuted, plain.azimuth_rad, plain.elevation_rad) < 0.02
    assert permuted.score == pytest.approx(plain.score, rel=1e-4)


def bound_rad(snr: float) -> float:
    """Cramer-Rao bound of the azimuth at elevation 0: white source in 300-4000 Hz, white noise, one frame.

    `J = sum_k 2 M s^2 / (1 + M s) (2 pi f_k)^2 d^2 / (2 c^2)`, s the SNR in bin k; snr is that over 0-5 kHz.
    """
    f = np.arange(FRAME // 2 + 1) * RATE / FRAME
    f = f[(f >= 300) & (f <= 4000)]
    s = snr * 5000 / 3700
    terms = 2 * 3 * s**2 / (1 + 3 * s) * (2 * np.pi * f) ** 2 * 0.1**2 / (2 * SPEED**2)
    return 1 / math.sqrt(float(terms.sum()))


@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize("taper", [0.1, 1.0])
@pytest.mark.parametrize("snr_db", [0, 10, 20, 30])
def test_accuracy_against_the_bound_and_its_own_sigma(snr_db: int, taper: float, learnt: bool) -> None:
    rng = np.random.default_rng(snr_db)
    level = 0.1 * 10 ** (-snr_db / 20)
    found = steered(taper=taper)
    if learnt:
        learn(found, [hiss(rng, level=level) for _ in range(600)])  # 200 would cost another 5 %
    errors, shares = [], []
    for _ in range(400):
        azimuth = rng.uniform(0, 2 * math.pi)
        (source,) = heard(found, wave(rng, azimuth) + hiss(rng, level=level))
        errors.append(abs(wrap(source.azimuth_rad - azimuth)))
        shares.append(errors[-1] / source.sigma_rad()[0])
    # The mean of 400 has a spread of 4 %; tapering costs sqrt(N sum w^4) / sum w^2: 1.027, Hann 1.39.
    cost = 1 / math.sqrt(Reference(TRIANGLE, **(FIELD | {"taper": taper})).looks)
    assert np.mean(errors) <= 1.17 * cost * math.sqrt(2 / math.pi) * bound_rad(10 ** (snr_db / 10))
    # 68 % of a normal distribution, and its spread over 400 draws, 2.3 %.
    assert 0.60 <= np.mean(np.array(shares) < 1) <= 0.76


@pytest.mark.parametrize("snr_db", [0, 10, 20])
@pytest.mark.parametrize("positions", [TRIANGLE, PYRAMID])
def test_elevation_and_its_sigma(snr_db: int, positions: np.ndarray) -> None:
    rng = np.random.default_rng(20 + snr_db)
    level = 0.1 * 10 ** (-snr_db / 20)
    found = steered(positions)
    shares = []
    for _ in range(400):
        azimuth, elevation = rng.uniform(0, 2 * math.pi), -rng.uniform(0.5, 1.3)
        samples = wave(rng, azimuth, elevation, positions) + hiss(rng, len(positions), level)
        (source,) = heard(found, samples)
        sigma = source.sigma_rad()
        shares.append(
            (wrap(source.azimuth_rad - azimuth) / sigma[0], (source.elevation_rad - elevation) / sigma[1])
        )
    within = (np.abs(shares) < 1).mean(axis=0)
    assert (within >= 0.60).all()
    assert (within <= 0.76).all()


def test_results_are_new_and_the_input_is_left_alone() -> None:
    rng = np.random.default_rng(17)
    found = steered()
    samples = hiss(rng).astype(np.float32)
    before = samples.copy()
    samples.flags.writeable = False
    power, _ = found.listen(samples)
    kept = power.copy()
    found.listen(2 * samples)
    np.testing.assert_array_equal(samples, before)
    np.testing.assert_array_equal(power, kept)
    assert power.dtype == found.map().dtype == np.float32
    assert found.bins().dtype == found.noise().dtype == np.complex64


def test_power_of_a_sine_is_a_half() -> None:
    for taper in (0.0, 0.1, 1.0):
        samples = np.zeros((3, FRAME), np.float32)
        samples[1] = np.sin(2 * np.pi * 1234.5 / RATE * np.arange(FRAME))
        power, _ = steered(taper=taper).listen(samples)
        # A rectangle's side lobes fall slowly: some of the sine is heard out of the band.
        np.testing.assert_allclose(power, [0.0, 0.5, 0.0], rtol=2e-2 if taper < 1 else 1e-3)


def test_two_states_share_nothing() -> None:
    rng = np.random.default_rng(18)
    samples = wave(rng, 1.0, -0.5) + hiss(rng)
    a = steered()
    alone = heard(a, samples)
    b = steered(PYRAMID, frame=256, taper=0.7)
    heard(b, hiss(rng, 4, frame=256))
    assert heard(a, samples) == alone


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (np.zeros((3, 1024)), "float64"),
        (np.zeros((2, 1024), np.float32), r"\(2, 1024\)"),
        (np.zeros((1024, 3), np.float32).T, "contiguous"),
        (None, "float32"),
    ],
)
def test_refuses_samples_that_cffi_would_take(samples: Any, words: str) -> None:
    with pytest.raises(KernelError, match=words):
        steered().listen(samples)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"frame": 1000}, "frame"),
        ({"rate_hz": 0.0}, "rate"),
        ({"band_hz": (300.0, 5000.0)}, "band"),
        ({"hop": 127}, "hop"),
        ({"hop": -1}, "hop"),
        ({"taper": -0.1}, "taper"),
        ({"taper": 1.1}, "taper"),
        ({"taper": np.nan}, "taper"),
        ({"smooth_bins": -1}, "smooth"),
        ({"smooth_bins": 65}, "smooth"),
        ({"loading": 1e-6}, "loading"),
        ({"loading": np.nan}, "loading"),
        ({"floor": 0.0}, "floor"),
        ({"speed_m_s": 0.0}, "speed"),
        ({"speed_m_s": np.nan}, "speed"),
        ({"positions_m": np.zeros((3, 3))}, "array"),
        ({"positions_m": np.full((3, 3), np.nan)}, "array"),
        ({"positions_m": [[0, 0, 0], [0, 0, 11.0]]}, "array"),
        ({"positions_m": np.zeros((3, 2))}, "array"),
        ({"positions_m": np.zeros((1, 3))}, "microphones"),
        ({"positions_m": np.zeros((9, 3))}, "microphones"),
        ({"azimuths": 7}, "grid"),
        ({"azimuths": 721}, "grid"),
        ({"elevations": 1}, "grid"),
        ({"elevations": 181}, "grid"),
        ({"frame": 1024.0}, "configuration"),
        ({"hop": 2**40}, "configuration"),
    ],
)
def test_refuses_a_wrong_configuration_by_name(changes: dict[str, Any], word: str) -> None:
    with pytest.raises(KernelError, match=word):
        Steered(**({"positions_m": TRIANGLE} | FIELD | changes))


def test_refuses_wrong_shares_and_counts() -> None:
    found = steered()
    for share in (-0.1, 1.1, np.nan):
        with pytest.raises(KernelError, match="share"):
            found.learn(share)
        with pytest.raises(KernelError, match="share"):
            found.hear(share)
    with pytest.raises(KernelError, match="sources"):
        found.search(0)


# --- several averages, a lag, and a constant false-alarm rate


def hunting(rng: np.random.Generator, azimuth: float, loud: bool) -> np.ndarray:
    """Hiss, and a rotor from one side that is now and then much louder, in one part of the band."""
    return hiss(rng) + wave(rng, azimuth, level=0.06 if loud else 0.01, band_hz=(2000.0, 2600.0))


def listened(found: Steered, samples: np.ndarray, share: float) -> tuple[Source, ...]:
    """Noise as it flies: heard, searched, watched, learnt."""
    listen(found, samples)
    found.hear()
    sources = found.search()
    found.watch()
    found.settle(share)
    found.learn(share)
    return sources


def test_noise_that_strays_scores_no_higher_than_noise_that_keeps_still() -> None:
    """The rotor's own side and band lose their looks; a call from elsewhere, in other bands, loses little."""
    best = {}
    for watched in (False, True):
        rng = np.random.default_rng(0)
        found = steered()
        scores = []
        for n in range(300):
            samples = hunting(rng, 1.0, loud=rng.uniform() < 0.1)
            if watched:
                sources = listened(found, samples, 0.02)
            else:
                listen(found, samples)
                found.hear()
                sources = found.search()
                found.learn(0.02)
            if n >= 150:
                scores.append(sources[0].score)
        (call,) = heard(found, hunting(rng, 1.0, loud=False) + wave(rng, 3.5, -0.5, level=0.02))
        best[watched] = max(scores), call.score
        assert apart(call, 3.5, -0.5) < 3.0
    assert best[True][0] < 0.4 * best[False][0]
    assert best[True][1] > 0.6 * best[False][1]


def test_noise_that_strays_is_told_in_the_sigma() -> None:
    """A call in the band in which a rotor comes and goes is less well known, the less the louder it is."""
    wider = {}
    for level in (0.007, 0.03, 0.2):
        sigma = {}
        for watched in (False, True):
            rng = np.random.default_rng(7)
            found = steered()
            for _ in range(200):
                samples = hunting(rng, 1.0, loud=rng.uniform() < 0.1)
                if watched:
                    listened(found, samples, 0.02)
                else:
                    listen(found, samples)
                    found.learn(0.02)
            call = wave(rng, 3.5, -0.5, level=level, band_hz=(1900.0, 2700.0))
            (source,) = heard(found, hunting(rng, 1.0, loud=False) + call)
            sigma[watched] = source.sigma_rad()[0]
        wider[level] = sigma[True] / sigma[False]
    assert wider[0.007] > 1.07
    assert wider[0.007] > wider[0.03] > wider[0.2] > 0.99


def test_a_further_source_has_to_be_worth_it() -> None:
    rng = np.random.default_rng(8)
    found = steered()
    learn(found, [hiss(rng) for _ in range(60)])
    both = heard(found, wave(rng, 0.5, -0.5) + wave(rng, 3.0, -0.4, level=0.06) + hiss(rng), 2)
    assert len(both) == 2
    assert found.search(2, further=0.5 * both[1].score) == both
    assert len(found.search(2, further=1.5 * both[1].score)) == 1
    assert len(found.search(2, further=1.5 * both[0].score)) == 1
    with pytest.raises(KernelError):
        found.search(2, further=-1.0)


def test_in_still_noise_watching_changes_little() -> None:
    rng = np.random.default_rng(1)
    found, plain = steered(), steered()
    for n in range(300):
        samples = hiss(rng)
        if n < 60:  # a matrix from few frames strays more than theory says
            listen(found, samples)
            found.learn(0.01)
        else:
            listened(found, samples, 0.01)
        listen(plain, samples)
        plain.learn(0.01)
    call = hiss(rng) + wave(rng, 2.0, -0.6, level=0.02)
    (a,), (b,) = heard(found, call), heard(plain, call)
    assert a.score == pytest.approx(b.score, rel=0.15)
    assert a.azimuth_rad == pytest.approx(b.azimuth_rad, abs=math.radians(0.2))


def test_what_is_doubted_is_not_kept_in_mind() -> None:
    """A call that was watched before it was known leaves no trace, once it is doubted."""
    rng = np.random.default_rng(2)
    scores = {}
    for doubted in (False, True):
        found = steered()
        for _ in range(100):
            listened(found, hiss(rng), 0.02)
        for _ in range(3):
            listen(found, hiss(rng) + wave(rng, 2.0, -0.6, level=0.03))
            found.hear()
            found.search()
            found.watch()
        if doubted:
            found.doubt()
        found.settle(0.02)
        found.settle(0.02)
        scores[doubted] = heard(found, hiss(rng) + wave(rng, 2.0, -0.6, level=0.03))[0].score
    assert scores[False] < 0.5 * scores[True]


def test_louder_noise_is_no_source() -> None:
    rng = np.random.default_rng(3)
    found = steered()
    learn(found, [hiss(rng) for _ in range(100)])
    (louder,) = heard(found, hiss(rng, level=0.02))
    (call,) = heard(found, hiss(rng) + wave(rng, 1.0, level=0.02))
    assert louder.score > 100.0  # likely no more, by itself
    assert louder.contrast < -louder.score
    assert call.contrast > 0.0


@pytest.mark.parametrize("lag", [0, 1, 10, 64])
def test_learning_lags_and_spans_keep_apart(lag: int) -> None:
    """After n frames the noise holds those up to n - lag, and each span what it was told to hear."""
    rng = np.random.default_rng(4)
    found, plain = steered(lag=lag, spans=2), steered()
    frames = [hiss(rng) for _ in range(lag + 5)]
    for samples in frames:
        listen(found, samples)
        found.learn(0.5, lag)
        found.hear(1.0, span=0)
        found.hear(0.25, span=1)
    for samples in frames[:5]:
        listen(plain, samples)
        plain.learn(0.5)
    np.testing.assert_allclose(found.noise(), plain.noise(), rtol=1e-5, atol=1e-12)
    listen(found, hiss(rng) + wave(rng, 1.0))
    found.hear(1.0, span=0)
    found.hear(0.25, span=1)
    one, many = found.search(span=0)[0], found.search(span=1)[0]
    assert one.score != many.score


def test_weights_choose_the_bins_that_count() -> None:
    """Half of the band without weight: the answer is that of an array that never heard it."""
    rng = np.random.default_rng(5)
    whole, low = steered(), steered(band_hz=(300.0, 2000.0))
    for _ in range(60):
        samples = hiss(rng)
        for found in (whole, low):
            listen(found, samples)
            found.learn(0.05)
    whole.weigh((whole.frequency_hz <= 2000.0).astype(np.float32))
    call = hiss(rng) + wave(rng, 1.0, -0.4, level=0.02)
    (a,), (b,) = heard(whole, call), heard(low, call)
    assert a.score == pytest.approx(b.score, rel=0.03)  # the averages at the edge differ
    assert a.azimuth_rad == pytest.approx(b.azimuth_rad, abs=math.radians(0.5))
    for wrong in (np.full(len(whole.frequency_hz), 1.5), np.full(len(whole.frequency_hz), np.nan)):
        with pytest.raises(KernelError, match="weights"):
            whole.weigh(wrong.astype(np.float32))
    with pytest.raises(KernelError, match="float32"):
        whole.weigh(np.ones(3, np.float32))


@pytest.mark.parametrize("weight", [0.25, 0.7])
def test_a_weight_that_is_the_same_everywhere_makes_no_sigma_wider(weight: float) -> None:
    """Which direction and how well it is known follow from weights against each other."""
    rng = np.random.default_rng(6)
    found = steered()
    for _ in range(60):
        listen(found, hiss(rng))
        found.learn(0.05)
    call = hiss(rng) + wave(rng, 1.0, -0.4, level=0.02)
    (plain,) = heard(found, call)
    found.weigh(np.full(len(found.frequency_hz), weight, np.float32))
    (weighed,) = heard(found, call)
    assert weighed.azimuth_rad == pytest.approx(plain.azimuth_rad, abs=1e-4)
    assert weighed.sigma_rad() == pytest.approx(plain.sigma_rad(), rel=0.01)


def test_the_gain_is_what_the_call_has_of_each_bin() -> None:
    """1 - noise / power: of hiss that has become louder, and of a call in half of the band."""
    rng = np.random.default_rng(7)
    found = steered()
    np.testing.assert_array_equal(found.gain(), 1.0)
    learn(found, [hiss(rng) for _ in range(100)])
    np.testing.assert_array_equal(found.gain(), 1.0)  # nothing was heard
    for ratio in (2.0, 4.0, 100.0):
        gains = []
        for _ in range(20):
            listen(found, hiss(rng, level=0.01 * math.sqrt(ratio)))
            found.hear()
            gains.append(found.gain())
        # three microphones and thirteen bins: each power is known to 16 %, the noise to 2 %
        assert np.mean(gains) == pytest.approx(1.0 - 1.0 / ratio, abs=0.03)
        assert 0.0 <= np.min(gains) <= np.max(gains) <= 1.0
    listen(found, hiss(rng) + wave(rng, 1.0, level=0.1, band_hz=(300.0, 2000.0)))
    found.hear()
    inside = found.frequency_hz < 1900.0
    assert found.gain()[inside].min() > 0.9
    assert found.gain()[found.frequency_hz > 2500.0].mean() < 0.15
    found.reset()
    np.testing.assert_array_equal(found.gain(), 1.0)


@pytest.mark.parametrize("level", [0.0, np.nan, 1e15])
def test_the_gain_knows_no_dead_microphone(level: float) -> None:
    """The gain of the other two; where all are silent there is no call in any bin."""
    rng = np.random.default_rng(8)
    pyramid, left = steered(PYRAMID), steered(PYRAMID[[0, 1, 3]])
    for n in range(40):
        samples = hiss(rng, 4) + (wave(rng, 1.0, level=0.02, positions=PYRAMID) if n == 39 else 0.0)
        for found, mics in ((pyramid, [0, 1, 2, 3]), (left, [0, 1, 3])):
            broken = samples.copy()
            broken[2] = level
            with np.errstate(invalid="ignore"):
                listen(found, broken[mics])
            found.learn(1 / (n + 1)) if n < 39 else found.hear()
    np.testing.assert_allclose(pyramid.gain(), left.gain(), atol=1e-6)
    assert pyramid.gain().max() > 0.5
    listen(pyramid, np.zeros((4, FRAME)))
    pyramid.hear()
    gain = pyramid.gain()
    assert np.isfinite(gain).all()
    assert gain.max() <= 1.0


def test_a_narrow_sound_of_short_waves_has_rivals() -> None:
    """At 3 kHz 10 cm are 0.9 wavelengths: a whistle has several answers, a voice one."""
    rng = np.random.default_rng(6)
    found = steered()
    learn(found, [hiss(rng) for _ in range(100)])
    for azimuth in (0.3, 2.0, 4.5):
        (whistle,) = heard(found, hiss(rng) + wave(rng, azimuth, -0.4, level=0.03, band_hz=(2950.0, 3050.0)))
        (voice,) = heard(found, hiss(rng) + wave(rng, azimuth, -0.4, level=0.03, band_hz=(400.0, 2500.0)))
        assert whistle.rival > 0.93
        assert voice.rival < 0.8
