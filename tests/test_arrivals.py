"""The twin's arrivals: signs, known delays, the laws of rounding, and the same bytes for the same seed."""

from __future__ import annotations

import dataclasses
import hashlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import arrivals_s

from locagen_edge.geometry import MicArray, direction, equilateral
from locagen_edge.sim.arrivals import BLOCK, Arrivals, TwinSettings, draw

ARRAY = equilateral()
SPEED = 343.0
RATE = 10_000.0
EXACT = TwinSettings(rounding="none", position_error_m=0.0)


def sample(
    twin: TwinSettings, count: int = 1000, seed: int = 1, noise_s: float = 0.0, first: int = 0
) -> Arrivals:
    return draw(ARRAY, SPEED, RATE, twin, noise_s, count, seed, first)


def all_bytes(arrivals: Arrivals) -> bytes:
    fields = (getattr(arrivals, field.name) for field in dataclasses.fields(arrivals))
    return b"".join(np.ascontiguousarray(field).tobytes() for field in fields)


def test_true_delays_are_those_of_the_geometry_in_double_precision() -> None:
    found = sample(EXACT)
    wanted = np.empty((3, 1000))
    for k, (x, y) in enumerate(found.position_m.T.astype(np.float64)):
        times = arrivals_s(ARRAY, np.array([x, y, 0.0]), SPEED)
        wanted[:, k] = [times[j] - times[i] for i, j in ARRAY.pairs]
    # single precision of path differences: 10 nm, 30 ps; a thousandth of a sample would be 1e-7 s
    np.testing.assert_allclose(found.true_delay_s, wanted, atol=2e-10)
    np.testing.assert_array_equal(found.azimuth_rad.shape, (1000,))


def test_a_source_ahead_is_heard_by_the_front_microphone_first_and_by_the_others_together() -> None:
    twin = dataclasses.replace(EXACT, source="sweep", range_m=1000.0, step_deg=90.0)
    found = sample(twin, 4)
    np.testing.assert_allclose(np.degrees(found.azimuth_rad), [0.0, 90.0, -180.0, -90.0], atol=1e-5)
    ahead, right = found.delay_s[:, 0], found.delay_s[:, 1]
    assert (ahead[:2] > 0.0).all()  # microphones 1 and 2 stand behind number 0, and hear later
    assert abs(ahead[2]) < 1e-9
    assert right[2] > 0.0  # 1 stands behind right, 2 behind left
    plane = ARRAY.delays_s(direction(math.pi / 2), SPEED)
    np.testing.assert_allclose(right, plane, atol=2e-8)  # 1 km: the wave is plane to d^2 / (8 r c) = 4 ns


def test_the_sweep_goes_round_in_steps_and_begins_again() -> None:
    found = sample(dataclasses.replace(EXACT, source="sweep"), 7201)
    degrees = np.degrees(found.azimuth_rad.astype(np.float64)) % 360.0
    expected = (np.arange(7201) % 3600) * 0.1
    error = (degrees - expected + 180.0) % 360.0 - 180.0
    assert np.abs(error).max() < 2e-5


def test_the_disc_is_uniform_over_its_area() -> None:
    found = sample(EXACT, 200_000)
    radius = np.hypot(*found.position_m)
    assert radius.max() <= 100.0 + 1e-4
    # share inside half the radius is a quarter, sd sqrt(3/16/200000) = 0.001: five of them
    assert abs((radius < 50.0).mean() - 0.25) < 0.005
    quarters = np.histogram(found.azimuth_rad, bins=4, range=(-math.pi, math.pi))[0] / 200_000
    np.testing.assert_allclose(quarters, 0.25, atol=0.005)


def test_displaced_microphones_move_the_true_delays_by_their_tolerance() -> None:
    exact, moved = sample(EXACT, 50_000), sample(dataclasses.replace(EXACT, position_error_m=0.001), 50_000)
    np.testing.assert_array_equal(exact.position_m, moved.position_m)  # sources are drawn first
    shift = (moved.true_delay_s - exact.true_delay_s) * SPEED
    # each end of a pair moves by uniform +-1 mm across the wave: variance 2 * 1/3 mm^2
    np.testing.assert_allclose(shift.std(axis=1), 0.001 * math.sqrt(2 / 3), rtol=0.02)


ROUNDED = st.sampled_from(["nearest", "floor"])
PHASES = st.sampled_from(["aligned", "common", "each"])


@settings(max_examples=30, deadline=None)
@given(ROUNDED, PHASES, st.integers(0, 2**31), st.sampled_from([10_000.0, 24_000.0, 44_100.0, 48_000.0]))
def test_recorded_delays_are_whole_samples_near_the_truth(rounding, phase, seed, rate) -> None:
    twin = TwinSettings(rounding=rounding, phase=phase, position_error_m=0.0)
    found = draw(ARRAY, SPEED, rate, twin, 0.0, 300, seed)
    steps = found.delay_s.astype(np.float64) * rate
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-4)
    off = np.abs(steps - found.true_delay_s.astype(np.float64) * rate)
    # two roundings differ by less than a sample; phases of their own add less than another one
    assert off.max() < (2.0 if phase == "each" else 1.0) + 1e-4
    # the pairs close: t02 = t01 + t12
    np.testing.assert_allclose(steps[1], steps[0] + steps[2], atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["aligned", "common"]))
