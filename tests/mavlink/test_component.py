"""Laws of what we say: cadence over simulated time, once per event, and nothing that acts on flight."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from locagen_edge.geodesy import moved
from locagen_edge.mavlink import component as voice
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.settings import MavlinkSettings
from locagen_edge.types import Pose, Position, Track, TrueBearing

TICK_S = 0.0512  # the pipeline's hop
TRACK = Track(
    azimuth_rad=math.radians(42.0),
    azimuth_sigma_rad=math.radians(3.0),
    elevation_rad=math.radians(-20.0),
    elevation_sigma_rad=math.radians(5.0),
    age_s=0.6,
    silent_s=0.0,
    confidence=0.9,
)
IN_EARTH = replace(
    TRACK, earth=TrueBearing(math.radians(12.0), math.radians(4.25), math.radians(-25.0), math.radians(5.5))
)
QUIET = Status(hearing=True, track=None, snr_db=-3.0, faults=())
CALLING = replace(QUIET, track=TRACK, snr_db=6.0)
DEAF = replace(CALLING, hearing=False)


def decode(frames: list[bytes]) -> list[Any]:
    """What pymavlink's own parser, our peer here, reads in these frames; what it does not know, ours."""
    peer = common.MAVLink(None)
    messages = [message for frame in frames for message in peer.parse_buffer(frame) or ()]
    assert len(messages) == len(frames)
    return [
        dialect.decode(frame) if message.get_type().startswith("UNKNOWN") else message
        for frame, message in zip(frames, messages, strict=True)
    ]


def speak(
    component: Component, status: Status, seconds: float, start_s: float = 0.0
) -> Iterator[tuple[float, Any]]:
    """Time and message of all that is said while the status stays."""
    for tick in range(round(seconds / TICK_S)):
        now_s = start_s + tick * TICK_S
        for message in decode(component.due(now_s, status)):
            yield now_s, message


def said(component: Component, status: Status, seconds: float, start_s: float = 0.0) -> list[Any]:
    return [message for _, message in speak(component, status, seconds, start_s)]


def texts(messages: list[Any]) -> list[str]:
    return [m.text for m in messages if m.get_type() == "STATUSTEXT"]


def values(messages: list[Any]) -> dict[str, float]:
    """The last of each named value."""
    return {m.name: m.value for m in messages if m.get_type() == "NAMED_VALUE_FLOAT"}


def heartbeat(
    system: int, component: int = 1, *, type: int = common.MAV_TYPE_QUADROTOR, autopilot: int = 3
) -> bytes:
    message = common.MAVLink_heartbeat_message(type, autopilot, 81, 0, 4, 3)
    return bytes(message.pack(common.MAVLink(None, system, component)))


def position(caller: int = 0, **more: Any) -> Position:
    """40 m north and 30 m east of AWAY."""
    lat, lon, _ = moved(47.0, 8.0, 0.0, np.array([40.0, 30.0, 0.0]))
    values: dict[str, Any] = {
        "t_ns": 0, "caller": caller, "range_observable": True, "latitude_deg": lat, "longitude_deg": lon,
        "altitude_m": 401.5, "covariance_m2": np.array([[60.0, 5.0], [5.0, 9.0]]), "semi_major_m": 7.8,
        "semi_minor_m": 2.9, "orientation_rad": 0.1, "azimuth_rad": 0.64, "azimuth_sigma_rad": 0.05,
        "age_s": 0.3, "looks": 12,
    }  # fmt: skip
    return Position(**{**values, **more})


AWAY = Pose(2_000_000_000, (1.0, 0.0, 0.0, 0.0), 47.0, 8.0, 420.0, 20.0, 1.0)
PLACED = replace(
    CALLING, track=IN_EARTH, positions=(position(),), pose=AWAY, t_ns=AWAY.t_ns, noise_dbfs=-41.0
)


# --- heartbeat ----------------------------------------------------------------------------------------


