"""Laws of the vehicle's pose: what MAVLink bytes say, at the sound's time, or nothing."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from locagen_edge.geometry import quaternion, rotation
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.pose import WANTED, BootClock, PoseHistory
from locagen_edge.mavlink.streams import AGAIN_S, Streams
from locagen_edge.settings import MavlinkSettings, PoseSettings
from locagen_edge.types import Pose

BOOT_S = 5000.0
"""our monotonic time when the autopilot started"""
LATE_S = 0.004
"""a message's way to us"""


class Vehicle:
    """An autopilot as the link brings it: real MAVLink bytes into a component."""

    def __init__(self, **settings: float) -> None:
        self.component = Component(MavlinkSettings(), pose=PoseSettings(**settings))
        self.mav = common.MAVLink(None, 7, 1)
        self.boot_s = BOOT_S
        self.beat(BOOT_S)

    def send(self, message: common.MAVLink_message, at_s: float, late_s: float = LATE_S) -> None:
        self.component.receive(bytes(message.pack(self.mav)), at_s + late_s)

    def ms(self, at_s: float) -> int:
        return round((at_s - self.boot_s) * 1000)

    def beat(self, at_s: float) -> None:
        self.send(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3), at_s, 0.0)

    def attitude(self, at_s: float, yaw: float, roll: float = 0.0, pitch: float = 0.0, **late: float) -> None:
        q = quaternion(roll, pitch, yaw)
        self.send(common.MAVLink_attitude_quaternion_message(self.ms(at_s), *q, 0, 0, 0), at_s, **late)

    def position(self, at_s: float, lat: float, lon: float, alt: float, relative: float) -> None:
        degrees = round(lat * 1e7), round(lon * 1e7)
        metres = round(alt * 1e3), round(relative * 1e3)
        self.send(
            common.MAVLink_global_position_int_message(self.ms(at_s), *degrees, *metres, 0, 0, 0, 0), at_s
        )

    def distance(self, at_s: float, metres: float, orientation: int = 25, covariance: int = 0) -> None:
        cm = round(metres * 100)
        self.send(
            common.MAVLink_distance_sensor_message(
                self.ms(at_s), 20, 4000, cm, 0, 0, orientation, covariance
            ),
            at_s,
        )

    def terrain(self, at_s: float, height: float, spacing: int = 100) -> None:
        self.send(common.MAVLink_terrain_report_message(0, 0, spacing, 400.0, height, 0, 56), at_s)

    def altitude(self, at_s: float, clearance: float) -> None:
        us = self.ms(at_s) * 1000
        self.send(common.MAVLink_altitude_message(us, 0, 0, 0, 0, math.nan, clearance), at_s)

    def pose(self, at_s: float) -> Pose:
        return self.component.poses.at(round((at_s + LATE_S) * 1e9))


def yaw(pose: Pose) -> float:
    assert pose.attitude is not None
    nose = rotation(pose.attitude)[:, 0]
    return math.atan2(nose[1], nose[0])


# --- attitude -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["quaternion", "angles"])
def test_an_attitude_is_what_mavlink_means(kind: str) -> None:
    """Nose to the east and up, right side down: the body's axes in north, east, down."""
    v = Vehicle()
    roll, pitch, heading = 0.1, 0.2, math.pi / 2
    if kind == "quaternion":
        v.attitude(BOOT_S + 1.0, heading, roll, pitch)
    else:
        v.send(common.MAVLink_attitude_message(1000, roll, pitch, heading, 0, 0, 0), BOOT_S + 1.0)
    turn = rotation(v.pose(BOOT_S + 1.0).attitude)
    np.testing.assert_allclose(turn[:, 0], [0, math.cos(0.2), -math.sin(0.2)], atol=1e-6)  # nose
    assert turn[2, 1] == pytest.approx(math.sin(0.1) * math.cos(0.2), abs=1e-6)  # the right side is lower


def test_between_two_messages_it_is_on_the_way_through_north_too() -> None:
    v = Vehicle()
    for k in range(41):  # 60 degrees/s, at 20 Hz, twice through the seam
        v.attitude(BOOT_S + 1.0 + 0.05 * k, math.radians(330.0 + 3.0 * k))
    for at_s in np.arange(1.0, 2.99, 0.013):
        wanted = math.radians(330.0 + 60.0 * (at_s - 1.0))
        off = (yaw(v.pose(BOOT_S + at_s)) - wanted + math.pi) % (2 * math.pi) - math.pi
        assert abs(math.degrees(off)) < 0.1  # a millisecond of time_boot_ms is 0.06 degrees


