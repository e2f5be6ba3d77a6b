"""Laws of the kernel: what it computes, where the sign points, and what it does with bad input.

The float64 reference is `reference.py`. The kernel promises 1e-4 of the peak; where a test asks for more
or less than that it says why.
"""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from reference import gcc_phat

from locagen_edge.errors import KernelError
from locagen_edge.kernel import GccPhat

TRIANGLE: dict[str, Any] = {
    # 10 cm at 10 kHz and 343 m/s: 2.9 samples, and one more each side.
    "lags": 63,
    "oversample": 16,
    "rate_hz": 10_000.0,
    "band_hz": (300.0, 4700.0),
    "floor": 1e-12,
    "relative_floor": 1e-3,
}
# What the kernel promises, as a share of the peak.
PROMISE = 1e-4


def noise(mics: int, frame: int, seed: int = 0) -> np.ndarray:
    return (0.1 * np.random.default_rng(seed).standard_normal((mics, frame))).astype(np.float32)


def delayed(delays: list[float], frame: int, seed: int = 0) -> np.ndarray:
    """One periodic noise, heard by each microphone after its delay in samples (exact, in frequency)."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(frame))
    turns = np.exp(-2j * np.pi * np.arange(frame // 2 + 1) / frame * np.array(delays)[:, None])
    return (0.1 * np.fft.irfft(spectrum * turns, frame)).astype(np.float32)


def kernel(mics: int = 3, frame: int = 1024, **changes: Any) -> GccPhat:
    return GccPhat(mics=mics, frame=frame, **(TRIANGLE | changes))


@st.composite
def configurations(draw: st.DrawFn) -> tuple[int, int, dict[str, Any]]:
    frame = 2 ** draw(st.integers(8, 12))
    rate_hz = draw(st.sampled_from([8_000.0, 10_000.0, 44_100.0, 96_000.0]))
    bin_hz = rate_hz / frame
    low = draw(st.floats(0.6, frame / 2 - 12))
    high = draw(st.floats(low + 9, frame / 2 - 0.6))
    oversample = draw(st.sampled_from([1, 2, 3, 8, 16, 64]))
    # Mostly short arrays, as flown; sometimes lags that need many blocks, or every bin.
    most = min(draw(st.sampled_from([64, 64, 200, 2000])), frame // 4 * oversample - 1)
    changes = {
        "lags": draw(st.integers(1, most)),
        "oversample": oversample,
        "rate_hz": rate_hz,
        "band_hz": (low * bin_hz, high * bin_hz),
        "floor": draw(st.sampled_from([0.0, 1e-12, 1e-7])),
        "relative_floor": draw(st.sampled_from([0.0, 1e-3, 0.1])),
    }
    return draw(st.integers(2, 8)), frame, changes


@settings(max_examples=150, deadline=None)
@given(configurations(), st.integers(0, 2**32 - 1))
def test_agrees_with_the_reference(configuration: tuple[int, int, dict[str, Any]], seed: int) -> None:
    mics, frame, changes = configuration
    samples = noise(mics, frame, seed)
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:  # a common source, with an echo that may lie outside the lags
        source = noise(1, 2 * frame, seed + 1)[0]
        for row in samples:
            at, echo = rng.integers(0, frame // 4, 2)
            row += source[at : at + frame] + np.float32(0.8) * source[at + echo : at + echo + frame]
    correlation, power, bad = kernel(mics, frame, **changes).process(samples)
    expected, expected_power = gcc_phat(samples, **changes)
    assert bad == 0
    # Where nothing in reach is coherent, the peak is what chance leaves; below 1 / bins it may be nothing
    # at all, and a share of nothing cannot be promised.
    bins = (changes["band_hz"][1] - changes["band_hz"][0]) / changes["rate_hz"] * frame
    peak = np.maximum(np.abs(expected).max(axis=1), 1 / bins)
    assert (np.abs(correlation - expected).max(axis=1) <= PROMISE * peak).all()
    # Sums of hundreds of float32 squares: a few rounding errors of 6e-8.
    np.testing.assert_allclose(power, expected_power, rtol=3e-6)


@settings(max_examples=40, deadline=None)
@given(st.integers(35, 470), st.floats(-3, 3), st.integers(0, 2**32 - 1))
def test_a_tone_agrees_with_the_reference(tone_bin: int, delay: float, seed: int) -> None:
    """Three bins hold all the power: the images of the thinned spectrum are as strong as they get."""
    time = np.arange(1024)[None, :] - np.array([[0.0], [delay], [0.3]])
    samples = np.cos(2 * np.pi * tone_bin / 1024 * time) + 1e-4 * noise(3, 1024, seed)
    samples = samples.astype(np.float32)
    correlation, _, _ = kernel().process(samples)
    expected, _ = gcc_phat(samples, **TRIANGLE)
    # The peak of such a pair is 3 of 451 bins, 0.007.
    assert np.abs(correlation - expected).max() <= PROMISE * np.abs(expected).max()


def test_two_configurations_that_differ_only_in_lags_agree_on_the_common_ones() -> None:
    samples = noise(4, 1024)
    whole, _, _ = kernel(4, lags=2000).process(samples)
    for lags in (1, 15, 16, 62, 63, 64, 126, 127, 190, 191, 1999):
        part, _, _ = kernel(4, lags=lags).process(samples)
        assert part.shape == (6, 2 * lags + 1)
        # Both within 1e-4 of peaks of about 0.15.
        np.testing.assert_allclose(part, whole[:, 2000 - lags : 2001 + lags], atol=2 * PROMISE * 0.15)


@pytest.mark.parametrize("delay", [7, -7])
def test_a_positive_lag_means_that_j_hears_later(delay: int) -> None:
    source = noise(1, 1040)[0]
    samples = np.array([source[8 : 8 + 1024], source[8 - delay : 8 - delay + 1024]])
    found = kernel(2, lags=10 * 16)
    correlation, _, _ = found.process(samples)
    assert found.pairs == ((0, 1),)
    assert found.lag_s[correlation[0].argmax()] == pytest.approx(delay / 10_000.0)


def test_every_pair_of_eight_has_its_row_and_sign() -> None:
    delays = [0.0, 1.0, 3.0, 6.0, -2.0, -5.0, 8.0, 4.5]
    found = kernel(8, lags=16 * 14)
    correlation, _, _ = found.process(delayed(delays, 1024))
    assert found.pairs == tuple(itertools.combinations(range(8), 2))
    for row, (i, j) in zip(correlation, found.pairs, strict=True):
        assert found.lag_s[row.argmax()] * 10_000.0 == pytest.approx(delays[j] - delays[i]), (i, j)


@pytest.mark.parametrize("delay", [-2.9, -1.0, -0.37, 0.0, 0.03, 0.5, 2.21])
def test_a_fraction_of_a_sample_is_found(delay: float) -> None:
    found = kernel(2)
    row = found.process(delayed([0.0, delay], 1024))[0][0]
    # The nearest grid point: half a step of 1/16 sample, and a trace for the window's own slope.
    assert abs(found.lag_s[row.argmax()] * 10_000.0 - delay) <= 0.5 / 16 + 0.002
    # 1.0, less the floor's share of the weakest bins and, between grid points, the peak's curvature.
    assert 0.97 < row.max() <= 1.0001


@pytest.mark.parametrize("mics", range(2, 9))
def test_silence_gives_zeros(mics: int) -> None:
    for floors in ({}, {"floor": 0.0}, {"floor": 0.0, "relative_floor": 0.0}):
        correlation, power, bad = kernel(mics, **floors).process(np.zeros((mics, 1024), np.float32))
        assert not correlation.any()
        assert not power.any()
        assert bad == 0


def test_noise_under_the_floor_fades() -> None:
    """1e-8 of full scale is -160 dB, each bin -187 dB: far under the floor of -120 dB."""
    correlation, _, _ = kernel(2).process(1e-7 * np.repeat(noise(1, 1024), 2, axis=0))
    # A coherent pair: p / (p + floor), with p = 1e-16 / 451 or so.
    assert np.abs(correlation).max() < 1e-5


def rows_without(found: GccPhat, mic: int) -> list[int]:
    return [row for row, pair in enumerate(found.pairs) if mic not in pair]


@pytest.mark.parametrize("mics", range(2, 9))
@pytest.mark.parametrize("fault", [0.0, np.nan, np.inf, -np.inf, 1e30])
def test_a_faulty_channel_harms_no_other_pair(mics: int, fault: float) -> None:
    found = kernel(mics)
    healthy = noise(mics, 1024)
    correlation, power, bad = found.process(healthy)
    assert bad == 0
    for mic in range(mics):
        samples = healthy.copy()
        if fault == 0.0:
            samples[mic] = 0.0
        else:
            samples[mic, 300] = fault
        got, got_power, got_bad = found.process(samples)
        others = rows_without(found, mic)
        assert got_bad == (0 if fault == 0.0 else 1 << mic)
        # To the last bit: no lane sees another before the products.
        np.testing.assert_array_equal(got[others], correlation[others])
        assert not np.delete(got, others, axis=0).any()
        assert got_power[mic] == 0.0
        np.testing.assert_array_equal(np.delete(got_power, mic), np.delete(power, mic))
    np.testing.assert_array_equal(found.process(healthy)[0], correlation)  # and nothing lingers


def test_all_channels_faulty() -> None:
    correlation, power, bad = kernel(8).process(np.full((8, 1024), np.nan, np.float32))
    assert bad == 0xFF
    assert not correlation.any()
    assert not power.any()


def test_a_constant_offset_has_no_effect() -> None:
    """Hann's window keeps it in bins 0 and 1, far below the band of 31 to 481."""
    samples = noise(3, 1024)
    plain, power, _ = kernel().process(samples)
    offset, offset_power, _ = kernel().process(samples + np.float32(0.5))
    # Rounding of the input itself: 3e-8 beside samples of 0.1.
    np.testing.assert_allclose(offset, plain, atol=1e-5)
    np.testing.assert_allclose(offset_power, power, rtol=1e-5)