def test_a_heartbeat_every_second_and_what_it_says() -> None:
    beats = [(t, m) for t, m in speak(Component(MavlinkSettings()), QUIET, 60) if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 60
    for k, (now_s, message) in enumerate(beats):
        assert now_s == pytest.approx(k, abs=2 * TICK_S)  # no drift: late by the loop's tick at most
        assert message.type == common.MAV_TYPE_ONBOARD_CONTROLLER
        assert message.autopilot == common.MAV_AUTOPILOT_INVALID
        assert message.system_status == common.MAV_STATE_ACTIVE
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


def test_a_deaf_daemon_has_no_heartbeat_and_gives_no_bearing() -> None:
    assert said(Component(MavlinkSettings()), DEAF, 30) == []


def test_the_heartbeat_stops_with_the_hearing_and_returns_with_it_at_once() -> None:
    component = Component(MavlinkSettings())
    said(component, QUIET, 10)
    assert said(component, DEAF, 10, 10.0) == []
    first = component.due(20.3, QUIET)
    assert [m.get_type() for m in decode(first)] == ["HEARTBEAT", "LOCAGEN_BEARING", "TUNNEL"]


def test_a_microphone_fault_shows_in_the_heartbeat_while_it_lasts() -> None:
    component = Component(MavlinkSettings())
    ill = replace(QUIET, faults=("microphone 2 is silent",))
    states = [
        [m.system_status for m in said(component, status, 3, start_s) if m.get_type() == "HEARTBEAT"]
        for start_s, status in ((0.0, QUIET), (3.0, ill), (6.0, QUIET))
    ]
    assert states == [
        [common.MAV_STATE_ACTIVE] * 3,
        [common.MAV_STATE_CRITICAL] * 3,
        [common.MAV_STATE_ACTIVE] * 3,
    ]


# --- system id ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stranger", "why"),
    [
        (heartbeat(255, 190, type=common.MAV_TYPE_GCS, autopilot=8), "ground station"),
        (heartbeat(255, 1), "an autopilot with the ground station's id"),
        (heartbeat(245, 1, type=common.MAV_TYPE_GCS, autopilot=8), "ground station as component 1"),
        (heartbeat(9, 154, type=common.MAV_TYPE_GIMBAL, autopilot=8), "gimbal"),
        (heartbeat(9, 191, type=common.MAV_TYPE_ONBOARD_CONTROLLER, autopilot=8), "another companion"),
        (heartbeat(9, 1, autopilot=8), "component 1 that is no autopilot"),
        (heartbeat(0, 1), "system 0 means all"),
    ],
)
def test_only_an_autopilot_teaches_the_system_id(stranger: bytes, why: str) -> None:
    component = Component(MavlinkSettings())
    component.receive(stranger, 0.0)
    assert component.system_id == 1, why
    assert component.autopilot_heard_s is None
    component.receive(heartbeat(42), 1.0)
    component.receive(stranger, 2.0)
    assert component.system_id == 42, why
    assert component.autopilot_heard_s == 1.0


def test_what_is_learnt_is_what_is_sent() -> None:
    component = Component(MavlinkSettings(component_id=193))
    component.receive(b"\x00\xfd" + heartbeat(42), 0.0)
    messages = said(component, CALLING, 2)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {(42, 193)}
    assert [m.get_seq() for m in messages] == list(range(len(messages)))


def test_a_second_vehicle_is_not_followed_while_ours_lives() -> None:
    component = Component(MavlinkSettings())
    for second in range(60):
        component.receive(heartbeat(3) + heartbeat(4), float(second))
        assert component.system_id == 3
    component.receive(heartbeat(4), 59 + voice.AUTOPILOT_SILENT_S)
    assert component.system_id == 3
    component.receive(heartbeat(4), 59.1 + voice.AUTOPILOT_SILENT_S)
    assert component.system_id == 4  # rebooted under a new id


