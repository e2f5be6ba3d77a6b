"""Laws of the estimators: from exact and noisy delays to directions and positions."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from scenes import arrivals_s

from locagen_edge.geometry import angles, direction, wrap
from locagen_edge.settings import Settings, from_table
from locagen_edge.stages.bearing import ESTIMATORS, make_estimator
from locagen_edge.stages.bearing.far_field import far_field
from locagen_edge.types import Tdoa

SIGMA_S = 1e-6
AZIMUTH = st.floats(-math.pi, math.pi)
# below 12 degrees of depression or above 75 the geometry itself is ill-conditioned
DEPRESSION = st.floats(math.radians(-75), math.radians(-12))

TETRAHEDRON = [[0.05, 0, 0], [-0.03, 0.05, 0], [-0.03, -0.05, 0], [0, 0, -0.08]]
SQUARE = [[0.055, 0.055, 0], [0.055, -0.055, 0], [-0.055, -0.055, 0], [-0.055, 0.055, 0]]


def make(estimator: str, positions: list | None = None, tolerance_m: float = 0.0) -> Settings:
    table: dict = {"bearing": {"estimator": estimator}, "array": {"tolerance_m": tolerance_m}}
    if positions is not None:
        table["array"]["positions_m"] = positions
        table["audio"] = {"channel_map": list(range(len(positions)))}
    return from_table(table)


def tdoa(delay_s: np.ndarray, sigma_s: float = SIGMA_S) -> Tdoa:
    delay_s = np.asarray(delay_s, dtype=np.float64)
    return Tdoa(delay_s, np.full(len(delay_s), sigma_s), np.full(len(delay_s), 0.9))


def plane_wave(settings: Settings, azimuth: float, elevation: float = 0.0) -> Tdoa:
    return tdoa(settings.mic_array.delays_s(direction(azimuth, elevation), settings.speed_m_s))


def point(settings: Settings, source_m: np.ndarray, sigma_s: float = SIGMA_S) -> Tdoa:
    arrival = arrivals_s(settings.mic_array, np.asarray(source_m), settings.speed_m_s)
    return tdoa(np.array([arrival[j] - arrival[i] for i, j in settings.mic_array.pairs]), sigma_s)


def test_the_table_names_what_the_settings_allow():
    for name in ESTIMATORS:
        from_table({"bearing": {"estimator": "model:x" if name == "model" else name}})


def test_the_example_for_contributors_works():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    names = {"np": np, "replace": replace, "far_field": far_field}
    exec("from __future__ import annotations\n" + code, names)
    settings = make("far-field")
    bearing = names["by_peak"](settings)(plane_wave(settings, 1.0, -0.5))
    assert bearing.azimuth_rad == pytest.approx(1.0, abs=1e-9)


# --- far field


@pytest.mark.parametrize("positions", [None, SQUARE, TETRAHEDRON], ids=["triangle", "square", "solid"])
@given(azimuth=AZIMUTH, elevation=DEPRESSION)
def test_far_field_finds_plane_waves(positions, azimuth, elevation):
    settings = make("far-field", positions)
    bearing = make_estimator(settings)(plane_wave(settings, azimuth, elevation))
    assert abs(wrap(bearing.azimuth_rad - azimuth)) < 1e-6
    assert bearing.elevation_rad == pytest.approx(elevation, abs=1e-6)
    assert bearing.misfit < 1e-3


def test_a_source_above_a_flat_array_is_taken_for_its_mirror_below():
    settings = make("far-field")
    bearing = make_estimator(settings)(plane_wave(settings, 1.0, math.radians(30)))
    assert bearing.elevation_rad == pytest.approx(-math.radians(30), abs=1e-9)


def test_a_solid_array_tells_above_from_below():
    settings = make("far-field", TETRAHEDRON)
    bearing = make_estimator(settings)(plane_wave(settings, 1.0, math.radians(30)))
    assert bearing.elevation_rad == pytest.approx(math.radians(30), abs=1e-9)


def test_a_tilted_flat_array_finds_sources_below():
    tilt = math.radians(20)
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    settings = make("far-field", (np.array(make("far-field").array.positions_m) @ turn.T).tolist())
    bearing = make_estimator(settings)(plane_wave(settings, 2.0, math.radians(-45)))
    assert math.degrees(bearing.azimuth_rad) == pytest.approx(math.degrees(2.0), abs=1e-6)
    assert bearing.elevation_rad == pytest.approx(-math.radians(45), abs=1e-6)


@pytest.mark.parametrize("raised_mm", [0.0, 0.5, 1.5, 3.0, 10.0, 30.0])
def test_a_nearly_flat_array_is_as_good_as_a_flat_one(raised_mm):
    """A square with one microphone raised, as any real mount is; arrivals 3 us, source 30 degrees below."""
    positions = [[*row[:2], row[2]] for row in SQUARE]
    positions[2][2] = -raised_mm * 1e-3
    settings, rng = make("far-field", positions), np.random.default_rng(1)
    estimate = make_estimator(settings)
    exact = plane_wave(settings, 1.2, -0.5).delay_s
    azimuths, elevations, scores = [], [], []
    for _ in range(300):
        arrival = rng.standard_normal(4) * 3e-6
        noise = np.array([arrival[j] - arrival[i] for i, j in settings.mic_array.pairs])
        bearing = estimate(tdoa(exact + noise, 3e-6 * math.sqrt(2)))
        azimuths.append(wrap(bearing.azimuth_rad - 1.2))
        elevations.append(bearing.elevation_rad + 0.5)
        scores.append(abs(azimuths[-1]) / bearing.azimuth_sigma_rad)
    assert math.degrees(np.std(azimuths)) < 1.0
    assert math.degrees(np.std(elevations)) < 2.5
    assert 0.55 < np.mean(np.array(scores) < 1.0) < 0.85


@pytest.mark.parametrize("tilt_deg", [0, 10, 20, 45, 70])
@pytest.mark.parametrize("elevation_deg", [-5, -30, -60])
def test_a_tilted_flat_array_never_hides_its_second_answer(tilt_deg, elevation_deg):
    """The mirror image in the array's plane may lie below the horizon too: then the sigma covers both."""
    tilt = math.radians(tilt_deg)
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    settings = make("far-field", (np.array(make("far-field").array.positions_m) @ turn.T).tolist())
    estimate = make_estimator(settings)
    for azimuth_deg in range(0, 360, 15):
        azimuth = math.radians(azimuth_deg)
        bearing = estimate(plane_wave(settings, azimuth, math.radians(elevation_deg)))
        if bearing.azimuth_rad is not None:
            assert abs(wrap(bearing.azimuth_rad - azimuth)) <= 2.0 * bearing.azimuth_sigma_rad + 1e-6
            error = abs(bearing.elevation_rad - math.radians(elevation_deg))
            assert error <= 2.0 * bearing.elevation_sigma_rad + 1e-6


