"""The interlock: every message and command that leaves in each configuration, and none that acts on flight
unless the settings file says so and all else holds too."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from test_commands import command
from test_component import CALLING, IN_EARTH, TICK_S, heartbeat, texts
from test_parameters import packed, setting

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component, Hands, Status
from locagen_edge.mavlink.computer import Computer
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.parameters import NAMES
from locagen_edge.mavlink.targets import Place, adsb_vehicle, camera_target
from locagen_edge.settings import FlightSettings, MavlinkSettings, Settings
from locagen_edge.types import Position, TrueBearing

ROI, YAW = common.MAV_CMD_DO_SET_ROI_LOCATION, common.MAV_CMD_CONDITION_YAW
GUIDED, LOITER, STABILIZE = 4, 5, 0
PX4_HOLD = 4 << 16 | 3 << 24

ALWAYS = {
    0: "HEARTBEAT",
    4: "PING",
    22: "PARAM_VALUE",
    76: "COMMAND_LONG",
    77: "COMMAND_ACK",
    110: "FILE_TRANSFER_PROTOCOL",
    111: "TIMESYNC",
    148: "AUTOPILOT_VERSION",
    244: "MESSAGE_INTERVAL",
    251: "NAMED_VALUE_FLOAT",
    253: "STATUSTEXT",
}
SWITCHED = {
    "send_records": {59500, 59501},
    "send_tunnel": {385},
    "send_adsb": {246},
    "send_camera_target": {276},
    "send_computer_status": {390},
}
EVER = set(ALWAYS) | {75} | set().union(*SWITCHED.values())
"""75, COMMAND_INT, with `flight.roi` alone"""

TRACK = replace(IN_EARTH, id=3, confirmed=True)
PLACE = Place(3, 47.1, 8.2, 450.0, 12.0, 1.0)


def positions(*places: Place) -> tuple[Position, ...]:
    """As the pipeline tells them."""
    return tuple(
        Position(
            t_ns=0,
            caller=p.event_id,
            range_observable=True,
            latitude_deg=p.latitude_deg,
            longitude_deg=p.longitude_deg,
            altitude_m=p.altitude_m,
            covariance_m2=np.diag([100.0, 144.0]),
            semi_major_m=p.sigma_m,
            semi_minor_m=10.0,
            orientation_rad=0.0,
            azimuth_rad=0.0,
            azimuth_sigma_rad=0.1,
            age_s=p.age_s,
            looks=9,
        )
        for p in places
    )


HEARD = replace(CALLING, track=TRACK, positions=positions(PLACE))


def autopilot(
    mode: int = GUIDED, *, armed: bool = True, type: int = 2, kind: int = 3, system: int = 1
) -> bytes:
    base = 81 | (128 if armed else 0)
    return packed(common.MAVLink_heartbeat_message(type, kind, base, mode, 4, 3), system, 1)


def settings_with(flight: FlightSettings | None = None, **mavlink: Any) -> Settings:
    return Settings(mavlink=MavlinkSettings(**mavlink), flight=flight or FlightSettings())


def component_of(settings: Settings) -> Component:
    hands = Hands(computer=Computer().status, uid=1)
    return Component(settings.mavlink, whole=settings, hands=hands)


def left(
    component: Component, beat: bytes, status: Status, seconds: float, start_s: float = 0.0
) -> Iterator[Any]:
    """All that goes to all, with the autopilot's heartbeat every second."""
    framer = Framer()
    for tick in range(round(seconds / TICK_S)):
        now_s = start_s + tick * TICK_S
        if tick % 19 == 0:
            component.receive(beat, now_s)
        for frame in component.due(now_s, status):
            for packet in framer.feed(frame):
                yield now_s, dialect.decode(packet.raw)


def commands(messages: Iterator[Any]) -> list[tuple[float, Any]]:
    """Those that are more than a request for messages."""
    return [(t, m) for t, m in messages if m.get_msgId() in (75, 76) and m.command != 511]