@pytest.mark.parametrize("scale", [2.0**-10, 2.0**10, 2.0**40])
def test_scale_has_no_effect(scale: float) -> None:
    samples = noise(3, 1024)
    plain, power, _ = kernel(floor=0.0).process(samples)
    scaled, scaled_power, bad = kernel(floor=0.0).process(samples * np.float32(scale))
    assert bad == 0
    # Powers of two leave the FFT's mantissas as they are; the root's first guess depends on the exponent's
    # last bit, which stays too: only its 7.5e-7 could differ.
    np.testing.assert_allclose(scaled, plain, atol=2e-6)
    np.testing.assert_allclose(scaled_power, power * np.float64(scale) ** 2, rtol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 1000))
def test_permuted_microphones_permute_pairs(order: list[int], seed: int) -> None:
    found = kernel(6)
    samples = noise(6, 1024, seed)
    plain, power, _ = found.process(samples)
    permuted, permuted_power, _ = found.process(np.ascontiguousarray(samples[order]))
    np.testing.assert_allclose(permuted_power, power[order], rtol=1e-6)
    for row, (i, j) in zip(permuted, found.pairs, strict=True):
        a, b = order[i], order[j]
        # (b, a) is (a, b) mirrored in time.
        twin = plain[found.pairs.index((a, b))] if a < b else plain[found.pairs.index((b, a))][::-1]
        np.testing.assert_allclose(row, twin, atol=1e-6)  # float32 sums in another order


