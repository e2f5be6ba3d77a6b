"""Self-calibration: what a walked sound determines, to the sigma stated, and what it does not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from locagen_edge.calibration import (
    LEAST_FRAMES,
    WIDEST_GAP_DEG,
    Arrivals,
    Calibration,
    Walk,
    aligning_angle,
    calibrate,
    off_m,
)
from locagen_edge.errors import CalibrationError
from locagen_edge.geometry import equilateral, speed_of_sound
from locagen_edge.types import F64

AIR = 20.0
SPEED = speed_of_sound(AIR)
TRIANGLE = equilateral().positions_m
SQUARE = np.array([[0.055, -0.055, 0], [0.055, 0.055, 0], [-0.055, 0.055, 0], [-0.055, -0.055, 0]])
SCALENE = np.array([[0.07, 0.0, 0], [-0.03, 0.06, 0], [-0.04, -0.02, 0]])
PYRAMID = np.array([[0.05, 0.0, 0.0], [-0.025, 0.043, 0.0], [-0.025, -0.043, 0.0], [0.0, 0.0, -0.06]])
ARRAYS = {"triangle": TRIANGLE, "square": SQUARE, "scalene": SCALENE}
ROUND = np.radians(np.linspace(10.0, 380.0, 400))


def heard(
    positions: F64,
    late: F64,
    azimuth: F64 = ROUND,
    *,
    elevation: F64 | float = 0.0,
    distance_m: float = math.inf,
    sigma_s: float = 3e-6,
    wild: float = 0.0,
    seed: int = 0,
) -> Arrivals:
    """Delays with Gaussian noise of `sigma_s` per pair; a share of them wild."""
    rng = np.random.default_rng(seed)
    level = np.cos(elevation) * np.ones_like(azimuth)
    down = -np.sin(elevation) * np.ones_like(azimuth)
    u = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), down], axis=1)
    centred = positions - positions.mean(axis=0)
    if math.isfinite(distance_m):
        time_s = np.linalg.norm(distance_m * u[:, None] - centred, axis=2) / SPEED
    else:
        time_s = -u @ centred.T / SPEED
    time_s = time_s + late + sigma_s / math.sqrt(2.0) * rng.standard_normal(time_s.shape)
    delay = time_s[:, 1:] - time_s[:, :1]
    strays = rng.random(len(delay)) < wild
    delay[strays] = rng.uniform(-3e-4, 3e-4, (strays.sum(), delay.shape[1]))
    mates = delay.shape[1]
    covariance = np.broadcast_to(sigma_s**2 / 2.0 * (np.eye(mates) + 1.0), (len(delay), mates, mates))
    return Arrivals(delay, covariance, 0.05 * np.arange(len(delay)))


def array_off(nominal: F64, seed: int, heights: bool = False) -> tuple[F64, F64]:
    """The true positions, 2 mm off per axis, and channels 10 us late."""
    rng = np.random.default_rng(seed)
    positions = nominal.copy()
    positions[:, : 3 if heights else 2] += 0.002 * rng.standard_normal((len(nominal), 3 if heights else 2))
    late = 1e-5 * rng.standard_normal(len(nominal))
    return positions, late - late[0]


def found(arrivals: Arrivals, nominal: F64, walk: Walk | None = None, **more) -> Calibration:
    return calibrate(arrivals, nominal, AIR, SPEED, walk or Walk(), **more)


def miss_m(calibration: Calibration, positions: F64) -> float:
    """Rms error of the shape: rotation and place are not to be had from unknown directions."""
    ours, true = (p[:, :2] - p[:, :2].mean(axis=0) for p in (calibration.positions_m, positions))
    return off_m(ours, true)


# --- what is found


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("wild", [0.0, 0.1])
def test_shape_and_delays_come_out_within_their_sigma(name, wild):
    """The errors over their stated sigmas, squared, average to 1; over 12 arrays within a factor."""
    nominal = ARRAYS[name]
    shape, late_over_sigma = [], []
    for seed in range(12):
        positions, late = array_off(nominal, seed)
        result = found(heard(positions, late, wild=wild, seed=seed), nominal, Walk(distance_m=1e6))
        assert result.doubts == ()
        assert miss_m(result, positions) < 3e-4
        assert np.abs(result.delays_s - late).max() < 1e-6
        off = result.position_sigma_m[:, :2]
        centred = result.positions_m[:, :2] - result.positions_m[:, :2].mean(axis=0)
        scatter = off**2 - (result.scale_sigma * centred) ** 2  # the speed of sound was true here
        shape.append(miss_m(result, positions) ** 2 / np.mean(np.sum(scatter, axis=1)))
        late_over_sigma.append(np.mean(((result.delays_s - late)[1:] / result.delay_sigma_s[1:]) ** 2))
    # chi-square of 12 x 2 or more: 0.4 to 2 is 99.9 %
    assert 0.4 < np.mean(shape) < 2.0
    assert 0.4 < np.mean(late_over_sigma) < 2.0


@pytest.mark.parametrize("name", ARRAYS)
def test_the_residual_falls_to_the_noise(name):
    positions, late = array_off(ARRAYS[name], 1)
    result = found(heard(positions, late), ARRAYS[name])
    assert result.misfit == pytest.approx(1.0, abs=0.15)
    assert result.rms_after_s < 3e-6 < result.rms_before_s


def test_what_is_right_already_stays():
    late = np.array([0.0, 1e-5, -1e-5])
    result = found(heard(TRIANGLE, late, sigma_s=1e-7), TRIANGLE, before_s=late)
    assert np.abs(result.positions_m - TRIANGLE).max() < 2e-5
    assert result.rms_before_s < 2e-7


def test_very_late_channels_are_found():
    """30 us is the time over the triangle's tenth; 100 us a third of it."""
    late = np.array([0.0, 1e-4, -1e-4])
    result = found(heard(TRIANGLE, late), TRIANGLE)
    assert np.abs(result.delays_s - late).max() < 1e-6