def all_that_leaves(settings: Settings) -> tuple[set[int], set[int]]:
    """Ids of messages and commands while everything happens that makes it speak."""
    component = component_of(settings)
    found = [m for _, m in left(component, autopilot(), HEARD, 8)]
    for kind in (replace(HEARD, faults=("x" * 120, "y")), replace(HEARD, hearing=False)):
        found += [m for _, m in left(component, autopilot(), kind, 3, 20.0)]
    component.receive(packed(common.MAVLink_ping_message(1, 1, 0, 0)), 30.0)
    component.receive(packed(common.MAVLink_timesync_message(0, 1)), 30.0)
    component.receive(packed(common.MAVLink_file_transfer_protocol_message(0, 1, 191, bytes(251))), 30.0)
    component.receive(packed(common.MAVLink_param_request_list_message(1, 191)), 30.0)
    component.receive(setting(NAMES[0], 5.0), 30.0)
    for id in sorted(EVER | {33, 69, 109, 132, 147, 149, 330}):
        component.receive(packed(command(512, float(id))), 30.0)
        component.receive(packed(command(510, float(id))), 30.0)
        component.receive(packed(command(511, float(id), 100_000.0)), 30.0)
        frames = b"".join(f for _ in range(3) for f in component.answers(0))
        found += [dialect.decode(packet.raw) for packet in Framer().feed(frames)]
    asked = {m.command for m in found if m.get_msgId() in (75, 76)}
    return {m.get_msgId() for m in found}, asked


@pytest.mark.parametrize("on", list(itertools.product([False, True], repeat=len(SWITCHED))))
def test_every_message_that_leaves_is_let_out_by_a_switch(on: tuple[bool, ...]) -> None:
    switches = dict(zip(SWITCHED, on, strict=True))
    ids, asked = all_that_leaves(settings_with(**switches))
    allowed = set(ALWAYS).union(*(SWITCHED[name] for name, is_on in switches.items() if is_on))
    assert ids <= allowed, sorted(ids - allowed)
    assert set(ALWAYS) <= ids
    for name in SWITCHED:
        assert (SWITCHED[name] <= ids) == switches[name]
    assert asked == {511}, "MAV_CMD_SET_MESSAGE_INTERVAL, and nothing that acts on flight"


@pytest.mark.parametrize(
    ("roi", "yaw", "wanted"),
    [(False, False, {511}), (True, False, {511, ROI}), (False, True, {511, YAW}), (True, True, {511, ROI})],
)
def test_every_command_that_leaves_is_let_out_by_the_settings_file(
    roi: bool, yaw: bool, wanted: set[int]
) -> None:
    everything = dict.fromkeys(SWITCHED, True)
    ids, asked = all_that_leaves(settings_with(FlightSettings(roi=roi, yaw=yaw), **everything))
    assert asked == wanted
    assert ids <= EVER
    assert (75 in ids) == roi


def test_the_short_list_is_the_one_above() -> None:
    assert set(dialect.SENT) == EVER
    assert set(dialect.ALWAYS_SENT) == set(ALWAYS)
    assert {name: set(ids) for name, ids in dialect.SWITCHED.items()} == SWITCHED
    assert set(dialect.COMMANDS) == {511}
    assert {name: {id} for name, id in dialect.FLIGHT_COMMANDS.items()} == {"roi": {ROI}, "yaw": {YAW}}


def test_the_packer_refuses_what_the_file_has_not_switched_on() -> None:
    for number in (ROI, YAW):
        with pytest.raises(ValueError, match="none of those that may leave"):
            dialect.Sender(1, 191).pack(dialect.command(1, number))
        with pytest.raises(ValueError, match="none of those that may leave"):
            dialect.Sender(1, 191, frozenset({511})).pack(dialect.command_at(1, number, 0.0, 0.0, None))


# --- with the switch on ---------------------------------------------------------------------------------

BOTH = FlightSettings(roi=True, yaw=True)
ONLY_YAW = FlightSettings(yaw=True)


