"""Laws of the filter on the sphere: errors are what it says they are, everywhere, and no axes are special."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locagen_edge.geometry import angles, direction, quaternion, rotation, tangent
from locagen_edge.settings import TrackSettings
from locagen_edge.stages.track import filter as sphere
from locagen_edge.stages.track.association import associate
from locagen_edge.types import Bearing

HOP_S = 0.0512
MOTIONS = {"earth": sphere.earth_motion(TrackSettings()), "body": sphere.body_motion(TrackSettings())}
LEVEL = np.eye(3)


def bearing(azimuth: float, elevation: float | None, sigma: float, up: float = math.inf) -> Bearing:
    """`sigma` across the direction, radians."""
    azimuth_sigma = sigma / max(math.cos(elevation or 0.0), 1e-3)
    return Bearing(azimuth, azimuth_sigma, elevation, min(up, 1.8), 0.5, "far-field")


def measurement(b: Bearing, turn=LEVEL) -> sphere.Measurement:
    return sphere.measured(b, turn, fixed=0.0, inflation=1.0, moved=0.0)


def noisy(u: np.ndarray, turn: np.ndarray, sigma: float, rng: np.random.Generator) -> sphere.Measurement:
    """What an estimator with this sigma would say of a source at u (in the filter's axes)."""
    here = turn.T @ u
    seen = here + sigma * rng.standard_normal(2) @ tangent(here)
    azimuth, elevation = angles(seen / np.linalg.norm(seen))
    return measurement(bearing(azimuth, elevation, sigma, sigma), turn)


def error2(state: sphere.State, u: np.ndarray) -> float:
    """Normalised estimation error squared of the direction: chi-square of 2 where the covariance is true."""
    across = tangent(state.u)
    off = across @ (u - state.u)
    return float(off @ np.linalg.solve(across @ state.p[:3, :3] @ across.T, off))


def moved(u: np.ndarray, rate: np.ndarray, motion: sphere.Motion, rng) -> tuple[np.ndarray, np.ndarray]:
    """One hop of a caller who moves as the model says, in three steps."""
    for _ in range(3):
        dt = HOP_S / 3
        turn = (rate + motion.wobble_rad * rng.standard_normal(3) * [1, 1, 0] / math.sqrt(dt)) * dt
        stepped = u + np.cross(turn, u)
        u = stepped / np.linalg.norm(stepped)
        rate = motion.axes(u) @ (rate + motion.agility_rad * math.sqrt(dt) * rng.standard_normal(3))
    return u, rate


@pytest.mark.parametrize("axes", MOTIONS)
@pytest.mark.parametrize("elevation_deg", [0, -45, -80, -90])
def test_errors_are_as_large_as_the_covariance_says(axes, elevation_deg):
    """100 callers who move as the model says, under a drone that leans and turns at random: the sum of 100
    normalised errors squared is chi-square of 200, within 200 +- 3.3 sqrt(400) but for 1 in 1000. The
    bounds are 10 % wider, since 2-degree bearings and a first rate of 10 to 30 degrees/s are not quite
    linear, and seven times are looked at."""
    motion, rng = MOTIONS[axes], np.random.default_rng(elevation_deg % 360 + len(axes))
    sigma, runs, frames = math.radians(2.0), 100, 28
    scores = np.zeros((runs, frames))
    for run in range(runs):
        u = direction(rng.uniform(-math.pi, math.pi), math.radians(elevation_deg))
        rate = motion.first_rate_rad_s * motion.axes(u) @ rng.standard_normal(3)
        turns = [rotation(quaternion(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-3, 3))) for _ in range(frames)]
        if axes == "body":
            turns = [LEVEL] * frames
        state = sphere.born(noisy(u, turns[0], sigma, rng), motion)
        for frame in range(frames):
            u, rate = moved(u, rate, motion, rng)
            state = sphere.predicted(state, motion, HOP_S)
            if frame % 13 < 9:  # a pause now and then
                seen = sphere.innovation(state, noisy(u, turns[frame], sigma, rng))
                state = sphere.updated(state, seen, motion)
            scores[run, frame] = error2(state, u)
    sums = scores.sum(axis=0)[3::4]
    spread = 3.3 * math.sqrt(4 * runs)
    assert np.all((sums > (2 * runs - spread) / 1.1) & (sums < (2 * runs + spread) * 1.1)), sums / runs


ANGLE = st.floats(-math.pi, math.pi)
STEEP = st.floats(-math.pi / 2, math.pi / 2)