def test_after_the_last_message_it_goes_on_for_as_long_as_the_settings_say() -> None:
    v = Vehicle(attitude_limit_s=0.2)
    for k in range(11):
        v.attitude(BOOT_S + 1.0 + 0.05 * k, math.radians(3.0 * k))
    assert math.degrees(yaw(v.pose(BOOT_S + 1.65))) == pytest.approx(39.0, abs=0.2)
    assert v.pose(BOOT_S + 1.71).attitude is None
    assert v.pose(BOOT_S + 0.9).attitude is None  # before the first


def test_over_a_long_gap_nothing_is_known() -> None:
    v = Vehicle(attitude_limit_s=0.2)
    for at_s in (1.0, 1.05, 1.6, 1.65):
        v.attitude(BOOT_S + at_s, at_s)
    assert v.pose(BOOT_S + 1.3).attitude is None
    assert v.pose(BOOT_S + 1.62).attitude is not None


def test_two_messages_of_one_moment_do_not_make_a_spin() -> None:
    """ATTITUDE and ATTITUDE_QUATERNION side by side, with the noise of an autopilot: 0.1 degrees."""
    v = Vehicle()
    for k in range(10):
        at_s = BOOT_S + 1.0 + 0.05 * k
        v.attitude(at_s, 0.0)
        v.send(
            common.MAVLink_attitude_message(v.ms(at_s) + 1, 0, 0, math.radians(0.1), 0, 0, 0), at_s + 0.001
        )
    assert abs(math.degrees(yaw(v.pose(BOOT_S + 1.65)))) < 0.5


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (math.nan,) * 4, (5, 0, 0, 0), (math.inf, 0, 0, 0)])
def test_what_is_no_attitude_is_none(q: tuple[float, ...]) -> None:
    v = Vehicle()
    v.send(common.MAVLink_attitude_quaternion_message(1000, *q, 0, 0, 0), BOOT_S + 1.0)
    v.send(common.MAVLink_attitude_message(1001, math.nan, 0, 0, 0, 0, 0), BOOT_S + 1.001)
    assert v.pose(BOOT_S + 1.0).attitude is None


def test_of_others_nothing_is_taken() -> None:
    v = Vehicle()
    for system, component in ((7, 154), (9, 1), (255, 190)):
        mav = common.MAVLink(None, system, component)
        message = common.MAVLink_attitude_quaternion_message(1000, 1, 0, 0, 0, 0, 0, 0)
        v.component.receive(bytes(message.pack(mav)), BOOT_S + 1.0)
    assert v.pose(BOOT_S + 1.0) == Pose(round((BOOT_S + 1.0 + LATE_S) * 1e9), None)


# --- time ---------------------------------------------------------------------------------------------


def test_messages_that_are_late_do_not_put_the_attitude_late() -> None:
    """Half of them up to 80 ms late, at 60 degrees/s: the others tell the clock."""
    v, rng = Vehicle(), np.random.default_rng(3)
    late = np.where(rng.random(100) < 0.5, 0.0, 0.08 * rng.random(100))
    for k in range(100):
        v.attitude(BOOT_S + 1.0 + 0.05 * k, math.radians(3.0 * k), late_s=LATE_S + late[k])
    off = math.degrees(yaw(v.pose(BOOT_S + 5.0)) - math.radians(240.0)) % 360.0
    assert min(off, 360.0 - off) < 0.2


def test_the_clock_follows_a_drift() -> None:
    """1e-4 fast for 20 minutes is 120 ms; the clock is right within what it may rise between two messages."""
    clock = BootClock()
    for second in range(1200):
        clock.hear(second * 1000 * (1 + 1e-4), round((100 + second + LATE_S) * 1e9))
    assert clock.boot_ms(round((100 + 1199 + LATE_S) * 1e9)) == pytest.approx(1199 * 1000 * (1 + 1e-4), abs=1)
    clock = BootClock()
    for second in range(1200):
        clock.hear(second * 1000 * (1 - 1e-4), round((100 + second + LATE_S) * 1e9))
    assert clock.boot_ms(round((100 + 1199 + LATE_S) * 1e9)) == pytest.approx(1199 * 1000 * (1 - 1e-4), abs=1)