@pytest.mark.parametrize(
    ("beat", "why"),
    [
        (autopilot(armed=False), "not armed"),
        (autopilot(LOITER), "a mode that the settings do not name"),
        (autopilot(STABILIZE), "the pilot flies"),
        (autopilot(type=1), "a plane: its mode 4 is another"),
        (autopilot(kind=12), "PX4: its mode 4 is another"),
        (heartbeat(1, 1, autopilot=8), "no autopilot"),
    ],
)
@pytest.mark.parametrize("flight", [BOTH, ONLY_YAW])
def test_no_command_unless_all_holds(beat: bytes, why: str, flight: FlightSettings) -> None:
    assert commands(left(component_of(settings_with(flight)), beat, HEARD, 30)) == [], why


@pytest.mark.parametrize(
    ("status", "why"),
    [
        (replace(HEARD, track=None), "nobody calls"),
        (replace(HEARD, hearing=False), "deaf"),
        (replace(HEARD, track=replace(TRACK, confidence=0.2)), "not confirmed"),
        (replace(HEARD, track=replace(TRACK, silent_s=1.5)), "not heard now"),
        (replace(HEARD, track=replace(TRACK, earth=None)), "no true bearing"),
        (replace(HEARD, track=replace(TRACK, earth=TrueBearing(0.1, 0.5, None, 1.0))), "not sure"),
        (replace(HEARD, track=replace(TRACK, earth=TrueBearing(math.nan, 0.1, None, 1.0))), "no number"),
        (replace(HEARD, track=replace(TRACK, earth=TrueBearing(0.1, math.nan, None, 1.0))), "no number"),
    ],
)
@pytest.mark.parametrize("flight", [BOTH, ONLY_YAW])
def test_no_command_unless_the_call_is_sure(status: Status, why: str, flight: FlightSettings) -> None:
    assert commands(left(component_of(settings_with(flight)), autopilot(), status, 30)) == [], why


def test_no_command_after_the_autopilot_has_fallen_silent() -> None:
    component = component_of(settings_with(ONLY_YAW))
    component.receive(autopilot(), 0.0)
    spoken = [m for t in range(100) for m in component.due(3.0 + 0.1 * t, HEARD)]
    messages = [dialect.decode(packet.raw) for packet in Framer().feed(b"".join(spoken))]
    assert commands(iter([(0.0, m) for m in messages])) == []
    assert "NAMED_VALUE_FLOAT" in {m.get_type() for m in messages}


def test_the_nose_is_turned_once_told_and_not_again_until_the_bearing_moves() -> None:
    component = component_of(settings_with(ONLY_YAW))
    heard = list(left(component, autopilot(), HEARD, 60))
    ((_, yaw),) = commands(iter(heard))
    assert (yaw.command, yaw.target_system, yaw.target_component) == (YAW, 1, 1)
    assert yaw.param1 == pytest.approx(12.0)  # of the earth, not the body's 42
    assert yaw.param4 == 0.0, "an absolute angle"
    assert "Nose turns to caller: 012 deg true" in texts([m for _, m in heard])
    moved = replace(HEARD, track=replace(TRACK, earth=replace(TRACK.earth, azimuth_rad=math.radians(-20.0))))
    ((_, again),) = commands(left(component, autopilot(), moved, 60, 60.0))
    assert again.param1 == pytest.approx(340.0)


@given(st.lists(st.floats(-math.pi, math.pi), min_size=1, max_size=6), st.floats(2.0, 30.0))
def test_commands_keep_their_distance(azimuths: list[float], every_s: float) -> None:
    component = component_of(settings_with(replace(BOTH, every_s=every_s)))
    times = []
    for k, azimuth in enumerate(azimuths):
        moved = replace(
            HEARD, track=replace(TRACK, id=3 + k, earth=replace(TRACK.earth, azimuth_rad=azimuth))
        )
        times += [t for t, _ in commands(left(component, autopilot(), moved, 4, 4.0 * k))]
    assert all(b - a >= every_s - 1e-9 for a, b in itertools.pairwise(times))
    assert times