@pytest.mark.parametrize("elevation_deg", [0.0, -30.0, -60.0])
def test_far_field_sigma_is_true(elevation_deg):
    """With arrival errors as stated, the share within 1 sigma is 68 % (2,000 draws: +-3 % at 3 sigma)."""
    settings, rng = make("far-field"), np.random.default_rng(7)
    estimate = make_estimator(settings)
    exact = plane_wave(settings, 0.7, math.radians(elevation_deg)).delay_s
    sigma_s = 2e-6
    inside = []
    for _ in range(2000):
        arrival = rng.standard_normal(3) * sigma_s / math.sqrt(2)
        noise = np.array([arrival[j] - arrival[i] for i, j in settings.mic_array.pairs])
        bearing = estimate(tdoa(exact + noise, sigma_s))
        inside.append(abs(wrap(bearing.azimuth_rad - 0.7)) < bearing.azimuth_sigma_rad)
    assert 0.64 < np.mean(inside) < 0.72


def test_tolerance_of_the_positions_is_in_the_sigma():
    """1 mm on a 10 cm triangle: 0.81 degrees at 1 sigma (0.6 mean error)."""
    settings = make("far-field", tolerance_m=1e-3)
    bearing = make_estimator(settings)(plane_wave(settings, 0.2))
    assert math.degrees(bearing.azimuth_sigma_rad) == pytest.approx(0.81, abs=0.03)


def test_straight_below_there_is_an_elevation_but_no_azimuth():
    settings = make("far-field")
    bearing = make_estimator(settings)(plane_wave(settings, 0.0, -math.pi / 2))
    assert bearing.azimuth_rad is None
    assert bearing.elevation_rad == pytest.approx(-math.pi / 2, abs=0.01)


