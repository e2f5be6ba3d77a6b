"""Laws of our own messages: ids that are free, one meaning on every path, nothing that cannot be sent."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pymavlink.dialects.v20
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from pymavlink.generator import mavgen

from locagen_edge.mavlink import build_dialect, dialect
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.records import (
    UNKNOWN,
    BearingRecord,
    PositionRecord,
    bearing_message,
    position_message,
)
from locagen_edge.types import Pose

DEFINITIONS = Path(pymavlink.dialects.v20.__path__[0])
OWN = ET.parse(build_dialect.OWN_XML).getroot()

ANY = st.one_of(st.none(), st.floats())
INTEGER = st.integers(-(2**70), 2**70)
POSE = st.builds(
    Pose,
    t_ns=st.just(0),
    attitude=st.one_of(st.none(), st.tuples(*[st.floats()] * 4)),
    latitude_deg=ANY,
    longitude_deg=ANY,
    altitude_m=ANY,
    height_m=ANY,
)
BEARING = st.builds(
    BearingRecord,
    time_us=INTEGER,
    event_id=INTEGER,
    autopilot_time=st.booleans(),
    **dict.fromkeys(
        (
            "azimuth_body_rad",
            "azimuth_true_rad",
            "azimuth_sigma_rad",
            "elevation_rad",
            "elevation_sigma_rad",
            "confidence",
            "snr_db",
            "noise_dbfs",
        ),
        ANY,
    ),
    pose=st.one_of(st.none(), POSE),
    call=st.integers(-5, 300),
    confirmed=st.booleans(),
    simulated=st.booleans(),
)
POSITION = st.builds(
    PositionRecord,
    time_us=INTEGER,
    autopilot_time=st.booleans(),
    event_id=INTEGER,
    latitude_deg=st.floats(-90, 90),
    longitude_deg=st.floats(-180, 180),
    altitude_m=ANY,
    covariance_m2=st.tuples(*[st.floats()] * 3),
    age_s=st.floats(),
    looks=INTEGER,
)
FLAG = {name: value for name, value in vars(dialect.messages).items() if name.startswith("LOCAGEN_")}


def sent(message):
    """What arrives of a message: the decoded frame of another end."""
    (packet,) = Framer().feed(dialect.Sender(1, 191).pack(message))
    return dialect.decode(packet.raw)


def payload(message) -> bytes:
    """As it is on the wire, zeros at its end cut off."""
    frame = dialect.Sender(1, 191).pack(message)
    return frame[10 : 10 + frame[1]]


def test_ids_are_free_in_all_that_mavlink_knows():
    taken = {
        int(message.get("id"))
        for path in build_dialect.with_includes(DEFINITIONS / "all.xml")
        for message in ET.parse(path).iter("message")
    }
    assert len(taken) > 200
    own = {int(message.get("id")) for message in OWN.iter("message")}
    assert own == {dialect.LOCAGEN_BEARING, dialect.LOCAGEN_POSITION}
    assert not own & taken
    assert all(52100 <= id < 60000 for id in own)  # the range that all.xml has left to give
    assert all(32768 <= id < 65536 for id in own)  # they are payload types of TUNNEL too, unregistered ones


def test_the_definition_keeps_mavlinks_schema_units_too(tmp_path):
    opts = mavgen.Opts(str(tmp_path / "own.py"), "2.0", "Python3", validate=True, strict_units=True)
    assert mavgen.mavgen(opts, [str(build_dialect.OWN_XML)])


def test_the_messages_of_others_are_theirs():
    """Picked from MAVLink's definitions, so every checksum seed and layout is the common dialect's."""
    for id, kind in dialect.messages.mavlink_map.items():
        if id not in (dialect.LOCAGEN_BEARING, dialect.LOCAGEN_POSITION):
            theirs = common.mavlink_map[id]
            assert (kind.crc_extra, kind.unpacker.format) == (theirs.crc_extra, theirs.unpacker.format)


def test_layout_and_seed_never_change():
    """A message that is out in the world gets extension fields, or a new id; nothing else."""
    layouts = {id: dialect.LAYOUTS[id] for id in (dialect.LOCAGEN_BEARING, dialect.LOCAGEN_POSITION)}
    assert layouts == {59500: dialect.Layout(92, 79), 59501: dialect.Layout(56, 44)}


@given(BEARING)
def test_any_bearing_can_be_sent_and_says_what_holds(record):
    message = sent(bearing_message(record))

    def flagged(name: str) -> bool:
        return bool(message.flags & FLAG[f"LOCAGEN_BEARING_FLAGS_{name}"])

    for name, valid in (
        ("azimuth_body", "AZIMUTH_BODY_VALID"),
        ("azimuth_true", "AZIMUTH_TRUE_VALID"),
        ("elevation", "ELEVATION_VALID"),
    ):
        assert flagged(valid) != math.isnan(getattr(message, name))
    assert flagged("ATTITUDE_VALID") == (not any(map(math.isnan, message.q)))
    assert flagged("POSITION_VALID") == (message.lat != UNKNOWN) == (message.lon != UNKNOWN)
    assert flagged("NOTHING_HEARD") == (message.event_id == 0)
    assert flagged("CONFIRMED") == record.confirmed
    assert flagged("SIMULATED") == record.simulated
    for value, least, below in (
        (message.azimuth_body, 0, 360),
        (message.azimuth_true, 0, 360),
        (message.azimuth_sigma, 0, 181),
        (message.elevation, -90, 91),
        (message.confidence, 0, 1.1),
    ):
        assert math.isnan(value) or least <= value < below


@given(POSITION)
def test_any_position_on_earth_can_be_sent(record):
    message = sent(position_message(record))
    assert abs(message.lat * 1e-7 - record.latitude_deg) < 1e-7
    assert abs(message.lon * 1e-7 - record.longitude_deg) < 1e-7
    known = bool(message.flags & FLAG["LOCAGEN_POSITION_FLAGS_ALTITUDE_VALID"])
    assert known == (message.alt != UNKNOWN)
    if known:
        assert abs(message.alt * 1e-3 - record.altitude_m) < 1e-3


@pytest.mark.parametrize("place", [(math.nan, 0.0), (90.1, 0.0), (0.0, math.inf)])
def test_a_place_that_is_none_is_not_sent(place):
    with pytest.raises(ValueError, match="no place"):
        position_message(
            PositionRecord(
                time_us=0,
                autopilot_time=False,
                event_id=1,
                latitude_deg=place[0],
                longitude_deg=place[1],
                altitude_m=None,
                covariance_m2=(1.0, 0.0, 1.0),
                age_s=0.0,
                looks=1,
            )
        )


def test_what_is_known_arrives_as_it_was():
    record = BearingRecord(
        time_us=12_345_678_901,
        autopilot_time=True,
        event_id=7,
        azimuth_body_rad=math.radians(-30),
        azimuth_true_rad=math.radians(405),
        azimuth_sigma_rad=math.radians(2.5),
        confidence=0.75,
        snr_db=6.5,
        noise_dbfs=-31.25,
        pose=Pose(0, (0.5, -0.5, 0.5, 0.5), 47.3977418, 8.5455938, 488.125, 21.5),
        call=FLAG["LOCAGEN_CALL_VOICE"],
    )
    message = sent(bearing_message(record))
    assert message.time_usec == 12_345_678_901
    assert message.event_id == 7
    assert message.azimuth_body == pytest.approx(330, abs=1e-4)
    assert message.azimuth_true == pytest.approx(45, abs=1e-4)
    assert (message.confidence, message.snr, message.noise_level) == (0.75, 6.5, -31.25)
    assert (message.lat, message.lon, message.alt, message.height) == (473977418, 85455938, 488125, 21.5)
    assert list(message.q) == [0.5, -0.5, 0.5, 0.5]
    assert math.isnan(message.elevation)
    assert message.call == 1


@given(st.one_of(BEARING.map(bearing_message), POSITION.map(position_message)))
def test_a_tunnel_carries_the_same_bytes(message):
    direct = sent(message)
    tunnelled = sent(dialect.tunnel(message))
    assert tunnelled.payload_type == message.id
    assert bytes(tunnelled.payload)[: tunnelled.payload_length] == payload(message)
    inner = dialect.untunnel(tunnelled)
    # NaN is not equal to itself: compare what the wire would hold
    assert inner.get_type() == direct.get_type()
    assert str(inner) == str(direct)


@given(st.integers(0, 65535), st.integers(0, 255), st.binary(min_size=128, max_size=128))
def test_any_tunnel_is_taken_without_a_word(payload_type, length, content):
    for kind in (payload_type, dialect.LOCAGEN_BEARING, dialect.LOCAGEN_POSITION):
        inner = dialect.untunnel(common.MAVLink_tunnel_message(0, 0, kind, length, content))
        assert (inner is None) == (kind not in (59500, 59501) or length > 128)


def test_a_newer_senders_extension_fields_are_passed_over():
    message = bearing_message(BearingRecord(time_us=5, autopilot_time=True, event_id=9, call=1))
    outer = dialect.tunnel(message)
    outer.payload_length += 4
    outer.payload = outer.payload[:79] + b"new!" + outer.payload[83:]
    assert str(dialect.untunnel(outer)) == str(sent(message))


def test_only_what_may_leave_leaves():
    sender = dialect.Sender(1, 191)
    with pytest.raises(ValueError, match="DISTANCE_SENSOR"):
        sender.pack(dialect.messages.MAVLink_distance_sensor_message(0, 1, 2, 1, 0, 0, 0, 0))
    arm = common.MAV_CMD_COMPONENT_ARM_DISARM
    with pytest.raises(ValueError, match="command 400 "):
        sender.pack(dialect.messages.MAVLink_command_long_message(1, 1, arm, 0, 1, 0, 0, 0, 0, 0, 0))


@given(st.binary(max_size=300), st.integers(0, 255))
def test_the_checksum_is_mavlinks(data, crc_extra):
    assert dialect.checksum(data, crc_extra) == common._x25crc_slow(data + bytes((crc_extra,))).crc


@given(st.sampled_from(sorted(set(dialect.LAYOUTS) & set(common.mavlink_map))), st.binary(max_size=255))
def test_fields_are_read_as_the_generated_code_reads_them(id, content):
    """Of any payload, shorter or longer than the message; only the checksum has to be right."""
    frame = b"\xfd" + bytes((len(content), 0, 0, 7, 8, 9)) + id.to_bytes(3, "little") + content
    frame += dialect.checksum(frame[1:], dialect.LAYOUTS[id].crc_extra).to_bytes(2, "little")
    ours, theirs = dialect.decode(frame), common.MAVLink(None).decode(bytearray(frame))
    for name in theirs.fieldnames:
        field = getattr(theirs, name)
        if isinstance(field, list):
            field = tuple(field)
        assert repr(getattr(ours, name)) == repr(field)
    assert (ours.get_seq(), ours.get_srcSystem(), ours.get_srcComponent()) == (7, 8, 9)
    assert ours.get_msgId() == id
    assert ours.get_msgbuf() == frame
