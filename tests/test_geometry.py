"""Laws of axes, signs and angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import arrivals_s

from locagen_edge.geometry import (
    MicArray,
    angles,
    compass_deg,
    direction,
    equilateral,
    heading,
    quaternion,
    rotation,
    slerp,
    speed_of_sound,
    tolerance_rad,
    wrap,
)

ANGLE = st.floats(-20.0, 20.0)


def test_axes_are_forward_right_down():
    np.testing.assert_allclose(direction(0.0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(direction(math.pi / 2), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(direction(0.0, -math.pi / 2), [0, 0, 1], atol=1e-15)  # below is +z


def test_a_source_on_the_right_reaches_the_right_microphone_first():
    array = MicArray(np.array([[0.0, -0.05, 0.0], [0.0, 0.05, 0.0]]))  # left, right
    (delay,) = array.delays_s(direction(math.pi / 2), 343.0)
    assert delay == pytest.approx(-0.1 / 343.0)  # t_right - t_left < 0: the second hears earlier


@given(ANGLE, st.floats(-1.5, 1.5))
def test_angles_undo_direction(azimuth, elevation):
    a, e = angles(direction(azimuth, elevation))
    assert abs(wrap(a - azimuth)) < 1e-9  # cos(1.5) = 0.07 costs two digits
    assert e == pytest.approx(elevation, abs=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrap_and_compass_stay_in_their_ranges(angle):
    assert -math.pi <= wrap(angle) <= math.pi
    assert 0.0 <= compass_deg(angle) < 360.0
    assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle), abs=1e-9)


def test_compass_never_says_360():
    assert compass_deg(-1e-18) == 0.0


@given(ANGLE, st.floats(-1.5, 1.5))
def test_far_point_sources_are_plane_waves(azimuth, elevation):
    array = equilateral()
    u = direction(azimuth, elevation)
    arrivals = arrivals_s(array, 1e4 * u, 343.0)
    measured = [arrivals[j] - arrivals[i] for i, j in array.pairs]
    # the wave's curvature at 10 km: d^2 / (2 r c) = 1.5e-9 s
    np.testing.assert_allclose(measured, array.delays_s(u, 343.0), atol=3e-9)


def test_triangle_has_its_sides_and_order():
    array = equilateral(0.10)
    np.testing.assert_allclose(array.spacing_m, 0.10)
    assert array.pairs == ((0, 1), (0, 2), (1, 2))
    assert array.longest_delay_s(343.0) * 10_000 == pytest.approx(2.915, abs=1e-3)


@given(ANGLE, st.floats(-1.5, 1.5))
def test_a_flat_array_hears_a_sound_and_its_mirror_image_alike(azimuth, elevation):
    array = MicArray(equilateral().positions_m @ rotation(quaternion(0.3, -0.2, 1.0)).T)
    u = direction(azimuth, elevation)
    image = u - 2 * (u @ array.normal) * array.normal
    np.testing.assert_allclose(array.delays_s(u, 343.0), array.delays_s(image, 343.0), atol=1e-15)
    assert array.normal[2] > 0.0


def test_other_arrays_have_no_mirror():
    assert MicArray(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.01]])).normal is None
    assert MicArray(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])).normal is None
    assert MicArray(np.array([[0.0, 0, 0], [0.1, 0, 0]])).normal is None


@pytest.mark.parametrize(("temperature_c", "speed"), [(0.0, 331.3), (20.0, 343.2), (-20.0, 318.9)])
def test_speed_of_sound(temperature_c, speed):
    assert speed_of_sound(temperature_c) == pytest.approx(speed, abs=0.1)


def test_tolerance_of_the_triangle_is_that_of_the_moved_microphones():
    """1-sigma from the formula = the spread found by moving microphones (2,000 draws: 1.6 % of sigma)."""
    array, rng = equilateral(), np.random.default_rng(1)
    u = direction(0.3)
    found = []
    for _ in range(2000):
        moved = MicArray(array.positions_m + 1e-3 * rng.standard_normal((3, 3)))
        v, *_ = np.linalg.lstsq(array.baselines_m[:, :2] / 343.0, moved.delays_s(u, 343.0), rcond=None)
        found.append(wrap(math.atan2(v[1], v[0]) - 0.3))
    assert np.std(found) == pytest.approx(tolerance_rad(array, 1e-3), rel=0.06)


# --- attitude

ANGLES = st.tuples(ANGLE, ANGLE, ANGLE)


def test_yaw_is_clockwise_pitch_lifts_the_nose_and_roll_lowers_the_right_side():
    """Columns are the body's axes in north, east, down."""
    east = rotation(quaternion(0.0, 0.0, math.pi / 2))
    np.testing.assert_allclose(east[:, 0], [0, 1, 0], atol=1e-15)
    assert rotation(quaternion(0.0, 0.1, 0.0))[2, 0] == pytest.approx(-math.sin(0.1))
    assert rotation(quaternion(0.1, 0.0, 0.0))[2, 1] == pytest.approx(math.sin(0.1))


def test_the_order_is_yaw_then_pitch_then_roll():
    """About axes that turn along: the matrices from left to right."""
    roll, pitch, yaw = 0.3, -0.5, 2.0
    alone = [quaternion(0, 0, yaw), quaternion(0, pitch, 0), quaternion(roll, 0, 0)]
    one, two, three = map(rotation, alone)
    np.testing.assert_allclose(rotation(quaternion(roll, pitch, yaw)), one @ two @ three, atol=1e-12)


@given(ANGLES)
def test_every_attitude_is_a_rotation(lean):
    turn = rotation(quaternion(*lean))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_level_drone_adds_its_heading():
    turn = rotation(quaternion(0.0, 0.0, math.radians(350)))
    azimuth, elevation = angles(turn @ direction(math.radians(30), -0.5))
    assert math.degrees(azimuth) == pytest.approx(20.0)
    assert elevation == pytest.approx(-0.5)


@given(ANGLES, ANGLES, st.floats(-0.5, 1.5))
def test_slerp_turns_evenly_by_the_shorter_way(a, b, share):
    """The angle from a is `share` of that from a to b, which is never more than half a turn; -q is q."""

    def between(p, q):
        """Angle by the chord: exact where a cosine would round."""
        apart = min(np.linalg.norm(np.subtract(p, q)), np.linalg.norm(np.add(p, q)))
        return 4.0 * math.asin(min(apart / 2.0, 1.0))

    p, q = quaternion(*a), quaternion(*b)
    mixed = slerp(p, q, share)
    assert np.linalg.norm(mixed) == pytest.approx(1.0)
    whole = between(p, q)
    went = abs(share) * whole
    assert between(p, mixed) == pytest.approx(min(went, 2 * math.pi - went), abs=1e-6)
    other = slerp(p, tuple(-x for x in q), share)
    if whole < math.pi - 1e-6:  # half a turn has two shorter ways
        np.testing.assert_allclose(rotation(other), rotation(mixed), atol=1e-6)


@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_the_heading_is_the_yaw_however_the_vehicle_leans(roll: float, pitch: float, yaw: float) -> None:
    assert abs(wrap(heading(quaternion(roll, pitch, yaw)) - yaw)) < 1e-6