def test_a_place_is_pointed_at_to_the_metre() -> None:
    component = component_of(settings_with(BOTH))
    ((_, roi),) = commands(left(component, autopilot(), HEARD, 30))
    assert (roi.get_type(), roi.command) == ("COMMAND_INT", ROI)
    assert (roi.x, roi.y, roi.z, roi.frame) == (471_000_000, 82_000_000, 450.0, common.MAV_FRAME_GLOBAL)
    level = replace(HEARD, positions=positions(replace(PLACE, altitude_m=None)))
    ((_, roi),) = commands(left(component_of(settings_with(BOTH)), autopilot(), level, 30))
    assert (roi.z, roi.frame) == (0.0, common.MAV_FRAME_GLOBAL_RELATIVE_ALT)


@pytest.mark.parametrize("place", [replace(PLACE, latitude_deg=math.nan), replace(PLACE, age_s=60.0)])
def test_a_place_that_is_none_is_not_pointed_at(place: Place) -> None:
    only_roi = settings_with(FlightSettings(roi=True))
    heard = replace(HEARD, positions=positions(place))
    assert commands(left(component_of(only_roi), autopilot(), heard, 30)) == []


def test_px4_gets_roi_in_hold_and_no_yaw() -> None:
    hold = replace(BOTH, modes=("HOLD",))
    ((_, roi),) = commands(left(component_of(settings_with(hold)), autopilot(PX4_HOLD, kind=12), HEARD, 30))
    assert roi.command == ROI
    no_place = replace(HEARD, positions=())
    assert commands(left(component_of(settings_with(hold)), autopilot(PX4_HOLD, kind=12), no_place, 30)) == []


def test_a_refusal_is_told_and_the_command_rests() -> None:
    component = component_of(settings_with(replace(ONLY_YAW, every_s=2.0)))
    heard = list(left(component, autopilot(), HEARD, 5))
    assert len(commands(iter(heard))) == 1
    component.receive(packed(common.MAVLink_command_ack_message(YAW, 3, 0, 0, 1, 191), 1, 1), 5.0)
    moved = replace(HEARD, track=replace(TRACK, earth=replace(TRACK.earth, azimuth_rad=2.0)))
    after = list(left(component, autopilot(), moved, 50, 5.0))
    assert commands(iter(after)) == []
    assert "Autopilot refuses yaw (result 3)" in texts([m for _, m in after])
    assert len(commands(left(component, autopilot(), moved, 10, 66.0))) == 1


# --- places as others show them ---------------------------------------------------------------------------


def test_a_place_as_traffic_stands_still_and_is_no_aircraft() -> None:
    message = adsb_vehicle(replace(PLACE, event_id=123_456))
    assert (message.lat, message.lon, message.altitude) == (471_000_000, 82_000_000, 450_000)
    assert (message.hor_velocity, message.ver_velocity) == (0, 0)
    assert message.callsign == "CALL3456"
    assert message.emitter_type == common.ADSB_EMITTER_TYPE_POINT_OBSTACLE
    assert 0xF00000 <= message.ICAO_address < 0xF08000
    assert adsb_vehicle(replace(PLACE, altitude_m=None)).flags & common.ADSB_FLAGS_VALID_ALTITUDE == 0


def test_a_target_is_where_it_is_from_the_vehicle() -> None:
    north_east = camera_target(PLACE, (47.0, 8.2))
    assert north_east.dist == pytest.approx(11_119.5, rel=1e-4)  # a tenth of a degree of latitude
    assert north_east.hdg == pytest.approx(0.0, abs=1e-9)
    assert camera_target(PLACE, (47.1, 8.1)).hdg == pytest.approx(math.pi / 2)
    assert math.isnan(camera_target(PLACE).dist)


@given(st.builds(Place, st.integers(), *[st.floats()] * 2, st.none() | st.floats(), st.floats(), st.floats()))
def test_no_place_raises(place: Place) -> None:
    settings = settings_with(BOTH, send_adsb=True, send_camera_target=True)
    list(left(component_of(settings), autopilot(), replace(HEARD, positions=positions(place)), 1))
