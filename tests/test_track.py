"""Laws of the tracker: birth, the seam at 360 degrees, coasting, death, a sigma that means something; several
callers, and the earth's axes under a drone that turns."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locagen_edge.geometry import angles, direction, quaternion, rotation, wrap
from locagen_edge.settings import PoseSettings, TrackSettings
from locagen_edge.stages.track import Tracker
from locagen_edge.stages.track.tracker import SWELL_S
from locagen_edge.types import Bearing, Detection, Quaternion, Track

HOP_S = 0.0512
CALL = Detection(call=True, snr_db=10.0, level_dbfs=-30.0)
QUIET = Detection(call=False, snr_db=-20.0, level_dbfs=-50.0)


def heard(azimuth_deg: float | None, sigma_deg: float = 2.0, elevation_deg: float | None = -20.0) -> Bearing:
    return Bearing(
        azimuth_rad=None if azimuth_deg is None else wrap(math.radians(azimuth_deg)),
        azimuth_sigma_rad=math.radians(sigma_deg),
        elevation_rad=None if elevation_deg is None else math.radians(elevation_deg),
        elevation_sigma_rad=math.radians(5.0),
        misfit=0.5,
        estimator="far-field",
    )


def tracker(
    tolerance_deg: float = 0.0,
    compass_deg: float = 3.0,
    tilt_deg: float = 1.0,
    normal: np.ndarray | None = None,
    **changed,
) -> Tracker:
    pose = PoseSettings(compass_deg=compass_deg, tilt_deg=tilt_deg)
    return Tracker(TrackSettings(**changed), pose, math.radians(tolerance_deg), 1.0, normal)


def run(t: Tracker, bearings: list[Bearing], detection: Detection = CALL) -> list[Track | None]:
    """The best track after each frame that holds one bearing."""
    return [next(iter(t((bearing,), detection, HOP_S)), None) for bearing in bearings]


def error_deg(track: Track, azimuth_deg: float) -> float:
    return math.degrees(wrap(track.azimuth_rad - math.radians(azimuth_deg)))


def test_nothing_calls_nothing_is_tracked():
    assert run(tracker(), [heard(10.0)] * 5, QUIET) == [None] * 5


def test_it_is_born_with_the_first_call():
    (track,) = run(tracker(), [heard(10.0)])
    assert track is not None
    assert error_deg(track, 10.0) == pytest.approx(0.0, abs=1e-9)
    assert track.age_s == 0.0


def test_sigma_shrinks_with_evidence_and_is_true():
    """100 runs of 40 bearings of a fixed caller: normalised error squared has mean 1 (+-0.42 at 3 sigma,
    below 1 since a fixed caller is more docile than the model)."""
    rng, score = np.random.default_rng(5), []
    for _ in range(100):
        tracks = run(tracker(), [heard(100.0 + 2.0 * rng.standard_normal()) for _ in range(40)])
        last = tracks[-1]
        assert last.azimuth_sigma_rad < math.radians(1.2)
        score.append((error_deg(last, 100.0) / math.degrees(last.azimuth_sigma_rad)) ** 2)
    assert 0.3 < np.mean(score) < 1.3


def test_it_goes_through_north_without_a_jump():
    t = tracker()
    azimuths = np.arange(340.0, 380.0, 0.5)  # 10 degrees a second
    tracks = run(t, [heard(a) for a in azimuths])
    for track, azimuth in zip(tracks[40:], azimuths[40:], strict=True):
        assert abs(error_deg(track, azimuth)) < 1.5


def test_a_turning_drone_does_not_make_it_lag():
    rate_deg_s = 60.0
    azimuths = [rate_deg_s * HOP_S * k for k in range(60)]
    tracks = run(tracker(), [heard(a) for a in azimuths])
    assert abs(error_deg(tracks[-1], azimuths[-1])) < 1.0


def test_it_coasts_through_a_pause_with_a_growing_sigma_and_dies():
    t = tracker(coast_s=1.0)
    before = run(t, [heard(50.0)] * 30)[-1]
    pause = run(t, [heard(None)] * 30, QUIET)
    alive = [track for track in pause if track is not None]
    assert len(alive) == math.floor(1.0 / HOP_S)
    assert alive[-1].azimuth_sigma_rad > before.azimuth_sigma_rad
    assert alive[-1].silent_s == pytest.approx(len(alive) * HOP_S)
    assert alive[-1].confidence < 0.5 < before.confidence
    assert pause[-1] is None


def test_a_new_call_after_death_is_a_new_track():
    t = tracker(coast_s=0.2)
    run(t, [heard(50.0)] * 30)
    run(t, [heard(None)] * 10, QUIET)
    (track,) = run(t, [heard(200.0)])
    assert error_deg(track, 200.0) == pytest.approx(0.0, abs=1e-9)


def test_one_frame_after_a_pause_is_not_much_confidence():
    t = tracker(coast_s=3.0)
    run(t, [heard(50.0)])
    run(t, [heard(None)] * 35, QUIET)
    (track,) = run(t, [heard(50.0)])
    assert track.confidence < 0.2


def test_a_single_wrong_bearing_is_left_out():
    t = tracker()
    run(t, [heard(50.0)] * 30)
    (track,) = run(t, [heard(170.0)])
    assert abs(error_deg(track, 50.0)) < 0.5


def test_it_gives_way_to_a_caller_elsewhere_who_stays():
    t = tracker()
    run(t, [heard(50.0)] * 30)
    tracks = run(t, [heard(170.0)] * 6)  # a quarter of a second, in which the old one might go on
    assert abs(error_deg(tracks[-1], 170.0)) < 1.0


def test_position_errors_do_not_average_out():
    tracks = run(tracker(tolerance_deg=1.5), [heard(50.0)] * 200)
    assert tracks[-1].azimuth_sigma_rad >= math.radians(1.5)


def test_calls_without_a_bearing_do_not_disturb():
    t = tracker()
    run(t, [heard(50.0)] * 30)
    (track,) = run(t, [heard(None)])
    assert abs(error_deg(track, 50.0)) < 0.5


def test_elevation_is_smoothed_and_may_be_absent():
    assert run(tracker(), [heard(0.0, elevation_deg=None)] * 3)[-1].elevation_rad is None
    rng = np.random.default_rng(2)
    bearings = [heard(0.0, elevation_deg=-20 + 5 * rng.standard_normal()) for _ in range(60)]
    last = run(tracker(), bearings)[-1]
    assert math.degrees(last.elevation_rad) == pytest.approx(-20, abs=4)
    assert last.elevation_sigma_rad < math.radians(2.5)


# --- several callers


def pair(first_deg: float, second_deg: float, rng: np.random.Generator) -> tuple[Bearing, Bearing]:
    return tuple(
        heard(a + 2.0 * rng.standard_normal(), elevation_deg=-20 + 5 * rng.standard_normal())
        for a in (first_deg, second_deg)
    )


def test_two_callers_at_once_are_two_tracks_that_keep_their_ids():
    """Which of them is the stronger changes from frame to frame, and with it their order."""
    t, rng = tracker(), np.random.default_rng(1)
    ids, best = set(), set()
    for frame in range(200):
        bearings = pair(40.0, 100.0, rng)
        tracks = t(bearings[:: rng.choice([1, -1])], CALL, HOP_S)
        if frame > 10:
            assert len(tracks) == 2
            ids |= {(track.id, round(error_deg(track, 40.0) / 60.0)) for track in tracks}
            best.add(tracks[0].id)
            assert all(track.confirmed for track in tracks)
    assert len(ids) == 2
    assert len(best) == 1  # the first does not change with every frame


def test_two_callers_by_turns_are_two_tracks():
    t, rng = tracker(), np.random.default_rng(2)
    for _ in range(100):
        tracks = t((heard(rng.choice([10.0, -90.0]) + 2.0 * rng.standard_normal()),), CALL, HOP_S)
    azimuths = sorted(math.degrees(track.azimuth_rad) for track in tracks if track.confirmed)
    assert azimuths == pytest.approx([-90.0, 10.0], abs=4.0)


def test_crossing_callers_are_never_more_than_two():
    """One at 20, one goes by at 30 degrees/s, through it: near each other they are one."""
    t, rng = tracker(), np.random.default_rng(3)
    for frame in range(120):
        tracks = t(pair(20.0, -70.0 + 30.0 * HOP_S * frame, rng), CALL, HOP_S)
        assert len([track for track in tracks if track.confirmed]) <= 2
    assert sorted(error_deg(track, 20.0) for track in tracks) == pytest.approx([0.0, 94.3], abs=4.0)


def test_one_caller_heard_twice_is_one_track():
    t, rng = tracker(), np.random.default_rng(4)
    for _ in range(100):
        tracks = t(pair(40.0, 43.0, rng), CALL, HOP_S)
        assert len(tracks) <= 2  # a second one is born now and then, and not confirmed
    assert len([track for track in tracks if track.confirmed]) == 1


def test_bearings_from_nowhere_are_not_confirmed():
    """Anywhere at random, one a frame: of 300 births few live to be confirmed (3 %, and merges)."""
    t, rng, confirmed = tracker(), np.random.default_rng(5), set()
    for _ in range(300):
        bearing = heard(rng.uniform(0, 360), elevation_deg=rng.uniform(-80, 0))
        confirmed |= {track.id for track in t((bearing,), CALL, HOP_S) if track.confirmed}
    assert len(confirmed) < 0.1 * 300


def test_no_more_tracks_than_the_settings_say_and_the_best_stay():
    t, rng = tracker(most=2), np.random.default_rng(6)
    for _ in range(60):
        first = t(pair(0.0, 90.0, rng), CALL, HOP_S)
    for _ in range(60):
        clutter = heard(rng.uniform(160, 300), elevation_deg=rng.uniform(-60, 0))
        tracks = t((*pair(0.0, 90.0, rng), clutter)[:: rng.choice([1, -1])], CALL, HOP_S)
        assert len(tracks) <= 2
    assert first[0].id in {track.id for track in tracks}


@given(st.lists(st.lists(st.tuples(st.floats(-180, 180), st.floats(0, 60)), max_size=4), max_size=10))
def test_ids_are_never_shared(frames):
    t = tracker()
    for frame in frames:
        tracks = t(tuple(heard(azimuth, sigma) for azimuth, sigma in frame), CALL, HOP_S)
        assert len({track.id for track in tracks}) == len(tracks) <= 4


# --- the earth's axes


def seen(azimuth_deg: float, elevation_deg: float, attitude: Quaternion, rng=None, sigma_deg=2.0) -> Bearing:
    """What the array says of a caller at these angles from true north and over the horizon."""
    noise = (0.0, 0.0) if rng is None else math.radians(sigma_deg) * rng.standard_normal(2)
    here = rotation(attitude).T @ direction(math.radians(azimuth_deg), math.radians(elevation_deg))
    a, e = angles(here)
    here = here + noise @ np.stack([[-math.sin(a), math.cos(a), 0], [-math.sin(e) * math.cos(a),
                                    -math.sin(e) * math.sin(a), -math.cos(e)]])  # fmt: skip
    azimuth, elevation = angles(here)
    sigma = math.radians(sigma_deg)
    return Bearing(azimuth, sigma / max(math.cos(elevation), 0.05), elevation, sigma, 0.5, "far-field")


def turning(frame: int, rate_deg_s: float, lean: float = 0.2) -> Quaternion:
    """A drone that turns, and leans as it does."""
    t = frame * HOP_S
    return quaternion(lean * math.sin(2 * t), lean * math.cos(3 * t), wrap(math.radians(rate_deg_s * t)))


def true_off_deg(track: Track, azimuth_deg: float) -> float:
    return math.degrees(wrap(track.earth.azimuth_rad - math.radians(azimuth_deg)))


@pytest.mark.parametrize("rate_deg_s", [0.0, 30.0, -60.0])
@pytest.mark.parametrize("elevation_deg", [-5.0, -45.0, -75.0])
def test_a_caller_who_stands_still_under_a_turning_drone_does_so_in_the_track(rate_deg_s, elevation_deg):
    """12 runs. The mean error, which would be a lag, is within 3.3 sigma of nothing; the sigma shrinks to
    half of one bearing's (with what the drone turns between the frame's middle and the loudest moment of its
    sound), and tells the spread."""
    rng, offs, sigmas = np.random.default_rng(7), [], []
    for _ in range(12):
        t = tracker(compass_deg=0.0, tilt_deg=0.0)
        for frame in range(60):
            attitude = turning(frame, rate_deg_s)
            track, *_ = t((seen(200.0, elevation_deg, attitude, rng),), CALL, HOP_S, attitude)
            if frame in (0, 5, 20):
                sigmas.append(track.earth.azimuth_sigma_rad)
        assert track.id == 1
        offs.append(true_off_deg(track, 200.0) * math.cos(math.radians(elevation_deg)))
    early, later, last = np.degrees(np.reshape(sigmas, (-1, 3)).mean(axis=0))
    assert early > later > last
    across = last * math.cos(math.radians(elevation_deg))
    assert across < 0.5 * math.hypot(2.0, SWELL_S * rate_deg_s)
    assert abs(np.mean(offs)) < 3.3 * across / math.sqrt(12)
    assert 0.4 * across < np.std(offs) < 1.4 * across  # stiller than the model: rather less than it says


def test_true_bearings_are_as_far_off_as_they_say_with_a_compass_and_a_horizon_that_are_wrong():
    """120 vehicles, each with a heading (3 degrees) and a horizon (1 degree) of its own error, 40 bearings:
    normalised errors squared have the mean 1, +-0.43 at 3.3 sigma of 120; rather less, since the caller
    stands stiller than the model."""
    rng, azimuths, elevations = np.random.default_rng(12), [], []
    for _ in range(120):
        t = tracker(compass_deg=3.0, tilt_deg=1.0)
        wrong = rotation(
            quaternion(*np.radians(rng.standard_normal(2)), math.radians(3.0) * rng.standard_normal())
        )
        for frame in range(40):
            attitude = turning(frame, 20.0)
            caller = wrong @ direction(math.radians(120.0), math.radians(-40.0))
            there = [math.degrees(angle) for angle in angles(caller)]
            track, *_ = t((seen(*there, attitude, rng),), CALL, HOP_S, attitude)
        azimuths.append(true_off_deg(track, 120.0) / math.degrees(track.earth.azimuth_sigma_rad))
        off = track.earth.elevation_rad - math.radians(-40.0)
        elevations.append(off / track.earth.elevation_sigma_rad)
    for scores in (azimuths, elevations):
        assert 0.5 < np.mean(np.square(scores)) < 1.43


def test_what_the_body_sees_turns_with_it_and_is_surer_than_the_compass():
    t = tracker(compass_deg=3.0, tilt_deg=1.0)
    for frame in range(60):
        attitude = turning(frame, 45.0)
        bearing = seen(200.0, -30.0, attitude)
        (track,) = t((bearing,), CALL, HOP_S, attitude)
    assert wrap(track.azimuth_rad - bearing.azimuth_rad) == pytest.approx(0.0, abs=1e-3)
    assert track.elevation_rad == pytest.approx(bearing.elevation_rad, abs=1e-3)
    assert track.earth.elevation_rad == pytest.approx(math.radians(-30.0), abs=1e-3)
    assert track.azimuth_sigma_rad < math.radians(2.0)
    assert track.earth.azimuth_sigma_rad > math.radians(3.0)
    assert track.earth.elevation_sigma_rad > math.radians(1.0)


def test_a_look_is_the_frames_own_bearing_in_the_earths_axes():
    """Not smoothed, and with its noise alone: no compass, no tolerance."""
    t, rng = tracker(tolerance_deg=0.5), np.random.default_rng(13)
    for frame in range(30):
        attitude = turning(frame, 0.0)
        bearing = seen(200.0, -30.0, attitude, rng)
        track, *_ = t((bearing,), CALL, HOP_S, attitude)
        wanted = angles(rotation(attitude) @ direction(bearing.azimuth_rad, bearing.elevation_rad))
        assert (track.look.azimuth_rad, track.look.elevation_rad) == pytest.approx(wanted)
    sigmas = math.degrees(track.look.azimuth_sigma_rad), math.degrees(track.look.elevation_sigma_rad)
    noise = math.sqrt(2.0**2 - 0.5**2)
    leaning = math.hypot(noise, 0.02 * 40.0)  # what the lean, 40 degrees/s at most, moves it
    assert noise / math.cos(math.radians(30)) - 0.1 < sigmas[0] < leaning / math.cos(math.radians(30)) + 0.1
    assert noise - 0.01 < sigmas[1] < leaning + 0.01
    assert t((), QUIET, HOP_S, attitude)[0].look is None
    assert t((bearing,), CALL, HOP_S, None)[0].look is None


def test_a_turn_in_the_silence_is_followed_by_what_the_body_sees():
    """The caller is silent while the drone turns by 90 degrees, and is found again where it was."""
    t = tracker(coast_s=5.0)
    for frame in range(40):
        (track,) = t((seen(10.0, -30.0, turning(frame, 0.0)),), CALL, HOP_S, turning(frame, 0.0))
    for _ in range(40):
        (track,) = t((), QUIET, HOP_S, turning(frame, 0.0))
    north = track.earth.azimuth_rad
    (turned,) = t((), QUIET, HOP_S, quaternion(0.0, 0.0, math.pi / 2))
    assert turned.earth.azimuth_rad == pytest.approx(north, abs=1e-2)
    assert error_deg(turned, 10.0 - 90.0) == pytest.approx(0.0, abs=2.0)


@pytest.mark.parametrize("rate_deg_s", [0.0, 45.0])
def test_when_the_attitude_goes_and_comes_back_nothing_jumps_and_no_track_is_lost(rate_deg_s):
    """Two callers. What the body is told of moves by no more than the drone turns in a frame and the noise
    of a bearing; the sigma, which has to learn the drone's rate anew, never grows beyond a bearing's own by
    half."""
    t, rng = tracker(), np.random.default_rng(8)
    for frame in range(200):
        attitude = turning(frame, rate_deg_s, lean=0.05)
        bearings = tuple(seen(a, e, attitude, rng) for a, e in ((200.0, -30.0), (300.0, -50.0)))
        known = not 60 <= frame < 120
        tracks = t(bearings, CALL, HOP_S, attitude if known else None)
        tracks = [track for track in tracks if track.confirmed]
        if frame < 10:
            continue
        assert {track.id for track in tracks} == {1, 2}
        assert all((track.earth is not None) == known for track in tracks)
        for track in tracks:
            bearing = bearings[track.id - 1]
            off = direction(track.azimuth_rad, track.elevation_rad)
            off = off - direction(bearing.azimuth_rad, bearing.elevation_rad)
            assert math.degrees(np.linalg.norm(off)) < 4.5 * 2.0
            assert track.azimuth_sigma_rad * math.cos(track.elevation_rad) < math.radians(3.0)


def test_without_a_pose_for_one_frame_the_body_sees_what_it_saw():
    """To the digit: the change of axes itself moves nothing."""
    t = tracker()
    attitude = quaternion(0.1, -0.2, 2.5)
    for _ in range(20):
        (before,) = t((seen(200.0, -30.0, attitude),), CALL, HOP_S, attitude)
    (there,) = t((), QUIET, 0.0, None)
    (back,) = t((), QUIET, 0.0, attitude)
    for track in (there, back):
        assert track.azimuth_rad == pytest.approx(before.azimuth_rad, abs=1e-12)
        assert track.elevation_rad == pytest.approx(before.elevation_rad, abs=1e-12)
        assert track.azimuth_sigma_rad == pytest.approx(before.azimuth_sigma_rad, rel=1e-9)


def test_a_caller_straight_below_is_one_track():
    """Its azimuth means nothing, and its direction is known as well as any."""
    t, rng = tracker(tolerance_deg=0.2), np.random.default_rng(9)
    for frame in range(100):
        attitude = turning(frame, 60.0, lean=0.05)
        tracks = t((seen(0.0, -89.0, attitude, rng),), CALL, HOP_S, attitude)
        assert tracks[0].id == 1
    assert math.degrees(tracks[0].earth.elevation_rad) < -87.5
    assert tracks[0].earth.elevation_sigma_rad < math.radians(1.6)  # tilt's 1 degree in it
    assert tracks[0].earth.azimuth_sigma_rad > math.radians(20.0)


def test_flying_past_a_caller_does_not_make_it_lag():
    """10 m/s in 20 m above and 20 m beside: the bearing turns by up to 20 degrees/s."""
    t, rng, offs = tracker(), np.random.default_rng(10), []
    for frame in range(240):
        place = np.array([60.0 - 10.0 * frame * HOP_S, 20.0, 20.0])
        azimuth, elevation = angles(place)
        attitude = quaternion(0.0, -0.2, 0.0)
        bearing = seen(math.degrees(azimuth), math.degrees(elevation), attitude, rng)
        (track,) = t((bearing,), CALL, HOP_S, attitude)
        offs.append(true_off_deg(track, math.degrees(azimuth)))
    assert np.abs(offs[20:]).max() < 4.0
    assert abs(np.mean(offs[20:])) < 0.5


def lower(bearing: Bearing) -> Bearing:
    """What a level flat array makes of it."""
    return replace(bearing, elevation_rad=-abs(bearing.elevation_rad))


@pytest.mark.parametrize("mirrors", [True, False])
def test_a_caller_near_the_horizon_stays_where_it_is_when_a_drone_with_a_flat_array_leans(mirrors):
    """10 degrees below the horizon ahead, the nose goes down by up to 30: the body has the caller above its
    own horizon, and the array puts it 40 degrees below the true one. Who does not know that loses it."""
    rng, ids, offs = np.random.default_rng(11), set(), []
    normal = np.array([0.0, 0.0, 1.0]) if mirrors else None
    t = tracker(normal=normal)
    for frame in range(150):
        attitude = quaternion(0.0, math.radians(-15.0 + 15.0 * math.cos(frame * HOP_S)), 0.0)
        tracks = t((lower(seen(5.0, -10.0, attitude, rng)),), CALL, HOP_S, attitude)
        ids |= {track.id for track in tracks if track.confirmed}
        offs.append(math.degrees(tracks[0].earth.elevation_rad) + 10.0)
    if mirrors:
        assert ids == {1}
        assert np.abs(offs[10:]).max() < 6.0  # where the two answers meet, they push each other apart
    else:
        assert np.abs(offs).max() > 20.0


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.none() | st.tuples(*[st.floats(-7, 7)] * 3),
            st.lists(
                st.tuples(
                    st.none() | st.floats(-180, 180) | st.just(math.nan),
                    st.floats(0, 104) | st.sampled_from([math.nan, math.inf]),
                    st.none() | st.floats(-90, 90) | st.just(math.nan),
                ),
                max_size=3,
            ),
            st.booleans(),
            st.sampled_from([0.0, HOP_S, 1.9, 700.0]),
        ),
        max_size=15,
    )
)
def test_whatever_comes_what_is_told_is_a_direction(frames):
    t = tracker(tolerance_deg=0.3, coast_s=600.0)
    for lean, bearings, call, elapsed_s in frames:
        attitude = None if lean is None else quaternion(*lean)
        found = tuple(heard(azimuth, sigma, elevation) for azimuth, sigma, elevation in bearings)
        for track in t(found, CALL if call else QUIET, elapsed_s, attitude):
            told = [track] if track.earth is None else [track, track.earth]
            for d in told:
                assert -math.pi <= d.azimuth_rad <= math.pi
                assert 0.0 < d.azimuth_sigma_rad < math.pi
                assert d.elevation_rad is None or abs(d.elevation_rad) <= math.pi / 2 + 1e-9
                assert 0.0 < d.elevation_sigma_rad < math.pi
            assert 0.0 <= track.confidence <= 1.0