def test_a_reboot_begins_anew() -> None:
    v = Vehicle()
    v.position(BOOT_S + 100.0, 47.0, 8.0, 500.0, 20.0)
    v.attitude(BOOT_S + 100.0, 1.0)
    v.boot_s = BOOT_S + 130.0
    v.attitude(BOOT_S + 131.0, 2.0)
    v.attitude(BOOT_S + 131.1, 2.0)
    assert v.component.poses.reboots == 1
    assert yaw(v.pose(BOOT_S + 131.05)) == pytest.approx(2.0, abs=1e-5)
    assert v.pose(BOOT_S + 100.0) == Pose(round((BOOT_S + 100.0 + LATE_S) * 1e9), None)


def test_a_reboot_that_was_not_heard_of_until_its_clock_had_passed_the_last_begins_anew() -> None:
    """A minute in the air, two on the ground without power for the link: no time goes back."""
    v = Vehicle()
    for k in range(20):
        v.attitude(BOOT_S + 60.0 + 0.05 * k, 1.0)
    v.boot_s = BOOT_S + 65.0
    for k in range(40):
        v.attitude(BOOT_S + 185.0 + 0.05 * k, 2.0)
    assert v.component.poses.reboots == 1
    assert yaw(v.pose(BOOT_S + 186.9)) == pytest.approx(2.0, abs=1e-5)


def test_what_a_link_has_held_back_for_a_while_is_no_reboot() -> None:
    """TCP after a gap: what is 4 s old comes at once."""
    v = Vehicle()
    for k in range(20):
        v.attitude(BOOT_S + 1.0 + 0.05 * k, 1.0)
    for k in range(80):
        v.attitude(BOOT_S + 2.0 + 0.05 * k, 1.0, late_s=LATE_S + 4.0 - 0.049 * k)
    for k in range(20):
        v.attitude(BOOT_S + 6.0 + 0.05 * k, 1.5)
    assert v.component.poses.reboots == 0
    assert yaw(v.pose(BOOT_S + 6.9)) == pytest.approx(1.5, abs=1e-5)


def test_a_message_that_was_overtaken_is_no_reboot() -> None:
    v = Vehicle()
    v.attitude(BOOT_S + 1.05, 1.0)
    v.attitude(BOOT_S + 1.00, 2.0)
    assert v.component.poses.reboots == 0
    assert yaw(v.pose(BOOT_S + 1.05)) == pytest.approx(1.0, abs=1e-5)


# --- position and height ------------------------------------------------------------------------------


def test_a_position_is_on_the_line_between_over_the_date_line_too() -> None:
    v = Vehicle()
    v.position(BOOT_S + 1.0, -17.0, 179.9999, 100.0, 30.0)
    v.position(BOOT_S + 1.2, -17.0002, -179.9999, 104.0, 34.0)
    pose = v.pose(BOOT_S + 1.15)
    assert pose.latitude_deg == pytest.approx(-17.00015, abs=1e-7)
    assert pose.longitude_deg == pytest.approx(-179.99995, abs=1e-7)
    assert pose.altitude_m == pytest.approx(103.0, abs=1e-3)
    assert pose.height_m == pytest.approx(33.0, abs=1e-3)


def test_before_the_first_fix_there_is_no_position() -> None:
    v = Vehicle()
    v.position(BOOT_S + 1.0, 0.0, 0.0, 12.0, 5.0)
    assert v.pose(BOOT_S + 1.0).latitude_deg is None
    assert v.pose(BOOT_S + 1.0).altitude_m is None