def test_delays_longer_than_the_array_lie_on_the_horizon_with_a_finite_sigma():
    settings = make("far-field")
    exact = plane_wave(settings, 0.5)
    bearing = make_estimator(settings)(tdoa(exact.delay_s * 1.05))
    assert bearing.azimuth_rad == pytest.approx(0.5, abs=1e-6)
    assert bearing.elevation_rad == pytest.approx(0.0, abs=1e-6)
    assert math.isfinite(bearing.elevation_sigma_rad)
    assert bearing.misfit > 5.0


def test_delays_that_contradict_each_other_widen_the_sigma():
    settings = make("far-field")
    exact = plane_wave(settings, 0.5, -0.5)
    twisted = exact.delay_s + np.array([30e-6, -30e-6, 30e-6])  # closes to 90 us instead of 0
    good, bad = (make_estimator(settings)(tdoa(d)) for d in (exact.delay_s, twisted))
    assert bad.misfit > 10.0
    assert bad.azimuth_sigma_rad > 10.0 * good.azimuth_sigma_rad


# --- silence and dead channels


@pytest.mark.parametrize("name", ["far-field", "hyperbolic", "two-mic"])
def test_silence_has_no_bearing(name):
    nothing = Tdoa(np.full(3, np.nan), np.full(3, np.inf), np.zeros(3))
    bearing = make_estimator(make(name))(nothing)
    assert bearing.azimuth_rad is None
    assert bearing.elevation_rad is None
    assert math.isfinite(bearing.azimuth_sigma_rad)


def test_a_triangle_with_a_dead_microphone_has_no_bearing():
    settings = make("far-field")
    exact = plane_wave(settings, 1.0, -0.5)
    dead = np.array([0 in pair for pair in settings.mic_array.pairs])
    bearing = make_estimator(settings)(
        Tdoa(np.where(dead, np.nan, exact.delay_s), np.where(dead, np.inf, SIGMA_S), np.where(dead, 0, 0.9))
    )
    assert bearing.azimuth_rad is None


def test_a_square_with_a_dead_microphone_still_has_one():
    settings = make("far-field", SQUARE)
    exact = plane_wave(settings, 1.0, -0.5)
    dead = np.array([0 in pair for pair in settings.mic_array.pairs])
    bearing = make_estimator(settings)(
        Tdoa(np.where(dead, np.nan, exact.delay_s), np.where(dead, np.inf, SIGMA_S), np.where(dead, 0, 0.9))
    )
    assert bearing.azimuth_rad == pytest.approx(1.0, abs=1e-9)


@given(st.lists(st.floats(-1e-3, 1e-3), min_size=3, max_size=3), st.floats(1e-8, 1e-3))
@pytest.mark.parametrize("name", ["far-field", "hyperbolic", "two-mic"])
def test_no_delays_whatever_give_nan(name, delays, sigma_s):
    bearing = make_estimator(make(name))(tdoa(np.array(delays), sigma_s))
    assert math.isfinite(bearing.azimuth_sigma_rad)
    assert math.isfinite(bearing.elevation_sigma_rad)
    assert not math.isnan(bearing.misfit)
    for angle in (bearing.azimuth_rad, bearing.elevation_rad):
        assert angle is None or math.isfinite(angle)


# --- two microphones


@given(st.floats(-89, 89))
def test_two_mic_is_arcsin(azimuth_deg):
    settings = make("two-mic", [[0, 0.05, 0], [0, -0.05, 0]])  # right, left: broadside is ahead
    bearing = make_estimator(settings)(plane_wave(settings, math.radians(azimuth_deg)))
    assert math.degrees(bearing.azimuth_rad) == pytest.approx(azimuth_deg, abs=1e-5)
    assert bearing.elevation_rad is None


def test_two_mic_sees_what_is_behind_as_its_mirror_ahead():
    settings = make("two-mic", [[0, 0.05, 0], [0, -0.05, 0]])
    bearing = make_estimator(settings)(plane_wave(settings, math.radians(150)))
    assert math.degrees(bearing.azimuth_rad) == pytest.approx(30, abs=1e-6)


def test_two_mic_in_line_with_the_nose_looks_right():
    settings = make("two-mic", [[0.05, 0, 0], [-0.05, 0, 0]])
    bearing = make_estimator(settings)(plane_wave(settings, math.radians(60)))
    assert math.degrees(bearing.azimuth_rad) == pytest.approx(60, abs=1e-6)


def test_two_mic_bears_a_tilted_pair():
    settings = make("two-mic", [[0, 0.05, 0.05], [0, -0.05, -0.05]])
    bearing = make_estimator(settings)(plane_wave(settings, math.radians(60)))
    assert math.degrees(bearing.azimuth_rad) == pytest.approx(60, abs=1e-6)


