"""Laws of the tracker: birth, the seam at 360 degrees, coasting, death, and a sigma that means something."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locagen_edge.geometry import wrap
from locagen_edge.settings import TrackSettings
from locagen_edge.stages.track import Tracker
from locagen_edge.types import Bearing, Detection, Track

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


def tracker(tolerance_deg: float = 0.0, **settings) -> Tracker:
    return Tracker(TrackSettings(**settings), math.radians(tolerance_deg), overlap=1.0)


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
    """200 runs of 40 bearings of a fixed caller: normalised error squared has mean 1 (+-0.3 at 3 sigma,
    below 1 since a fixed caller is more docile than the model)."""
    rng, score = np.random.default_rng(5), []
    for _ in range(200):
        tracks = run(tracker(), [heard(100.0 + 2.0 * rng.standard_normal()) for _ in range(40)])
        last = tracks[-1]
        assert last.azimuth_sigma_rad < math.radians(1.2)
        score.append((error_deg(last, 100.0) / math.degrees(last.azimuth_sigma_rad)) ** 2)
    assert 0.4 < np.mean(score) < 1.3


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