def test_an_id_from_the_settings_stays() -> None:
    component = Component(MavlinkSettings(system_id=17))
    component.receive(heartbeat(3), 0.0)
    assert (component.system_id, component.autopilot_heard_s) == (17, None)
    component.receive(heartbeat(17), 100.0)
    assert (component.system_id, component.autopilot_heard_s) == (17, 100.0)


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255), st.sampled_from([2, 6, 18]))))
def test_never_system_id_255_or_0(beats: list[tuple[int, int, int]]) -> None:
    component = Component(MavlinkSettings())
    for now, (system, comp, kind) in enumerate(beats):
        component.receive(heartbeat(system, comp, type=kind), 100.0 * now)
        assert 1 <= component.system_id <= 254


# --- named values -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [0.5, 2.0, 5.0])
def test_values_come_at_the_rate_of_the_settings_while_a_track_lives(rate_hz: float) -> None:
    component = Component(MavlinkSettings(rate_hz=rate_hz))
    names = Counter(m.name for m in said(component, CALLING, 20) if m.get_type() == "NAMED_VALUE_FLOAT")
    assert names == dict.fromkeys(("LG_AZB", "LG_EL", "LG_SIG", "LG_CONF", "LG_SNR"), 20 * rate_hz)
    assert values(said(component, QUIET, 20, 20.0)) == {}


def test_a_new_track_is_sent_at_once() -> None:
    component = Component(MavlinkSettings(rate_hz=0.1))
    said(component, QUIET, 5)
    assert "LG_AZB" in values(decode(component.due(5.01, CALLING)))


def test_values_are_what_the_track_says() -> None:
    got = values(said(Component(MavlinkSettings()), replace(CALLING, track=IN_EARTH), 1))
    wanted = {"LG_AZB": 42.0, "LG_AZ": 12.0, "LG_EL": -25.0, "LG_SIG": 4.25, "LG_CONF": 0.9, "LG_SNR": 6.0}
    assert got == pytest.approx(wanted, rel=1e-6)  # float32


def test_what_is_not_known_is_not_sent() -> None:
    flat = replace(CALLING, track=replace(TRACK, elevation_rad=None))
    assert set(values(said(Component(MavlinkSettings()), flat, 1))) == {
        "LG_AZB",
        "LG_SIG",
        "LG_CONF",
        "LG_SNR",
    }


@pytest.mark.parametrize(
    ("azimuth_rad", "degrees"),
    [
        (-0.0, 0.0),
        (0.0, 0.0),
        (-1e-17, 0.0),
        (-1e-9, 0.0),  # 359.99999994 is 360 in float32
        (-math.pi, 180.0),
        (math.pi, 180.0),
        (-math.pi / 2, 270.0),
        (math.radians(359.9999), 359.9999),
        (math.radians(725.0), 5.0),
    ],
)
def test_azimuth_is_from_0_to_below_360(azimuth_rad: float, degrees: float) -> None:
    earth = TrueBearing(azimuth_rad, 0.1, None, 0.1)
    status = replace(CALLING, track=replace(TRACK, azimuth_rad=azimuth_rad, earth=earth))
    got = values(said(Component(MavlinkSettings()), status, 1))
    for name in ("LG_AZB", "LG_AZ"):
        assert got[name] == pytest.approx(degrees, abs=1e-4)
        assert 0.0 <= got[name] < 360.0
        assert math.copysign(1.0, got[name]) == 1.0


ANY = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf, -0.0, 1e308, 5e-324])
IN_ANY_EARTH = st.none() | st.builds(TrueBearing, ANY, ANY, st.none() | ANY, ANY)


@given(ANY, ANY, ANY | st.none(), ANY, ANY, IN_ANY_EARTH)
def test_no_number_raises_or_leaves_its_range(
    azimuth: float,
    sigma: float,
    elevation: float | None,
    confidence: float,
    snr: float,
    earth: TrueBearing | None,
) -> None:
    track = Track(azimuth, sigma, elevation, 0.1, 1.0, 0.0, confidence, earth=earth)
    status = Status(True, track, snr, ())
    got = values(said(Component(MavlinkSettings(), start_s=-1e6), status, 0.2))
    limits = {"LG_AZB": 360, "LG_AZ": 360, "LG_EL": 90, "LG_SIG": 180, "LG_CONF": 1, "LG_SNR": 200}
    assert all(abs(value) <= limits[name] for name, value in got.items())  # NaN would fail too