def test_two_mic_sigma_is_that_of_arcsin():
    settings = make("two-mic", [[0, 0.05, 0], [0, -0.05, 0]])
    bearing = make_estimator(settings)(plane_wave(settings, math.radians(60)))
    expected = settings.speed_m_s * SIGMA_S / (0.1 * math.cos(math.radians(60)))
    assert bearing.azimuth_sigma_rad == pytest.approx(expected, rel=1e-6)


# --- hyperbolic


@pytest.mark.parametrize("tilt_deg", [0, 10, 20, 45])
def test_hyperbolic_bears_a_tilted_array(tilt_deg):
    """Sources in the array's plane, where its position lies."""
    tilt = math.radians(tilt_deg)
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    settings = make("hyperbolic", (np.array(make("hyperbolic").array.positions_m) @ turn.T).tolist())
    at = 3.0 * turn @ direction(1.0)
    bearing = make_estimator(settings)(point(settings, at, sigma_s=1e-9))
    assert abs(wrap(bearing.azimuth_rad - math.atan2(at[1], at[0]))) < math.radians(0.3)


@given(AZIMUTH, st.floats(0.15, 1.5))
def test_hyperbolic_finds_near_positions(azimuth, range_m):
    """With four microphones; three leave a second position that fits as well."""
    settings = make("hyperbolic", SQUARE)
    at = range_m * direction(azimuth)
    fix = make_estimator(settings)(point(settings, at, sigma_s=1e-10)).fix
    np.testing.assert_allclose(fix.position_m, at, atol=1e-3)
    assert fix.range_m == pytest.approx(range_m, abs=1e-3)
    assert fix.range_observable


@given(AZIMUTH, st.floats(0.12, 1.5))
def test_a_range_called_observable_is_right(azimuth, range_m):
    """Three microphones may have two exact answers: then the range is not observable."""
    settings = make("hyperbolic")
    fix = make_estimator(settings)(point(settings, range_m * direction(azimuth), sigma_s=1e-9)).fix
    assert not fix.range_observable or abs(fix.range_m - range_m) < 4.0 * fix.range_sigma_m + 1e-3


@given(AZIMUTH, st.floats(20.0, 100.0))
def test_hyperbolic_bearing_holds_where_the_range_does_not(azimuth, range_m):
    settings = make("hyperbolic")
    at = range_m * direction(azimuth)
    bearing = make_estimator(settings)(point(settings, at, sigma_s=1e-6))
    assert abs(wrap(bearing.azimuth_rad - azimuth)) < math.radians(0.05)
    assert not bearing.fix.range_observable


def test_hyperbolic_in_space():
    settings = make("hyperbolic", TETRAHEDRON)
    at = 0.6 * direction(2.0, -0.6)
    bearing = make_estimator(settings)(point(settings, at, sigma_s=1e-8))
    np.testing.assert_allclose(bearing.fix.position_m, at, atol=2e-3)
    centre = settings.mic_array.positions_m.mean(axis=0)
    assert bearing.elevation_rad == pytest.approx(angles(at - centre)[1], abs=1e-3)


def test_the_covariance_of_a_position_is_true():
    """Normalised error squared of 2 unknowns: mean 2 (500 draws: +-0.27 at 3 sigma, +0.3 curvature)."""
    settings, rng = make("hyperbolic"), np.random.default_rng(3)
    estimate = make_estimator(settings)
    at = 0.4 * direction(0.9)
    exact = point(settings, at).delay_s
    sigma_s, score = 2e-8, []
    for _ in range(500):
        arrival = rng.standard_normal(3) * sigma_s / math.sqrt(2)
        noise = np.array([arrival[j] - arrival[i] for i, j in settings.mic_array.pairs])
        fix = estimate(tdoa(exact + noise, sigma_s)).fix
        error = (fix.position_m - at)[:2]
        score.append(error @ np.linalg.solve(fix.covariance_m2[:2, :2], error))
    assert 1.7 < np.mean(score) < 2.6


@given(AZIMUTH)
def test_hyperbolic_agrees_with_far_field_about_far_sources_on_the_horizon(azimuth):
    settings = make("hyperbolic")
    wave = plane_wave(settings, azimuth)
    far = make_estimator(make("far-field"))(wave)
    near = make_estimator(settings)(wave)
    assert abs(wrap(near.azimuth_rad - far.azimuth_rad)) < math.radians(0.1)