def test_fill_is_the_share_of_the_band_above_the_floor() -> None:
    """Noise in half of the band's bins, and silence; the reference's definition, whitened bins squared."""
    found = kernel(3, relative_floor=1e-2)
    samples = noise(3, 1024)
    spectrum = np.fft.rfft(samples[1])
    spectrum[np.fft.rfftfreq(1024, 1e-4) > 2500.0] = 0.0
    samples[1] = np.fft.irfft(spectrum)
    samples[2] = 0.0
    correlation, _, _ = found.process(samples)
    whole, half, nothing = found.fill
    assert 0.93 < whole < 1.0
    assert half == pytest.approx(whole / 2, abs=0.03)
    assert nothing == 0.0
    same = np.ascontiguousarray(samples[[1, 1, 1]])
    correlation, _, _ = found.process(same)
    assert correlation.max() == pytest.approx(found.fill[0], rel=1e-4)  # a coherent pair's peak


@pytest.mark.parametrize("frame", [256, 512, 1024, 2048, 4096])
@pytest.mark.parametrize("frequency_hz", [500.0, 1234.5, 4000.0])
def test_power_of_a_sine_is_a_half(frame: int, frequency_hz: float) -> None:
    samples = np.zeros((4, frame), np.float32)
    samples[2] = np.sin(2 * np.pi * frequency_hz / 10_000.0 * np.arange(frame))
    samples[3] = 0.25 * samples[2]
    _, power, _ = kernel(4, frame).process(samples)
    # Hann's side lobes reach out of the band, and a part of a period weighs on the mean of the square.
    np.testing.assert_allclose(power, [0.0, 0.0, 0.5, 0.5 / 16], rtol=1e-3)