def test_nothing_known_of_the_azimuth_is_a_sigma_of_180() -> None:
    lost = replace(CALLING, track=replace(TRACK, azimuth_sigma_rad=math.inf))
    assert values(said(Component(MavlinkSettings()), lost, 1))["LG_SIG"] == 180.0
    broken = replace(CALLING, track=replace(TRACK, azimuth_sigma_rad=math.nan))
    assert "LG_SIG" not in values(said(Component(MavlinkSettings()), broken, 1))


def test_time_counts_from_the_start_and_wraps_at_32_bits() -> None:
    def stamps(start_s: float, now_s: float) -> set[int]:
        messages = decode(Component(MavlinkSettings(), start_s=start_s).due(now_s, CALLING))
        return {m.time_boot_ms for m in messages if m.get_type() == "NAMED_VALUE_FLOAT"}

    assert stamps(100.0, 101.25) == {1250}
    assert stamps(0.0, 2**32 / 1000) == {0}
    assert stamps(0.0, 2**32 / 1000 + 1.5) == {1500}


# --- texts --------------------------------------------------------------------------------------------


def test_a_confirmed_call_is_told_once() -> None:
    component = Component(MavlinkSettings())
    heard = [m for m in said(component, CALLING, 60) if m.get_type() == "STATUSTEXT"]
    assert [(m.severity, m.text) for m in heard] == [
        (common.MAV_SEVERITY_NOTICE, "Call heard: 042 deg clockwise from nose, +-3 deg")
    ]


def test_with_an_attitude_the_true_bearing_comes_first() -> None:
    assert texts(said(Component(MavlinkSettings()), replace(CALLING, track=IN_EARTH), 1)) == [
        "Call heard: 012 deg true, 042 from nose, +-4 deg"
    ]


def test_each_of_several_callers_is_told_once_whichever_is_the_best() -> None:
    component = Component(MavlinkSettings())
    second = replace(TRACK, id=2, azimuth_rad=math.radians(200.0))
    both = replace(CALLING, others=(second,))
    swapped = replace(CALLING, track=second, others=(TRACK,))
    assert sorted(texts(said(component, both, 3))) == [
        "Call heard: 042 deg clockwise from nose, +-3 deg",
        "Call heard: 200 deg clockwise from nose, +-3 deg",
    ]
    assert texts(said(component, swapped, 3, 3.0)) == []
    assert values(said(component, swapped, 1, 6.0))["LG_AZB"] == pytest.approx(200.0)


@pytest.mark.parametrize("weak", [{"confidence": 0.49}, {"age_s": 0.29}, {"confidence": math.nan}])
def test_a_call_that_is_not_confirmed_is_not_told(weak: dict[str, float]) -> None:
    component = Component(MavlinkSettings())
    assert texts(said(component, replace(CALLING, track=replace(TRACK, **weak)), 5)) == []
    assert len(texts(said(component, CALLING, 5, 5.0))) == 1


def test_a_call_born_again_is_told_again() -> None:
    component = Component(MavlinkSettings())
    later = replace(CALLING, track=replace(TRACK, age_s=9.0))
    for start_s, status, told in (
        (0.0, CALLING, 1),
        (2.0, later, 0),  # the same one goes on
        (4.0, QUIET, 0),
        (6.0, CALLING, 0),  # the same one still
        (8.0, replace(CALLING, track=replace(TRACK, id=1)), 1),  # another one took its place
        (10.0, later, 0),
    ):
        assert len(texts(said(component, status, 2, start_s))) == told


def test_a_pause_in_the_hearing_makes_no_new_call() -> None:
    component = Component(MavlinkSettings())
    for start_s, status, told in ((0.0, CALLING, 1), (2.0, DEAF, 0), (4.0, CALLING, 0)):
        assert len(texts(said(component, status, 2, start_s))) == told


