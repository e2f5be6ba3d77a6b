"""Poses beside a recording: to the last bit where they were recorded, between them elsewhere."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.geometry import quaternion
from locagen_edge.jsonl import encode
from locagen_edge.poses import LIMIT_NS, Poses, pose_of, record_of
from locagen_edge.types import Pose

NUMBERS = st.none() | st.floats(-1e4, 1e4)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.builds(
    Pose,
    t_ns=st.integers(0, 2**62),
    attitude=st.none() | st.builds(quaternion, ANGLES, ANGLES, ANGLES),
    latitude_deg=NUMBERS,
    longitude_deg=NUMBERS,
    altitude_m=NUMBERS,
    height_m=NUMBERS,
    height_sigma_m=st.floats(0, 100),
)


@given(POSES)
def test_a_pose_comes_back_to_the_last_bit(pose):
    assert pose_of(json.loads(encode(record_of(pose)))) == pose


@given(
    st.dictionaries(
        st.sampled_from(["type", "t_ns", "attitude", "latitude_deg", "height_sigma_m"]),
        st.sampled_from(["pose", 5, -1.5, math.nan, True, None, [], [0, 0, 0, 0], [1, 0, 0, math.nan], "x"]),
    )
)
def test_a_damaged_record_is_a_pose_with_numbers_or_none(record):
    pose = pose_of(record)
    if pose is not None:
        assert Poses([pose]).at(pose.t_ns) == pose
        encode(record_of(pose))


def test_what_is_not_finite_is_not_recorded():
    record = record_of(Pose(1, (math.nan, 0.0, 0.0, 0.0), math.nan, 8.0, math.inf))
    assert record == {"type": "pose", "t_ns": 1, "longitude_deg": 8.0, "height_sigma_m": 0.0}


def test_between_two_poses_is_a_pose_between_them():
    a = Pose(0, quaternion(0.0, 0.0, 0.1), 10.0, 179.0, 100.0, 20.0, 1.0)
    b = Pose(10**8, quaternion(0.0, 0.0, 0.5), 20.0, -179.0, None, 30.0, 3.0)
    half = Poses([b, a]).at(10**8 // 2)
    assert half.attitude == pytest.approx(quaternion(0.0, 0.0, 0.3))
    assert (half.latitude_deg, half.longitude_deg) == (15.0, 180.0)  # over the date line, not round the earth
    assert (half.altitude_m, half.height_m, half.height_sigma_m) == (None, 25.0, 2.0)


def test_nothing_is_known_outside_and_in_long_gaps():
    far = LIMIT_NS + 1
    poses = Poses([Pose(0, None), Pose(far, None)])
    assert poses.at(-1) is None
    assert poses.at(far // 2) is None
    assert poses.at(far) == Pose(far, None)
    assert poses.at(far + 1) is None
    assert Poses(()).at(0) is None