def test_results_are_new_and_the_input_is_left_alone() -> None:
    found = kernel()
    samples = noise(3, 1024)
    before = samples.copy()
    samples.flags.writeable = False
    first, first_power, _ = found.process(samples)
    kept, kept_power = first.copy(), first_power.copy()
    second, second_power, _ = found.process(noise(3, 1024, seed=1))
    np.testing.assert_array_equal(samples, before)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(first_power, kept_power)
    assert not np.shares_memory(first, second)
    assert not np.shares_memory(first_power, second_power)
    assert first.dtype == first_power.dtype == np.float32
    assert first.flags.c_contiguous


def test_two_states_share_nothing() -> None:
    samples, others = noise(3, 1024), noise(5, 256, seed=1)
    a = kernel()
    alone, _, _ = a.process(samples)
    b = kernel(5, 256, lags=200, band_hz=(1000.0, 3000.0))
    b.process(others)
    np.testing.assert_array_equal(a.process(samples)[0], alone)


def test_lag_axis() -> None:
    found = kernel(lags=2, oversample=4, rate_hz=8000.0, band_hz=(300.0, 3000.0))
    np.testing.assert_allclose(found.lag_s * 32_000.0, [-2, -1, 0, 1, 2])
    assert found.lag_s.dtype == np.float64


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (np.zeros((3, 1024)), "float64"),
        (np.zeros((3, 1024), np.int16), "int16"),
        (np.zeros((3, 1024), ">f4"), ">f4"),
        (np.zeros((3, 1023), np.float32), r"\(3, 1023\)"),
        (np.zeros((2, 1024), np.float32), r"\(2, 1024\)"),
        (np.zeros(3072, np.float32), r"\(3072,\)"),
        (np.zeros((1024, 3), np.float32).T, "contiguous"),
        (np.zeros((3, 2048), np.float32)[:, ::2], "contiguous"),
        ([[0.0] * 1024] * 3, "float32"),
        (None, "float32"),
    ],
)
def test_refuses_samples_that_cffi_would_take(samples: Any, words: str) -> None:
    with pytest.raises(KernelError, match=words):
        kernel().process(samples)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"mics": 1}, "microphones"),
        ({"mics": 9}, "microphones"),
        ({"frame": 128}, "frame"),
        ({"frame": 1000}, "frame"),
        ({"frame": 8192}, "frame"),
        ({"rate_hz": 0.0}, "rate"),
        ({"rate_hz": np.nan}, "rate"),
        ({"rate_hz": np.inf}, "rate"),
        ({"band_hz": (0.0, 4700.0)}, "band"),
        ({"band_hz": (4700.0, 300.0)}, "band"),
        ({"band_hz": (300.0, 5000.0)}, "band"),
        ({"band_hz": (300.0, np.nan)}, "band"),
        ({"band_hz": (300.0, 360.0)}, "band"),
        ({"oversample": 0}, "lags"),
        ({"oversample": 65}, "lags"),
        ({"lags": 0}, "lags"),
        ({"lags": 4096}, "lags"),
        ({"floor": -1e-12}, "floors"),
        ({"floor": 1.0}, "floors"),
        ({"floor": np.nan}, "floors"),
        ({"relative_floor": 1.0}, "floors"),
        ({"relative_floor": -0.1}, "floors"),
        ({"mics": 2**40}, "configuration"),
        ({"frame": 1024.0}, "configuration"),
        ({"rate_hz": "fast"}, "configuration"),
    ],
)
def test_refuses_a_wrong_configuration_by_name(changes: dict[str, Any], word: str) -> None:
    with pytest.raises(KernelError, match=word):
        GccPhat(**({"mics": 3, "frame": 1024} | TRIANGLE | changes))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([256, 512, 1024, 2048, 4096]), st.integers(1, 64), st.integers(0, 100))
def test_the_limits_of_the_lags_are_exact(frame: int, oversample: int, seed: int) -> None:
    longest = frame // 4 * oversample - 1
    assume(longest <= 20_000)  # the reference's time
    changes = TRIANGLE | {"lags": longest, "oversample": oversample}
    samples = noise(2, frame, seed)
    correlation, _, _ = GccPhat(mics=2, frame=frame, **changes).process(samples)
    expected, _ = gcc_phat(samples, **changes)
    assert np.abs(correlation - expected).max() <= PROMISE * np.abs(expected).max()