def test_a_fault_is_told_once_and_once_more_when_it_has_gone() -> None:
    component = Component(MavlinkSettings())
    ill = replace(QUIET, faults=("microphone 2 is silent",))
    told = [
        (m.severity, m.text)
        for start_s, status in ((0.0, ill), (20.0, QUIET))
        for m in said(component, status, 20, start_s)
        if m.get_type() == "STATUSTEXT"
    ]
    assert told == [
        (common.MAV_SEVERITY_WARNING, "microphone 2 is silent"),
        (common.MAV_SEVERITY_NOTICE, "Cleared: microphone 2 is silent"),
    ]


def test_a_fault_that_flickers_is_one_fault() -> None:
    component = Component(MavlinkSettings())
    ill = replace(QUIET, faults=("microphone 2 is silent",))
    told = [
        text
        for tick in range(200)
        for text in texts(decode(component.due(tick * TICK_S, (ill, QUIET)[tick % 2])))
    ]
    assert told == ["microphone 2 is silent"]


def test_a_deaf_daemon_still_tells_its_faults() -> None:
    lost = replace(DEAF, faults=("sound card is gone",))
    messages = said(Component(MavlinkSettings()), lost, 10)
    assert texts(messages) == ["sound card is gone"]
    assert len(messages) == 1


def test_texts_keep_their_distance_and_the_overflow_is_counted() -> None:
    component = Component(MavlinkSettings())
    flood = replace(QUIET, faults=tuple(f"fault {k}" for k in range(20)))
    told = [(t, m.text) for t, m in speak(component, flood, 10) if m.get_type() == "STATUSTEXT"]
    assert [text for _, text in told] == [
        *(f"fault {k}" for k in range(voice.TEXTS_WAITING)),
        f"{20 - voice.TEXTS_WAITING} texts were left out: too many at once",
    ]
    assert component.texts_dropped == 20 - voice.TEXTS_WAITING
    assert told[-1][0] >= (len(told) - 1) * voice.TEXT_S


def test_a_call_goes_before_faults_even_when_the_queue_is_full() -> None:
    component = Component(MavlinkSettings())
    flood = tuple(f"fault {k}" for k in range(20))
    component.due(0.0, replace(QUIET, faults=flood))
    told = texts(said(component, replace(CALLING, faults=(*flood, "one more")), 9, 0.1))
    assert told[0].startswith("Call heard")
    assert told[1:-1] == [f"fault {k}" for k in range(1, voice.TEXTS_WAITING)], "the newest made room"
    assert told[-1] == f"{component.texts_dropped} texts were left out: too many at once"
    assert component.texts_dropped == 20 - voice.TEXTS_WAITING + 1


def test_when_the_link_comes_up_what_holds_is_told_again() -> None:
    component = Component(MavlinkSettings())
    ill = replace(CALLING, faults=("microphone 2 is silent",))
    first = texts(said(component, ill, 5))
    component.say_again()
    assert texts(said(component, ill, 5, 5.0)) == first
    assert len(first) == 2


@given(st.text(max_size=120) | st.text(min_size=95, max_size=260))
def test_any_text_fits_and_stays_readable(words: str) -> None:
    frames = Component(MavlinkSettings()).due(0.0, replace(QUIET, faults=(words,)))
    chunks = [m for m in decode(frames) if m.get_type() == "STATUSTEXT"]
    text = "".join(chunk.text for chunk in chunks)
    assert len(text) == min(199, len(words))
    assert all(" " <= c <= "~" for c in text)
    assert [chunk.chunk_seq for chunk in chunks] == list(range(len(chunks)))
    assert len({chunk.id for chunk in chunks}) == 1
    assert (chunks[0].id > 0) == (len(chunks) > 1) == (len(words) > 50), (
        "a number only where there are chunks"
    )
    assert all(len(chunk.text) == 50 for chunk in chunks[:-1])
    assert len(chunks) == 1 or len(chunks[-1].text) < 50, "what is not full ends it"
    assert all(a == b or b == "?" for a, b in zip(words, text, strict=False))