def test_the_height_is_that_of_whoever_knows_it_best() -> None:
    v = Vehicle(relief_m=15.0)
    at_s = BOOT_S + 1.0
    v.position(at_s, 47.0, 8.0, 500.0, 60.0)
    relative = v.pose(at_s)
    assert (relative.height_m, relative.height_sigma_m) == (60.0, 15.0)
    v.terrain(at_s, 48.0)
    over_terrain = v.pose(at_s + 0.1)
    assert over_terrain.height_m == 48.0
    assert 1.0 < over_terrain.height_sigma_m < 15.0
    v.distance(at_s, 20.0)
    found = v.pose(at_s + 0.1)
    assert found.height_m == pytest.approx(20.0)
    assert found.height_sigma_m < 1.0
    for later in np.arange(0.0, 3.0, 0.2):
        v.position(at_s + later, 47.0, 8.0, 500.0, 60.0)
    gone = v.pose(at_s + 2.8)  # neither came again
    assert (gone.height_m, gone.height_sigma_m) == (60.0, 15.0)


def test_a_rangefinder_measures_along_the_body() -> None:
    v = Vehicle()
    v.attitude(BOOT_S + 1.0, 2.0, roll=0.3, pitch=-0.4)
    v.distance(BOOT_S + 1.0, 20.0)
    assert v.pose(BOOT_S + 1.0).height_m == pytest.approx(20.0 * math.cos(0.3) * math.cos(0.4), abs=0.01)
    v.attitude(BOOT_S + 1.05, 2.0, roll=1.4)
    v.attitude(BOOT_S + 1.1, 2.0, roll=1.4)
    assert v.pose(BOOT_S + 1.1).height_m is None


@pytest.mark.parametrize(
    "wrong",
    [
        lambda v, at_s: v.distance(at_s, 20.0, orientation=0),  # ahead
        lambda v, at_s: v.distance(at_s, 40.0),  # its most: nothing came back
        lambda v, at_s: v.distance(at_s, 0.1),  # nearer than it can tell
        lambda v, at_s: v.terrain(at_s, 0.0, spacing=0),  # no data here
        lambda v, at_s: v.terrain(at_s, math.nan),
        lambda v, at_s: v.altitude(at_s, -1.0),
        lambda v, at_s: v.altitude(at_s, math.nan),
    ],
)
def test_what_tells_no_height_is_none(wrong) -> None:
    v = Vehicle()
    v.attitude(BOOT_S + 1.0, 0.0)
    wrong(v, BOOT_S + 1.0)
    assert v.pose(BOOT_S + 1.0).height_m is None


def test_a_rangefinder_may_tell_its_own_sigma_and_px4_another_message() -> None:
    v = Vehicle()
    v.attitude(BOOT_S + 1.0, 0.0)
    v.distance(BOOT_S + 1.0, 5.0, covariance=144)
    assert v.pose(BOOT_S + 1.0).height_sigma_m == pytest.approx(0.18, abs=0.01)  # 3 % of 5 m, and 0.1 m
    v.distance(BOOT_S + 1.1, 2.0, covariance=250)
    assert v.pose(BOOT_S + 1.1).height_sigma_m == pytest.approx(0.158, abs=0.01)
    w = Vehicle()
    w.attitude(BOOT_S + 1.0, 0.0)
    w.altitude(BOOT_S + 1.0, 7.5)
    assert w.pose(BOOT_S + 1.0).height_m == 7.5


NUMBER = st.floats(width=32) | st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 3.4e38])
MESSAGES = st.one_of(
    st.builds(
        common.MAVLink_attitude_quaternion_message, st.integers(0, 2**32 - 1), *[NUMBER] * 7
    ),
    st.builds(common.MAVLink_attitude_message, st.integers(0, 2**32 - 1), *[NUMBER] * 6),
    st.builds(
        common.MAVLink_global_position_int_message,
        st.integers(0, 2**32 - 1),
        *[st.integers(-(2**31), 2**31 - 1)] * 4,
        *[st.integers(-(2**15), 2**15 - 1)] * 3,
        st.integers(0, 65535),
    ),
    st.builds(
        common.MAVLink_distance_sensor_message,
        st.integers(0, 2**32 - 1),
        *[st.integers(0, 65535)] * 3,
        *[st.integers(0, 4)] * 2,
        st.sampled_from([0, 25]),
        st.integers(0, 255),
    ),
    st.builds(
        common.MAVLink_terrain_report_message, st.just(0), st.just(0), st.integers(0, 200), NUMBER, NUMBER,
        st.just(0), st.just(0),
    ),
    st.builds(common.MAVLink_altitude_message, st.integers(0, 2**63), *[NUMBER] * 6),
)  # fmt: skip