@settings(max_examples=25, deadline=None)
@given(ANGLE, STEEP, ANGLE, ANGLE, st.integers(0, 2**32 - 1))
def test_no_azimuth_and_no_attitude_is_special(azimuth, elevation, yaw, lean, seed):
    """In the earth's axes all directions are alike: turn everything, and the filter's answer is turned."""
    motion, rng = MOTIONS["earth"], np.random.default_rng(seed)
    turn = rotation(quaternion(lean / 2, lean / 3, yaw))
    u = direction(azimuth, elevation)
    states = []
    draws = rng.integers(0, 2**32, 12)
    for axes in (LEVEL, turn):
        state = None
        for draw in draws:
            m = noisy(axes @ u, axes, 0.03, np.random.default_rng(draw))
            if state is None:
                state = sphere.born(m, motion)
            state = sphere.predicted(state, motion, HOP_S)
            state = sphere.updated(state, sphere.innovation(state, m), motion)
        states.append(state)
    level, turned = states
    np.testing.assert_allclose(turned.u, turn @ level.u, atol=1e-7)
    np.testing.assert_allclose(turned.rate, turn @ level.rate, atol=1e-6)
    np.testing.assert_allclose(turned.p[:3, :3], turn @ level.p[:3, :3] @ turn.T, atol=1e-8)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(ANGLE, st.none() | STEEP, st.floats(0, 1.8), st.floats(0, 1.8), ANGLE), max_size=8),
    st.sampled_from(sorted(MOTIONS)),
    st.floats(0, 60),
)
def test_any_bearings_leave_a_unit_vector_and_a_covariance(bearings, axes, dt):
    motion = MOTIONS[axes]
    state = sphere.born(measurement(bearing(0.0, None, 0.1)), motion)
    for azimuth, elevation, sigma, up, lean in bearings:
        state = sphere.predicted(state, motion, dt)
        turn = LEVEL if axes == "body" else rotation(quaternion(lean, lean / 4, 2 * lean))
        seen = sphere.innovation(state, measurement(bearing(azimuth, elevation, sigma, up), turn))
        state = sphere.updated(state, seen, motion)
        assert np.linalg.norm(state.u) == pytest.approx(1.0, abs=1e-9)
        largest = np.abs(state.p).max()
        np.testing.assert_allclose(state.p, state.p.T, atol=1e-9 * largest)
        assert np.linalg.eigvalsh(state.p)[0] > -1e-7 * largest  # rounding: 1e-12 beside 60 s of rates


def test_one_more_bearing_never_makes_it_less_sure():
    motion = MOTIONS["earth"]
    state = sphere.born(measurement(bearing(1.0, -0.5, 0.05, 0.1)), motion)
    for elevation, up in [(-0.5, 0.1), (-0.2, 0.9), (None, 0.1)]:
        after = sphere.updated(
            state, sphere.innovation(state, measurement(bearing(1.0, elevation, 0.05, up))), motion
        )
        assert np.trace(after.p[:3, :3]) <= np.trace(state.p[:3, :3])
        state = after


def test_other_axes_are_one_rotation_away_and_back():
    turn = rotation(quaternion(0.2, -0.3, 2.0))
    state = sphere.born(measurement(bearing(1.0, -0.5, 0.05, 0.1)), MOTIONS["body"])
    there = sphere.in_other_axes(state, turn, MOTIONS["earth"])
    back = sphere.in_other_axes(there, turn.T, MOTIONS["body"])
    np.testing.assert_allclose(there.u, turn @ state.u)
    np.testing.assert_allclose(back.u, state.u, atol=1e-15)
    np.testing.assert_allclose(back.p, state.p, atol=1e-12)


# --- which bearing belongs to which track


def test_all_pairs_together_cost_least_and_not_the_first_alone():
    """The first bearing is nearest to track 0, but track 0 is all that the second can have."""
    assert associate([[1.0, 2.0], [1.5, math.inf]]) == (1, 0)
    assert associate([[1.0, 9.0], [9.0, 1.0]]) == (0, 1)
    assert associate([[math.inf, math.inf]]) == (None,)
    assert associate([]) == ()
    assert associate([[], []]) == (None, None)


@given(
    st.integers(0, 4).flatmap(
        lambda tracks: st.lists(
            st.lists(st.floats(-5, 16) | st.just(math.inf), min_size=tracks, max_size=tracks), max_size=3
        )
    )
)
def test_no_track_gets_two_bearings_and_none_outside_its_gate(costs):
    pairing = associate(costs)
    assert len(pairing) == len(costs)
    used = [track for track in pairing if track is not None]
    assert len(set(used)) == len(used)
    for row, track in zip(costs, pairing, strict=True):
        assert track is None or math.isfinite(row[track])
        if track is None:  # left over only where nothing free was within its gate
            assert all(math.isinf(c) or k in used for k, c in enumerate(row))