@given(
    st.floats(-10, 10), st.floats(0, 1e9) | st.just(math.nan), st.floats(-10, 10) | st.none(), st.booleans()
)
def test_a_calls_text_is_never_cut(azimuth: float, sigma: float, true: float | None, ambiguous: bool) -> None:
    earth = None if true is None else TrueBearing(true, sigma, None, sigma)
    track = replace(TRACK, azimuth_rad=azimuth, azimuth_sigma_rad=sigma, earth=earth)
    text = voice.call_text(track, ambiguous=ambiguous)
    assert len(text) <= 50
    assert ("or mirrored" in text) == ambiguous


# --- all of it ----------------------------------------------------------------------------------------

STATUSES = st.builds(
    Status,
    hearing=st.booleans(),
    track=st.none()
    | st.builds(Track, ANY, ANY, st.none() | ANY, ANY, ANY, ANY, ANY, st.integers(), earth=IN_ANY_EARTH),
    snr_db=ANY,
    faults=st.lists(st.text(), max_size=3).map(tuple),
)


@given(st.lists(STATUSES, max_size=30), st.binary(max_size=300))
def test_only_these_messages_ever_leave(statuses: list[Status], noise: bytes) -> None:
    component = Component(MavlinkSettings())
    ids: Counter[int] = Counter()
    for k, status in enumerate(statuses):
        component.receive(noise + heartbeat(7), k * 0.4)
        messages = decode(component.due(k * 0.4, status))
        ids.update(m.get_msgId() for m in messages)
        assert all(m.command == 511 for m in messages if m.get_msgId() == 76)  # SET_MESSAGE_INTERVAL
    assert set(ids) <= {0, 76, 111, 251, 253, 385, 59500, 59501}
    assert sum(ids.values()) == sum(component.sent.values())


# --- places -------------------------------------------------------------------------------------------


def test_a_call_without_a_place_is_told_again_once_it_has_one() -> None:
    component = Component(MavlinkSettings())
    first = texts(said(component, replace(PLACED, positions=()), 3))
    assert first == ["Call heard: 012 deg true, 042 from nose, +-4 deg"]
    assert texts(said(component, PLACED, 10, 3.0)) == ["Call heard: 012 deg true, 50 m +-8 m, conf 0.9"]
    component.say_again()
    assert texts(said(component, PLACED, 10, 13.0)) == ["Call heard: 012 deg true, 50 m +-8 m, conf 0.9"]


def test_no_place_is_told_where_the_range_is_not_observable() -> None:
    nowhere = position(range_observable=False, latitude_deg=None, longitude_deg=None, altitude_m=None)
    messages = said(Component(MavlinkSettings()), replace(PLACED, positions=(nowhere,)), 5)
    assert not any(m.get_type() == "LOCAGEN_POSITION" for m in messages)
    assert not any(" m +-" in text for text in texts(messages))


def test_the_records_say_what_is_known() -> None:
    messages = said(Component(MavlinkSettings(send_tunnel=False), start_s=0.5), PLACED, 5)
    bearing = next(m for m in messages if m.get_type() == "LOCAGEN_BEARING")
    assert bearing.time_usec == 1_500_000
    assert (bearing.lat, bearing.lon, bearing.alt, bearing.height) == (470_000_000, 80_000_000, 420_000, 20)
    assert bearing.azimuth_true == pytest.approx(12.0)
    assert (bearing.snr, bearing.noise_level) == (6.0, -41.0)
    place = [m for m in messages if m.get_type() == "LOCAGEN_POSITION"][-1]
    assert place.time_usec == 1_500_000
    assert place.lat * 1e-7 == pytest.approx(position().latitude_deg, abs=1e-7)
    assert (place.alt, place.looks) == (401_500, 12)
    assert (place.covariance_nn, place.covariance_ne, place.covariance_ee) == (60.0, 5.0, 9.0)
    flags = dialect.messages
    assert place.flags == (
        flags.LOCAGEN_POSITION_FLAGS_ALTITUDE_VALID
        | flags.LOCAGEN_POSITION_FLAGS_ON_GROUND
        | flags.LOCAGEN_POSITION_FLAGS_CONFIRMED
    )