# --- gauge: what turns, turns along

ANGLE = st.floats(-math.pi, math.pi)
FEW = hypothesis_settings(max_examples=15)


def turned(points: F64, angle: float) -> F64:
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


@FEW
@given(ANGLE, st.tuples(*[st.floats(-1, 1)] * 3))
def test_the_answer_turns_and_moves_with_the_nominal_positions(angle, shift):
    positions, late = array_off(SCALENE, 3)
    arrivals = heard(positions, late)
    one = found(arrivals, SCALENE)
    other = found(arrivals, turned(SCALENE, angle) + np.array(shift))
    assert np.abs(other.positions_m - turned(one.positions_m - SCALENE.mean(axis=0), angle)
                  - (turned(SCALENE, angle) + np.array(shift)).mean(axis=0)).max() < 1e-6  # fmt: skip
    assert np.abs(other.delays_s - one.delays_s).max() < 1e-9


@FEW
@given(st.permutations(range(4)))
def test_the_answer_does_not_depend_on_the_order_of_the_microphones(order):
    positions, late = array_off(SQUARE, 4)
    order = list(order)
    one = found(heard(positions, late, sigma_s=1e-7), SQUARE)
    other = found(heard(positions[order], late[order], sigma_s=1e-7), SQUARE[order])
    assert np.abs(other.positions_m - one.positions_m[order]).max() < 3e-5
    relative = one.delays_s[order] - one.delays_s[order][0]
    assert np.abs(other.delays_s - relative).max() < 1e-7


@FEW
@given(ANGLE)
def test_where_the_walk_begins_and_its_sense_do_not_matter(begin):
    positions, late = array_off(TRIANGLE, 5)
    for azimuth in (ROUND + begin, begin - ROUND):
        result = found(heard(positions, late, azimuth, sigma_s=1e-6), TRIANGLE)
        assert miss_m(result, positions) < 1e-4
        assert np.sign(result.turned_rad) == np.sign(azimuth[-1] - azimuth[0])


@given(ANGLE, st.integers(0, 99))
def test_procrustes_finds_the_rotation(angle, seed):
    points = np.random.default_rng(seed).standard_normal((4, 2))
    rotated = turned(np.column_stack([points, np.zeros(4)]), angle)[:, :2]
    off = aligning_angle(points, rotated) - angle
    assert math.cos(off) == pytest.approx(1.0)
    assert off_m(points, rotated) < 1e-9


# --- scale


def test_the_scale_is_that_of_the_speed_of_sound():
    positions, late = array_off(TRIANGLE, 6)
    arrivals = heard(positions, late)
    cold = calibrate(arrivals, TRIANGLE, 0.0, speed_of_sound(0.0), Walk())
    warm = found(arrivals, TRIANGLE)
    size = [np.linalg.norm(c.positions_m - c.positions_m.mean(axis=0)) for c in (cold, warm)]
    assert size[0] / size[1] == pytest.approx(speed_of_sound(0.0) / SPEED, rel=1e-4)
    assert np.abs(cold.delays_s - warm.delays_s).max() < 1e-8


