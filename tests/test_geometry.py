"""Laws of axes, signs and angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.geometry import (
    MicArray,
    angles,
    compass_deg,
    direction,
    equilateral,
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
    arrivals = array.arrivals_s(1e4 * u, 343.0)
    measured = [arrivals[j] - arrivals[i] for i, j in array.pairs]
    # the wave's curvature at 10 km: d^2 / (2 r c) = 1.5e-9 s
    np.testing.assert_allclose(measured, array.delays_s(u, 343.0), atol=3e-9)


def test_triangle_has_its_sides_and_order():
    array = equilateral(0.10)
    np.testing.assert_allclose(array.spacing_m, 0.10)
    assert array.pairs == ((0, 1), (0, 2), (1, 2))
    assert array.longest_delay_s(343.0) * 10_000 == pytest.approx(2.915, abs=1e-3)


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