@given(st.lists(st.tuples(MESSAGES, st.floats(0, 5)), max_size=20), st.floats(-1, 20))
def test_no_message_raises_and_every_attitude_is_a_rotation(
    messages: list[tuple[common.MAVLink_message, float]], at_s: float
) -> None:
    poses, now_s = PoseHistory(PoseSettings()), 100.0
    for message, later_s in messages:
        now_s += later_s
        try:
            raw = bytes(message.pack(common.MAVLink(None, 7, 1)))
        except (OverflowError, struct.error):
            continue
        decoded = common.MAVLink(None).decode(bytearray(raw))
        poses.take(decoded, round(now_s * 1e9))
    pose = poses.at(round((100.0 + at_s) * 1e9))
    if pose.attitude is not None:
        turn = rotation(pose.attitude)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    known = [pose.latitude_deg, pose.longitude_deg, pose.altitude_m, pose.height_m, pose.height_sigma_m]
    assert all(math.isfinite(x) for x in known if x is not None)


# --- what is asked for --------------------------------------------------------------------------------

QUIET = Status(hearing=True, track=None, snr_db=0.0, faults=())


def asked(
    v: Vehicle, seconds: float, start_s: float, *, beats: bool = True
) -> list[tuple[float, int, float]]:
    """Time, message id and rate of every command in these seconds, addressed to the autopilot."""
    found = []
    for tick in range(round(seconds * 20)):
        now_s = start_s + tick / 20
        if beats and tick % 20 == 0:
            v.beat(now_s)
        for frame in v.component.due(now_s, QUIET):
            (message,) = common.MAVLink(None).parse_buffer(frame)
            if message.get_type() == "COMMAND_LONG":
                assert (message.target_system, message.target_component) == (7, 1)
                assert message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL
                found.append((now_s, int(message.param1), 1e6 / message.param2))
    return found


def test_the_pose_is_asked_for_once_the_autopilot_is_heard() -> None:
    v = Vehicle(rate_hz=20.0)
    found = asked(v, 5.0, BOOT_S)
    rates = {id: rate for _, id, rate in found}
    assert len(found) == len(rates)
    assert rates[common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] == pytest.approx(20.0)
    assert rates[common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT] == pytest.approx(10.0)
    assert {common.MAVLINK_MSG_ID_DISTANCE_SENSOR, common.MAVLINK_MSG_ID_TERRAIN_REPORT} <= set(rates)
    assert np.diff([now_s for now_s, _, _ in found]).min() > 0.09


def test_what_comes_is_not_asked_for_again_and_what_stays_away_is() -> None:
    v = Vehicle()
    for second in range(60):
        v.attitude(BOOT_S + second, 0.0)
        v.position(BOOT_S + second, 47.0, 8.0, 500.0, 20.0)
        found = asked(v, 1.0, BOOT_S + second)
        assert second < 1 or not found
    gone = asked(v, 5.0, BOOT_S + 60.0)
    assert {id for _, id, _ in gone} == set(WANTED), "what came and goes: it may have started anew"
    assert 1.0 < gone[0][0] - (BOOT_S + 59.0) < 2.0
    silent = asked(v, 60.0, BOOT_S + 65.0)
    assert {id for _, id, _ in silent} == {31, 33}
    assert 2 * 3 <= len(silent) <= 2 * 60 / AGAIN_S


def test_after_a_gap_and_after_a_reboot_all_is_asked_for_again() -> None:
    v = Vehicle()
    everything = {id for _, id, _ in asked(v, 3.0, BOOT_S)}
    assert asked(v, 10.0, BOOT_S + 3.0, beats=False) == []  # nobody there
    assert {id for _, id, _ in asked(v, 2.0, BOOT_S + 13.0)} == everything
    v.attitude(BOOT_S + 15.0, 0.0)
    v.boot_s = BOOT_S + 14.0
    assert asked(v, 0.5, BOOT_S + 15.0) == []
    v.attitude(BOOT_S + 15.5, 0.0)
    assert {id for _, id, _ in asked(v, 2.0, BOOT_S + 15.5)} == everything


def test_whoever_wants_no_commands_gets_none() -> None:
    assert asked(Vehicle(rate_hz=0.0), 30.0, BOOT_S) == []
    streams = Streams(20.0)
    assert streams.due(1e9) is None  # no autopilot heard