def test_a_sound_below_the_horizon_shrinks_the_array_unless_it_is_told():
    positions, late = array_off(TRIANGLE, 7)
    low = math.radians(-20.0)
    arrivals = heard(positions, late, elevation=low, sigma_s=1e-6)
    told = found(arrivals, TRIANGLE, Walk(elevation_rad=low))
    assert miss_m(told, positions) < 5e-5
    assert told.scale_sigma > 2 * found(arrivals, TRIANGLE).scale_sigma  # tan(20 degrees) x 2 degrees
    untold = found(arrivals, TRIANGLE)
    size = [np.linalg.norm(c.positions_m[:, :2] - c.positions_m[:, :2].mean(axis=0)) for c in (untold, told)]
    assert size[0] / size[1] == pytest.approx(math.cos(low), rel=1e-3)


def test_heights_that_are_not_known_spoil_delays_only_away_from_the_horizon():
    positions, late = array_off(TRIANGLE, 8)
    low = math.radians(-30.0)
    level = found(heard(positions, late), TRIANGLE, tolerance_m=0.002)
    below = found(heard(positions, late, elevation=low), TRIANGLE, Walk(elevation_rad=low), tolerance_m=0.002)
    assert below.delay_sigma_s[1] > math.sqrt(2) * 0.002 * 0.5 / SPEED > 10 * level.delay_sigma_s[1]


def test_a_near_sound_is_unbent_where_its_distance_is_known():
    positions, late = array_off(SQUARE, 9)
    arrivals = heard(positions, late, distance_m=1.0, sigma_s=3e-7)
    far, near = (found(arrivals, SQUARE, Walk(distance_m=d)) for d in (math.inf, 1.0))
    assert near.misfit < 0.2 * far.misfit
    assert miss_m(near, positions) < 2e-5
    assert miss_m(far, positions) < 2e-4  # twice the azimuth: a full circle averages it out


# --- what cannot be determined is not


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("arc_deg", [0, 10, 90, 180, 220])
@pytest.mark.parametrize(("sigma_s", "wild"), [(3e-7, 0.0), (5e-6, 0.3), (2e-5, 0.1)])
def test_an_arc_is_told_and_never_a_wrong_answer(name, arc_deg, sigma_s, wild):
    """Wild frames lie all around: they must not pass for the rest of the circle."""
    assert 360 - arc_deg > WIDEST_GAP_DEG
    positions, late = array_off(ARRAYS[name], arc_deg)
    azimuth = np.radians(np.linspace(0.0, arc_deg, 300) + 77.0)
    result = found(heard(positions, late, azimuth, sigma_s=sigma_s, wild=wild, seed=arc_deg), ARRAYS[name])
    assert any(doubt.startswith("could not determine") for doubt in result.doubts)


def test_an_arc_just_wide_enough_is_as_good_as_it_says():
    for seed in range(5):
        positions, late = array_off(TRIANGLE, seed)
        azimuth = np.radians(np.linspace(0.0, 260.0, 400))
        result = found(heard(positions, late, azimuth, seed=seed), TRIANGLE)
        assert result.doubts == ()
        assert miss_m(result, positions) < 3e-4
        assert np.abs(result.delays_s - late).max() < 4 * result.delay_sigma_s.max()


@pytest.mark.parametrize("name", ARRAYS)
def test_noise_is_no_array(name):
    arrivals = heard(ARRAYS[name], np.zeros(len(ARRAYS[name])))
    for seed in range(4):
        lost = np.random.default_rng(seed).uniform(-3e-4, 3e-4, arrivals.delay_s.shape)
        with pytest.raises(CalibrationError, match="jump about"):
            found(replace(arrivals, delay_s=lost), ARRAYS[name])


def test_two_sounds_at_once_are_no_walk():
    """Every other frame hears another caller, on the far side."""
    azimuth = ROUND + np.pi * (np.arange(len(ROUND)) % 2)
    with pytest.raises(CalibrationError, match="jump about"):
        found(heard(TRIANGLE, np.zeros(3), azimuth), TRIANGLE)


def test_another_array_is_refused():
    result = found(heard(1.5 * TRIANGLE, np.zeros(3)), TRIANGLE)
    assert any("mm apart, the settings say" in doubt for doubt in result.doubts)


def test_too_few_frames_and_too_few_microphones_are_refused():
    few = heard(TRIANGLE, np.zeros(3), ROUND[: LEAST_FRAMES - 1])
    with pytest.raises(CalibrationError, match="only 19 usable frames"):
        found(few, TRIANGLE)
    pair = TRIANGLE[:2]
    with pytest.raises(CalibrationError, match="give --angles"):
        found(heard(pair, np.zeros(2)), pair)


# --- swapped channels