@pytest.mark.parametrize("two", [True, False])
def test_what_may_as_well_be_mirrored_is_marked(two: bool) -> None:
    messages = said(Component(MavlinkSettings()), replace(PLACED, ambiguous=two), 1)
    flags = [m.flags for m in messages if m.get_type() == "LOCAGEN_BEARING"]
    assert {bool(f & dialect.messages.LOCAGEN_BEARING_FLAGS_AMBIGUOUS) for f in flags} == {two}


def test_every_confirmed_caller_has_a_record_and_values_are_of_the_best() -> None:
    others = (replace(IN_EARTH, id=7), replace(IN_EARTH, id=8, confidence=0.1))
    status = replace(PLACED, others=others, positions=(position(7), position(8)))
    messages = said(Component(MavlinkSettings()), status, 5)
    assert {m.event_id for m in messages if m.get_type() == "LOCAGEN_BEARING"} == {0, 7}
    assert {m.event_id for m in messages if m.get_type() == "LOCAGEN_POSITION"} == {7}


@pytest.mark.parametrize("ways", [(), ("message",), ("tunnel",), ("message", "tunnel")])
def test_the_settings_choose_how_records_go(ways: tuple[str, ...]) -> None:
    messages = said(
        Component(MavlinkSettings(send_records="message" in ways, send_tunnel="tunnel" in ways)), PLACED, 5
    )
    kinds = {m.get_type() for m in messages}
    assert ({"LOCAGEN_BEARING", "LOCAGEN_POSITION"} <= kinds) == ("message" in ways)
    assert ("TUNNEL" in kinds) == ("tunnel" in ways)
    if len(ways) == 2:
        inside = [dialect.untunnel(m).to_dict() for m in messages if m.get_type() == "TUNNEL"]
        assert inside == [m.to_dict() for m in messages if m.get_type().startswith("LOCAGEN")]


def test_that_nothing_is_heard_is_told_once_a_second_and_by_the_deaf_never() -> None:
    component = Component(MavlinkSettings(send_tunnel=False))
    quiet = [m for m in said(component, QUIET, 10) if m.get_type() == "LOCAGEN_BEARING"]
    assert len(quiet) == 10
    assert all(m.flags & dialect.messages.LOCAGEN_BEARING_FLAGS_NOTHING_HEARD for m in quiet)
    assert all(m.event_id == 0 and math.isnan(m.azimuth_body) for m in quiet)
    assert said(component, DEAF, 10, 10.0) == []


@given(
    st.floats(-90, 90), st.floats(-180, 180), st.floats(0, 1e9), st.floats(-400, 9000) | st.none(),
    st.floats(allow_nan=True, allow_infinity=True),
)  # fmt: skip
def test_no_place_breaks_the_line_or_the_wire(
    lat: float, lon: float, sigma: float, alt: float | None, age: float
) -> None:
    place = position(latitude_deg=lat, longitude_deg=lon, semi_major_m=sigma, altitude_m=alt, age_s=age)
    messages = said(Component(MavlinkSettings()), replace(PLACED, positions=(place,)), 1)
    assert any(m.get_type() == "LOCAGEN_POSITION" for m in messages)
    assert all(len(text) <= 50 for text in texts(messages))


def test_sent_counts_by_name() -> None:
    component = Component(MavlinkSettings())
    said(component, CALLING, 10)
    assert component.sent == {
        "HEARTBEAT": 10,
        "STATUSTEXT": 1,
        "LOCAGEN_BEARING": 20,
        "TUNNEL": 20,
        **dict.fromkeys(("LG_AZB", "LG_EL", "LG_SIG", "LG_CONF", "LG_SNR"), 20),
    }


def test_nothing_here_imports_the_blocking_mavutil() -> None:
    code = (
        "import sys, locagen_edge.mavlink.component, locagen_edge.mavlink.link;"
        "sys.exit('pymavlink.mavutil' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
