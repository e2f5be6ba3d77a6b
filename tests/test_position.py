"""Positions: as good as physics allows, as certain as they are true, and none where there is none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.geodesy import moved
from locagen_edge.geometry import wrap
from locagen_edge.settings import PoseSettings, PositionSettings
from locagen_edge.sim.flights import Errors, Flight, drawn, fly, line, miss_m, normalised_error, orbit
from locagen_edge.stages.position import LOST_AFTER, Positioner, sighting
from locagen_edge.types import Pose, Position, Sighting, TrueBearing

SETTINGS = PositionSettings()
ATTITUDE = PoseSettings(compass_deg=3.0, tilt_deg=2.0)
EXACT = Errors(1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.0, 0.0, 0.0)
SURE = replace(SETTINGS, terrain_m=0.0, terrain_share=0.0, walk_m=0.0)
USUAL = Errors()
EAST = math.pi / 2.0


def follow(flight: Flight, settings: PositionSettings = SETTINGS) -> tuple[Positioner, Position | None]:
    positioner = Positioner(settings)
    for look in flight.sightings:
        positioner.see(look)
    return positioner, positioner.position(1, flight.sightings[-1].t_ns)


def found(flight: Flight, settings: PositionSettings = SETTINGS) -> Position:
    _, position = follow(flight, settings)
    assert position is not None
    assert position.range_observable
    return position


def distance_m(flight: Flight, position: Position) -> float:
    return math.hypot(*miss_m(flight, position.latitude_deg, position.longitude_deg))


def hover(rng, errors=USUAL, height_m=20.0, away_m=30.0, seconds=5.0, **more) -> Flight:
    path = line(seconds, 4.0, np.zeros(2), 0.0, rng.uniform(0, 2 * math.pi), height_m)
    azimuth = rng.uniform(0, 2 * math.pi)
    return fly(path, away_m * np.array([math.cos(azimuth), math.sin(azimuth)]), errors, rng, **more)


def passing(rng, errors=USUAL, **more) -> Flight:
    """20 m of path across the bearing of a caller 50 m away, in 4 s."""
    path = line(4.0, 4.0, np.array([0.0, -10.0]), 5.0, EAST, 20.0)
    return fly(path, np.array([50.0, 0.0]), errors, rng, **more)


# --- as good as it has to be --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("errors", "least_m", "most_m"),
    [
        (Errors(), 1.5, 3.0),  # 2 degrees of compass are 1.7 m at 50 m, GPS another 1.5 m per axis
        (Errors(compass_rad=0.0, tilt_rad=0.0, gps_m=0.0), 0.5, 2.0),  # one degree of noise alone
    ],
)
def test_bearings_of_one_degree_over_20_m_of_path_place_a_caller_50_m_away(errors, least_m, most_m):
    rng = np.random.default_rng(1)
    misses = []
    for _ in range(100):
        flight = passing(rng, errors, elevations=False)
        misses.append(distance_m(flight, found(flight)))
    assert least_m < np.median(misses) < most_m


def test_hovering_at_20_m_places_a_caller_30_m_out():
    rng = np.random.default_rng(2)
    one_degree_of_azimuth = math.radians(1.0) * 30.0 / math.hypot(20.0, 30.0)
    misses = []
    for _ in range(100):
        flight = hover(rng, Errors(cosine_rad=one_degree_of_azimuth))
        misses.append(distance_m(flight, found(flight)))
    assert 1.0 < np.median(misses) < 3.0


def test_without_noise_the_place_is_the_place():
    """Depression over height from one spot, bearings alone from a line, both from an orbit."""
    rng = np.random.default_rng(3)
    caller = np.array([30.0, 5.0])
    paths = [
        (line(3.0, 4.0, np.zeros(2), 0.0, 0.0, 20.0), True),
        (line(6.0, 4.0, np.zeros(2), 5.0, EAST, 20.0), False),
        (orbit(6.0, 4.0, caller, 25.0, 5.0, 20.0), True),
    ]
    for path, elevations in paths:
        flight = fly(path, caller, EXACT, rng, elevations=elevations)
        position = found(flight, SURE)
        assert distance_m(flight, position) < 0.2
        if elevations:
            assert position.altitude_m == pytest.approx(400.0, abs=0.2)


# --- as certain as it is true -------------------------------------------------------------------------


def test_errors_are_as_large_as_the_covariance_says_over_500_flights():
    """Normalised error squared: chi-square of 2 degrees of freedom, so its mean over n flights lies within
    2 +- 1.96 * 2 / sqrt(n) in 95 of 100 such tests, and 39.3 % and 95 % of it below 1 and 5.99."""
    rng = np.random.default_rng(4)
    values, unknown = [], 0
    for _ in range(500):
        flight = drawn(rng)
        _, position = follow(flight)
        if position is None or not position.range_observable:
            unknown += 1
            continue
        values.append(
            normalised_error(flight, position.latitude_deg, position.longitude_deg, position.covariance_m2)
        )
    assert unknown < 40  # a hover that sees far callers near the horizon
    n = len(values)
    assert abs(np.mean(values) - 2.0) < 1.96 * 2.0 / math.sqrt(n)
    assert abs(np.mean(np.array(values) < 1.0) - 0.393) < 3.0 * math.sqrt(0.393 * 0.607 / n)
    assert abs(np.mean(np.array(values) < 5.99) - 0.95) < 3.0 * math.sqrt(0.95 * 0.05 / n)


def test_a_pass_close_by_is_no_more_certain_than_it_is_right():
    """Where the bearing swings by 90 degrees within a look, and no tangent to it holds."""
    rng = np.random.default_rng(22)
    values = []
    for _ in range(40):
        path = line(20.0, 2.0, np.array([-50.0, 2.0]), 5.0, 0.0, 25.0)
        errors = Errors(cosine_rad=math.radians(2.0), gps_m=0.5)
        flight = fly(path, np.zeros(2), errors, rng, elevations=False)
        position = found(flight)
        values.append(
            normalised_error(flight, position.latitude_deg, position.longitude_deg, position.covariance_m2)
        )
    assert np.mean(values) < 2.0 + 1.96 * 2.0 / math.sqrt(len(values))


def test_two_vehicles_are_as_certain_as_they_are_right_and_better_than_one():
    rng = np.random.default_rng(5)
    values, one, two = [], [], []
    for _ in range(60):
        path = line(5.0, 2.0, np.array([0.0, -10.0]), 4.0, EAST, 25.0)
        first = fly(path, np.array([60.0, 0.0]), Errors(), rng, observer="A")
        path = line(5.0, 2.0, np.array([60.0, 50.0]), 4.0, math.pi, 25.0)
        second = fly(path, np.array([60.0, 0.0]), Errors(), rng, observer="B", like=first)
        positioner = Positioner(SETTINGS)
        for pair in zip(first.sightings, second.sightings, strict=True):
            for look in pair:
                assert positioner.see(look)
        both = positioner.position(1, first.sightings[-1].t_ns)
        assert both is not None
        one.append(distance_m(first, found(first)))
        two.append(distance_m(first, both))
        values.append(normalised_error(first, both.latitude_deg, both.longitude_deg, both.covariance_m2))
    assert abs(np.mean(values) - 2.0) < 1.96 * 2.0 / math.sqrt(len(values))
    assert np.median(two) < 0.8 * np.median(one)


def test_what_all_looks_share_does_not_average_out():
    """A compass error of 3 degrees moves a caller 40 m away by 2 m, however long one looks."""
    rng = np.random.default_rng(6)
    errors = replace(Errors(), compass_rad=math.radians(3.0), gps_m=0.1)
    short, long = (found(hover(rng, errors, away_m=40.0, seconds=s)) for s in (3.0, 30.0))
    across_m = 40.0 * math.radians(3.0)
    assert short.semi_minor_m > 0.8 * across_m
    assert long.semi_minor_m > 0.8 * across_m


def test_gps_and_compass_errors_of_the_settings_reach_the_ellipse():
    rng = np.random.default_rng(7)
    flight = hover(rng, EXACT)
    poor = [replace(look, position_sigma_m=5.0) for look in flight.sightings]
    assert found(replace(flight, sightings=tuple(poor))).semi_minor_m > 4.5


# --- an honest no -------------------------------------------------------------------------------------


def test_a_hover_without_height_has_a_bearing_and_no_place():
    rng = np.random.default_rng(8)
    for elevations, heights in ((False, True), (True, False), (False, False)):
        flight = hover(rng, elevations=elevations, heights=heights, seconds=30.0)
        _, position = follow(flight)
        assert position is not None
        assert not position.range_observable
        assert position.latitude_deg is None
        assert position.longitude_deg is None
        assert position.altitude_m is None
        away = miss_m(flight, flight.sightings[-1].latitude_deg, flight.sightings[-1].longitude_deg)
        azimuth = math.atan2(-away[1], -away[0])
        assert abs(wrap(position.azimuth_rad - azimuth)) < 4.0 * position.azimuth_sigma_rad
        assert math.radians(1.5) < position.azimuth_sigma_rad < math.radians(8.0)


def test_flying_straight_at_a_caller_does_not_tell_how_far():
    rng = np.random.default_rng(9)
    path = line(6.0, 2.0, np.zeros(2), 5.0, 0.0, 20.0)
    _, position = follow(fly(path, np.array([150.0, 0.0]), Errors(), rng, elevations=False))
    assert position is not None
    assert not position.range_observable


def test_a_caller_beyond_the_bank_has_no_place():
    rng = np.random.default_rng(10)
    near = replace(SETTINGS, range_m=(2.0, 60.0))
    path = line(10.0, 2.0, np.zeros(2), 8.0, EAST, 20.0)
    _, position = follow(fly(path, np.array([300.0, 40.0]), Errors(), rng, elevations=False), near)
    assert position is None or not position.range_observable


@given(
    st.sampled_from([name for name in Sighting.__slots__ if name not in ("t_ns", "observer", "caller")]),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_what_is_not_finite_is_counted_and_changes_nothing(name, value):
    flight = hover(np.random.default_rng(11), seconds=1.0)
    positioner, before = follow(flight)
    last = flight.sightings[-1]
    assert not positioner.see(replace(last, t_ns=last.t_ns + 10**9, **{name: value}))
    assert positioner.counters.unusable == 1
    after = positioner.position(1, last.t_ns)
    assert (after.latitude_deg, after.longitude_deg) == (before.latitude_deg, before.longitude_deg)
    assert not Positioner(SETTINGS).see(replace(last, **{name: value}))


def test_nothing_seen_is_nowhere():
    assert Positioner(SETTINGS).position(1, 0) is None
    assert Positioner(SETTINGS).positions(0) == ()


def test_a_place_grows_older_and_vaguer_and_is_forgotten():
    flight = hover(np.random.default_rng(12))
    positioner, now = follow(flight)
    t_ns = flight.sightings[-1].t_ns
    later = positioner.position(1, t_ns + 60 * 10**9)
    assert now.age_s == 0.0
    assert later.age_s == pytest.approx(60.0)
    # 0.1 m per square root of a second: 0.6 m2 a minute in each direction
    assert np.trace(later.covariance_m2 - now.covariance_m2) == pytest.approx(1.2, rel=0.01)
    assert positioner.position(1, t_ns + round((SETTINGS.forget_s + 1) * 1e9)) is None


# --- everywhere on earth ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "origin",
    [(0.0, 0.0), (-16.5, 179.9999), (-16.5, -179.9999), (78.2, 15.6), (89.999, 40.0), (-89.999, -170.0)],
)
def test_the_antimeridian_and_high_latitudes_are_like_any_place(origin):
    """111 m from the pole north turns by a degree with every 2 m of path."""
    rng = np.random.default_rng(13)
    path = line(10.0, 2.0, np.array([0.0, -20.0]), 5.0, EAST, 20.0)
    flight = fly(path, np.array([30.0, 15.0]), EXACT, rng, origin=origin)
    position = found(flight, SURE)
    assert distance_m(flight, position) < 0.3
    assert -180.0 <= position.longitude_deg <= 180.0
    last = flight.sightings[-1]
    away = -miss_m(flight, last.latitude_deg, last.longitude_deg)
    assert math.hypot(*away) == pytest.approx(math.hypot(30.0, 12.5), abs=0.1)


@given(st.floats(0, 2 * math.pi), st.floats(0, 60))
def test_straight_below_is_a_place_like_any_other(azimuth, height):
    """The azimuth of what is right below means nothing, and may be anything."""
    rng = np.random.default_rng(14)
    flight = hover(rng, EXACT, height_m=10.0 + height, away_m=0.01)
    below = [
        replace(
            look,
            azimuth_rad=azimuth,
            azimuth_sigma_rad=1.8,
            elevation_rad=-math.pi / 2,
            elevation_sigma_rad=0.02,
        )
        for look in flight.sightings
    ]
    position = found(replace(flight, sightings=tuple(below)))
    assert distance_m(flight, position) < 0.2
    assert position.semi_major_m < 0.05 * (10.0 + height) + 2.5


# --- other sounds -------------------------------------------------------------------------------------


def test_a_look_the_wrong_way_is_left_out():
    rng = np.random.default_rng(15)
    flight = passing(rng)
    positioner, before = follow(flight)
    last = flight.sightings[-1]
    behind = replace(last, t_ns=last.t_ns + 10**9, azimuth_rad=last.azimuth_rad + math.pi)
    assert not positioner.see(behind)
    assert positioner.counters.outside == 1
    after = positioner.position(1, last.t_ns)
    assert after.latitude_deg == before.latitude_deg
    assert after.looks == before.looks


def test_looks_that_insist_take_over():
    rng = np.random.default_rng(16)
    positioner, _ = follow(hover(rng, seconds=10.0))
    other = hover(rng, away_m=60.0, seconds=5.0)
    moved_on = [replace(look, t_ns=look.t_ns + 11 * 10**9) for look in other.sightings]
    for look in moved_on:
        positioner.see(replace(look, azimuth_rad=look.azimuth_rad))
    position = positioner.position(1, moved_on[-1].t_ns)
    assert positioner.counters.restarts == 1
    assert positioner.counters.outside == LOST_AFTER
    assert distance_m(other, position) < 4.0 * position.semi_major_m


def test_an_elevation_above_the_horizon_is_the_mirror_image_of_a_flat_array():
    rng = np.random.default_rng(17)
    flight = passing(rng)
    mirrored = [replace(look, elevation_rad=-look.elevation_rad) for look in flight.sightings]
    position = found(replace(flight, sightings=tuple(mirrored)))
    assert distance_m(flight, position) < 4.0 * position.semi_major_m


def test_looks_too_soon_after_one_another_are_thinned():
    """Frames that overlap share their noise: four times the looks are not four times the knowledge."""
    flight = hover(np.random.default_rng(18))
    positioner = Positioner(SETTINGS)
    for look in flight.sightings:
        assert positioner.see(look)
        assert not positioner.see(replace(look, t_ns=look.t_ns + 50_000_000))
    assert positioner.counters.thinned == len(flight.sightings)


def test_callers_are_bounded_and_the_longest_unheard_goes():
    flight = hover(np.random.default_rng(19))
    positioner = Positioner(replace(SETTINGS, callers=3))
    for caller in (1, 2, 3):
        positioner.see(replace(flight.sightings[caller], caller=caller))
    positioner.see(replace(flight.sightings[4], caller=1))
    positioner.see(replace(flight.sightings[5], caller=4))
    t_ns = flight.sightings[5].t_ns
    assert {position.caller for position in positioner.positions(t_ns)} == {1, 3, 4}


def test_a_blunt_look_begins_nothing():
    look = hover(np.random.default_rng(20), elevations=False).sightings[0]
    assert not Positioner(SETTINGS).see(replace(look, azimuth_sigma_rad=1.0))


# --- what is told -------------------------------------------------------------------------------------


def test_the_ellipse_is_that_of_the_covariance():
    """A caller due north of a hover: the depression is less certain than the azimuth."""
    rng = np.random.default_rng(21)
    path = line(5.0, 4.0, np.zeros(2), 0.0, 0.0, 20.0)
    errors = replace(Errors(), compass_rad=math.radians(0.5))
    position = found(fly(path, np.array([60.0, 0.0]), errors, rng))
    total = position.semi_major_m**2 + position.semi_minor_m**2
    assert total == pytest.approx(np.trace(position.covariance_m2))
    assert position.semi_major_m > 1.5 * position.semi_minor_m
    assert min(position.orientation_rad, math.pi - position.orientation_rad) < math.radians(10)
    assert 0.0 <= position.orientation_rad < math.pi


def test_a_pose_makes_a_sighting():
    half = math.radians(90.0) / 2.0
    pose = Pose(7, (math.cos(half), 0.0, 0.0, math.sin(half)), 47.0, 8.0, 420.0, 20.0, 0.5)
    seen = TrueBearing(1.0, 0.02, -0.6, 0.03)
    look = sighting(pose, seen, 3, SETTINGS, ATTITUDE, tolerance_rad=0.01)
    assert look.heading_rad == pytest.approx(math.radians(90.0))
    assert look.azimuth_bias_sigma_rad == pytest.approx(math.hypot(math.radians(3.0), 0.01))
    assert look.elevation_bias_sigma_rad == pytest.approx(math.hypot(math.radians(2.0), 0.01))
    positioner = Positioner(SETTINGS)
    assert positioner.see(look)
    position = positioner.position(3, 7)
    reach = 20.0 / math.tan(0.6)
    lat, lon, _ = moved(47.0, 8.0, 0.0, reach * np.array([math.cos(1.0), math.sin(1.0), 0.0]))
    assert position.latitude_deg == pytest.approx(lat, abs=2e-5)  # 2 m: a bank's mean, not its middle
    assert position.longitude_deg == pytest.approx(lon, abs=3e-5)
    assert position.altitude_m == pytest.approx(400.0, abs=1.0)
    assert sighting(Pose(7, None), seen, 3, SETTINGS, ATTITUDE) is None