@pytest.mark.parametrize(("name", "i", "j"), [("scalene", 0, 1), ("scalene", 1, 2), ("square", 0, 1)])
def test_a_swap_is_told_where_the_shape_shows_it(name, i, j):
    positions = ARRAYS[name].copy()
    positions[[i, j]] = positions[[j, i]]
    result = found(heard(positions, np.zeros(len(positions))), ARRAYS[name])
    (doubt,) = [d for d in result.doubts if "swapped" in d]
    assert f"{i} and {j}" in doubt


def test_a_swap_in_a_triangle_of_equal_sides_is_told_by_the_walks_sense():
    swapped = TRIANGLE[[0, 2, 1]]
    arrivals = heard(swapped, np.zeros(3))
    assert found(arrivals, TRIANGLE).doubts == ()  # its mirror image fits as well
    assert found(arrivals, TRIANGLE).turned_rad < 0.0
    result = found(arrivals, TRIANGLE, Walk(clockwise=True))
    assert "swapped" in result.doubts[0]
    assert found(heard(TRIANGLE, np.zeros(3)), TRIANGLE, Walk(clockwise=True)).doubts == ()


# --- known angles


def known(arrivals: Arrivals, azimuth: F64, sigma_deg: float = 0.5, elevation: F64 | float = 0.0) -> Walk:
    angles = np.stack([azimuth, elevation * np.ones_like(azimuth)], axis=1)
    return Walk(angles=angles, angle_sigma_rad=math.radians(sigma_deg), known=len(arrivals.time_s))


def test_known_angles_tell_the_rotation_too():
    positions, late = array_off(TRIANGLE, 10)
    positions = turned(positions, math.radians(5.0))
    arrivals = heard(positions, late)
    result = found(arrivals, TRIANGLE, known(arrivals, ROUND))
    centred = positions - positions.mean(axis=0)
    assert np.abs(result.positions_m - centred).max() < 3e-4
    assert result.yaw_sigma_rad < math.radians(0.1)
    assert result.tolerance_m < 3e-4


def test_angles_are_trusted_no_more_than_they_are_told_to_be():
    """Four lines of 3 degrees: 1.5 degrees of rotation, whatever the number of frames between them."""
    positions, late = array_off(TRIANGLE, 11)
    arrivals = heard(positions, late)
    result = found(arrivals, TRIANGLE, replace(known(arrivals, ROUND, 3.0), known=4))
    assert math.degrees(result.yaw_sigma_rad) == pytest.approx(1.5, rel=0.1)


def test_known_angles_place_swapped_channels_where_they_are():
    arrivals = heard(TRIANGLE[[0, 2, 1]], np.zeros(3))
    result = found(arrivals, TRIANGLE, known(arrivals, ROUND))
    assert result.doubts == ()
    assert "swapped: microphone 1 where the settings have 2" in result.notes[0]
    assert np.abs(result.positions_m - TRIANGLE[[0, 2, 1]]).max() < 3e-4


def test_two_microphones_are_calibrated_by_known_angles():
    pair = np.array([[0.0, -0.05, 0.0], [0.0, 0.05, 0.0]])
    positions, late = array_off(pair, 12)
    arrivals = heard(positions, late)
    result = found(arrivals, pair, known(arrivals, ROUND))
    assert np.abs(np.diff(result.positions_m - positions, axis=0)).max() < 5e-4
    assert abs(result.delays_s[1] - late[1]) < 1e-6


def test_angles_from_different_elevations_tell_heights():
    positions, late = array_off(PYRAMID, 13, heights=True)
    azimuth = np.radians(np.linspace(0.0, 720.0, 500))
    elevation = np.radians(np.repeat([0.0, 35.0], 250))
    arrivals = heard(positions, late, azimuth, elevation=elevation)
    result = found(arrivals, PYRAMID, known(arrivals, azimuth, 0.5, elevation))
    assert result.heights
    assert (
        np.abs(
            result.positions_m - result.positions_m.mean(axis=0) - positions + positions.mean(axis=0)
        ).max()
        < 5e-4
    )
    level = found(heard(positions, late), PYRAMID, known(heard(positions, late), ROUND))
    assert not level.heights
    assert np.array_equal(level.positions_m[:, 2], PYRAMID[:, 2])


def test_a_short_arc_of_known_angles_is_told():
    azimuth = np.radians(np.linspace(0.0, 20.0, 300))
    arrivals = heard(TRIANGLE, np.zeros(3), azimuth)
    assert found(arrivals, TRIANGLE, replace(known(arrivals, azimuth, 2.0), known=10)).doubts