def test_a_whole_sample_of_offset_moves_a_delay_by_just_that(seed, phase) -> None:
    plain = sample(TwinSettings(phase=phase), 300, seed)
    late = sample(TwinSettings(phase=phase, offset_samples=(0.0, 0.0, 1.0)), 300, seed)
    moved = (late.delay_s - plain.delay_s).astype(np.float64) * RATE
    np.testing.assert_allclose(moved, np.array([[0.0], [1.0], [1.0]]) * np.ones(300), atol=1e-3)


def test_rounding_at_a_random_phase_is_unbiased_and_has_the_triangle_s_variance() -> None:
    # at 1 MHz a delay is many samples, and the rounding of its two ends independent
    for phase, variance in (("common", 1 / 6), ("each", 1 / 6 + 1 / 6)):
        found = draw(ARRAY, SPEED, 1e6, TwinSettings(phase=phase), 0.0, 400_000, 1)
        off = (found.delay_s - found.true_delay_s).astype(np.float64) * 1e6
        # 400,000 draws give the mean to 0.001 and the variance to 0.3 %
        assert np.abs(off.mean(axis=1)).max() < 0.005
        np.testing.assert_allclose(off.var(axis=1), variance, rtol=0.02)


def test_aligned_arrivals_are_the_distance_s_own_sample_numbers() -> None:
    twin = TwinSettings(phase="aligned", rounding="floor", position_error_m=0.0)
    found = sample(twin, 2000)
    x, y = found.position_m.astype(np.float64)
    places = ARRAY.positions_m
    arrival = np.hypot(x - places[:, :1], y - places[:, 1:2]) / SPEED * RATE
    number = np.floor(arrival)
    wanted = np.stack([number[j] - number[i] for i, j in ARRAY.pairs])
    sure = (np.abs(arrival - np.rint(arrival)) > 1e-4).all(
        axis=0
    )  # not within rounding of a sampling instant
    assert sure.mean() > 0.99
    np.testing.assert_allclose((found.delay_s * RATE)[:, sure], wanted[:, sure], atol=1e-3)


def test_noise_and_clocks_disturb_by_what_they_say() -> None:
    noisy = sample(EXACT, 100_000, noise_s=5e-6)
    off = noisy.delay_s - noisy.true_delay_s
    np.testing.assert_allclose(off.std(axis=1), 5e-6 * math.sqrt(2), rtol=0.02)
    at = dataclasses.replace(EXACT, source="sweep", range_m=100.0, clock_ppm=50.0)
    wrong = sample(at, 100_000)
    off = wrong.delay_s - wrong.true_delay_s
    # 100 m are 0.29 s; two clocks uniform +-50 ppm: variance 2/3 (50 ppm)^2
    np.testing.assert_allclose(off.std(axis=1), 100 / SPEED * 50e-6 * math.sqrt(2 / 3), rtol=0.02)


def test_same_seed_same_bytes_whatever_the_piece() -> None:
    twin = TwinSettings(phase="each", clock_ppm=20.0)
    whole = sample(twin, 2 * BLOCK + 100, seed=7, noise_s=1e-6)
    assert all_bytes(whole) == all_bytes(sample(twin, 2 * BLOCK + 100, seed=7, noise_s=1e-6))
    assert all_bytes(whole) != all_bytes(sample(twin, 2 * BLOCK + 100, seed=8, noise_s=1e-6))
    piece = sample(twin, 150, seed=7, noise_s=1e-6, first=BLOCK - 50)
    for field in dataclasses.fields(whole):
        part = getattr(whole, field.name)[..., BLOCK - 50 : BLOCK + 100]
        np.testing.assert_array_equal(part, getattr(piece, field.name))


def test_nothing_random_is_left_without_parameters_that_are_random() -> None:
    twin = dataclasses.replace(EXACT, source="sweep")
    digest = {hashlib.sha256(all_bytes(sample(twin, 500, seed))).hexdigest() for seed in (1, 2, 3)}
    assert len(digest) == 1


def test_arrays_of_other_shapes_work() -> None:
    square = MicArray(np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0.5]]) * 0.1 + 3.0)
    twin = dataclasses.replace(EXACT, height_m=20.0, offset_samples=(0.0,) * 4)
    found = draw(square, SPEED, RATE, twin, 0.0, 100, 1)
    assert found.delay_s.shape == (6, 100)
    middle = square.positions_m.mean(axis=0)
    x, y = found.position_m[:, 5].astype(np.float64)
    times = arrivals_s(square, middle + np.array([x, y, 20.0]), SPEED)
    np.testing.assert_allclose(found.delay_s[:3, 5], times[1:] - times[0], atol=1e-9)


@pytest.mark.parametrize("source", ["disc", "sweep"])
def test_zero_samples_are_zero_samples(source) -> None:
    assert sample(TwinSettings(source=source), 0).delay_s.shape == (3, 0)
