"""Laws of signing, with pymavlink as the other end: both understand each other, nobody else gets in."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from locagen_edge.errors import LinkError
from locagen_edge.mavlink import dialect, signing
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.framer import Framer, Packet
from locagen_edge.mavlink.records import BearingRecord, bearing_message
from locagen_edge.mavlink.signing import COMPLAINTS, Guard
from locagen_edge.settings import MavlinkSettings, from_table

KEY = bytes(range(32))
NOON = 40_000_000_000_000  # some time in 2027
MINUTE = 60 * signing.UNITS_PER_S
QUIET = Status(hearing=True, track=None, snr_db=0.0, faults=())


def guard(key: bytes | None = KEY, timestamp: int = NOON, clock: int = 0, link_id: int = 0) -> Guard:
    return Guard(key, link_id, timestamp, clock=lambda: clock)


class Peer:
    """pymavlink's own implementation, as an autopilot with a key."""

    def __init__(self, key: bytes | None = KEY, timestamp: int = NOON, component: int = 1) -> None:
        self.mav = common.MAVLink(None, 7, component)
        self.mav.signing.secret_key = key
        self.mav.signing.sign_outgoing = key is not None
        self.mav.signing.timestamp = timestamp
        self.mav.signing.link_id = 3

    def heartbeat(self) -> bytes:
        return bytes(common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(self.mav))

    def reads(self, frame: bytes) -> Any:
        return self.mav.decode(bytearray(frame))


def packet(frame: bytes) -> Packet:
    (found,) = Framer().feed(frame)
    return found


def ours(guard: Guard, link: int = 0) -> bytes:
    return guard.sign(dialect.Sender(7, 191).pack(dialect.heartbeat(dialect.STATE_ACTIVE)), link)


# --- with pymavlink -----------------------------------------------------------------------------------


def test_pymavlink_reads_what_we_sign():
    peer, we = Peer(), guard(link_id=5)
    for _ in range(3):
        message = peer.reads(ours(we, link=2))
        assert message.get_signed()
        assert message.get_link_id() == 7
        assert message.get_type() == "HEARTBEAT"


@given(st.integers(1, 2**31), st.floats(allow_nan=False))
def test_pymavlink_verifies_every_message_that_we_sign(event_id, azimuth_rad):
    """A long message and one whose end is cut, neither of which its dialect knows."""
    record = BearingRecord(
        time_us=1, autopilot_time=True, event_id=event_id, azimuth_true_rad=azimuth_rad, call=event_id % 2
    )
    we, peer = guard(), Peer()
    frame = we.sign(dialect.Sender(7, 191).pack(bearing_message(record)))
    assert peer.mav.check_signature(bytearray(frame), 7, 191)
    assert Framer().feed(frame)[0].signed


def test_we_admit_what_pymavlink_signs():
    peer, we = Peer(), guard()
    for _ in range(3):
        assert we.admit(packet(peer.heartbeat()), 0.0)
    assert we.counts == {"admitted": 3}


def test_a_wrong_key_is_refused_at_both_ends():
    we, peer = guard(bytes(32)), Peer()
    assert not we.admit(packet(peer.heartbeat()), 0.0)
    assert we.counts == {"wrong": 1}
    with pytest.raises(common.MAVError, match="signature"):
        peer.reads(ours(we))


# --- what is refused ----------------------------------------------------------------------------------


def test_unsigned_and_mavlink_1_are_refused():
    we, plain = guard(), Peer(key=None)
    assert not we.admit(packet(plain.heartbeat()), 0.0)
    old = common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(plain.mav, force_mavlink1=True)
    assert not we.admit(packet(bytes(old)), 0.0)
    assert we.counts == {"unsigned": 2}


def test_a_recorded_frame_is_not_obeyed_again():
    we, peer = guard(), Peer()
    first, second = peer.heartbeat(), peer.heartbeat()
    assert we.admit(packet(second), 0.0)
    assert not we.admit(packet(second), 0.0)
    assert not we.admit(packet(first), 0.0), "an older one neither"
    assert we.admit(packet(peer.heartbeat()), 0.0)
    assert we.counts == {"admitted": 2, "replayed": 2}


def test_a_new_stream_may_be_a_minute_behind_and_no_more():
    assert guard().admit(packet(Peer(timestamp=NOON - MINUTE).heartbeat()), 0.0)
    assert not guard().admit(packet(Peer(timestamp=NOON - MINUTE - 2).heartbeat()), 0.0)


def test_a_forged_timestamp_locks_nobody_out():
    """Only a frame whose signature is right may move the clock of its stream."""
    we, peer = guard(), Peer()
    forged = bytearray(peer.heartbeat())
    forged[-12:-6] = b"\xff" * 6
    assert not we.admit(packet(bytes(forged)), 0.0)
    assert we.timestamp == NOON
    assert we.admit(packet(peer.heartbeat()), 0.0)


def test_streams_are_bounded():
    we = guard()
    for component in range(signing.STREAMS + 10):
        we.admit(packet(Peer(component=component + 1).heartbeat()), 0.0)
    assert we.counts["admitted"] == signing.STREAMS


@given(st.integers(0, 8 * 34 - 1))
def test_no_flipped_bit_is_admitted(bit):
    peer, we = Peer(), guard()
    frame = bytearray(peer.heartbeat())
    frame[bit // 8 % len(frame)] ^= 1 << bit % 8
    assert not any(we.admit(found, 0.0) for found in Framer().feed(bytes(frame) + bytes(300)))


# --- the clock ----------------------------------------------------------------------------------------


def test_every_frame_is_later_than_the_one_before():
    we, peer = guard(), Peer(timestamp=NOON)
    stamps = []
    for _ in range(50):
        peer.reads(ours(we))  # raises where it is not
        stamps.append(we.timestamp)
    assert stamps == sorted(set(stamps))


def test_a_computer_without_a_clock_takes_the_autopilots():
    we, autopilot = guard(timestamp=0, clock=5), Peer(timestamp=NOON)
    with pytest.raises(common.MAVError):
        autopilot.reads(ours(we))
    assert we.admit(packet(autopilot.heartbeat()), 0.0)
    autopilot.reads(ours(we))


def test_the_wall_clock_counts_from_2015():
    assert signing.wall_clock() / signing.UNITS_PER_S == pytest.approx(time.time() - 1420070400, abs=5)


def test_a_restart_never_goes_back_whatever_the_clock_says(tmp_path):
    state, timestamp = tmp_path / "deep" / "state", NOON
    for clock in (NOON, 0, NOON // 2, 0):  # a clock that is lost and comes back
        we = guard(timestamp=max(signing.load_timestamp(state), clock), clock=clock)
        ours(we)
        assert we.timestamp > timestamp
        timestamp = we.timestamp
        signing.save_timestamp(state, timestamp)
        assert timestamp - NOON < 10 * signing.UNITS_PER_S, "and does not run away from the others"
    assert os.listdir(state.parent) == ["state"]


def test_after_a_reboot_it_goes_on_beyond_what_can_have_been_used(tmp_path, monkeypatch):
    state = tmp_path / "state"
    signing.save_timestamp(state, NOON)
    monkeypatch.setattr(signing, "_boot", lambda: "another")
    assert signing.load_timestamp(state) == NOON + signing.REBOOT
    assert signing.SAVE_S * signing.UNITS_PER_S < signing.REBOOT < signing.NEW_STREAM


def test_a_state_that_is_damaged_is_told(tmp_path):
    state = tmp_path / "state"
    state.write_text("soon")
    with pytest.raises(LinkError, match="delete it"):
        signing.load_timestamp(state)


def test_a_state_that_cannot_be_kept_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(LinkError, match=r"state_directory"):
        signing.save_timestamp(tmp_path / "file" / "state", 1)


# --- the key ------------------------------------------------------------------------------------------


def key_file(tmp_path: Path, content: bytes, mode: int = 0o600) -> Path:
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (KEY.hex().encode() + b"\n", KEY),
        (KEY.hex().upper().encode(), KEY),
        (b"correct horse battery\n", hashlib.sha256(b"correct horse battery").digest()),
        ("Bergwacht Süd".encode(), hashlib.sha256("Bergwacht Süd".encode()).digest()),
        (b"z" * 64, hashlib.sha256(b"z" * 64).digest()),
    ],
)
def test_a_key_is_hex_or_a_passphrase(tmp_path, content, key):
    assert signing.read_key(key_file(tmp_path, content)) == key


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        (b"secret", 0o644, "chmod 600"),
        (b"secret", 0o660, "chmod 600"),
        (b"", 0o600, "one line"),
        (b"two\nlines", 0o600, "one line"),
        (b"\xff\xfe\x00", 0o600, "not text"),
    ],
)
def test_a_key_that_is_no_good_is_refused_in_one_line(tmp_path, content, mode, words):
    path = key_file(tmp_path, content, mode)
    with pytest.raises(LinkError, match=words) as refused:
        signing.read_key(path)
    assert str(refused.value).startswith(f"mavlink.signing_key: {path}")
    assert "\n" not in str(refused.value)
    assert "secret" not in str(refused.value)


def test_a_missing_key_is_told(tmp_path):
    with pytest.raises(LinkError, match="No such file"):
        signing.read_key(tmp_path / "absent")


def test_the_settings_make_the_guard(tmp_path):
    settings = {"signing_key": str(key_file(tmp_path, KEY.hex().encode())), "state_directory": str(tmp_path)}
    we = signing.guard_of(from_table({"mavlink": settings}))
    assert we.signs
    Peer(timestamp=0).reads(ours(we))
    assert (tmp_path / signing.STATE_FILE).exists()
    assert not signing.guard_of(from_table({})).signs


# --- what the operator is told ------------------------------------------------------------------------


@pytest.mark.parametrize("told", COMPLAINTS.values())
def test_complaints_fit_a_text(told):
    assert len(told) <= dialect.TEXT_BYTES


def test_silence_that_a_signature_may_explain_is_told_after_a_while_and_taken_back():
    we, stranger, peer = guard(), Peer(bytes(32)), Peer()
    we.admit(packet(stranger.heartbeat()), 10.0)
    assert we.complaints(10.0 + signing.SILENCE_S - 0.1) == ()
    assert we.complaints(10.0 + signing.SILENCE_S) == (COMPLAINTS["wrong"],)
    we.admit(packet(peer.heartbeat()), 20.0)
    assert we.complaints(30.0) == ()


def test_strangers_beside_an_autopilot_that_signs_are_no_complaint():
    we, stranger, peer = guard(), Peer(None, component=100), Peer()
    for second in range(60):
        we.admit(packet(stranger.heartbeat()), second)
        we.admit(packet(peer.heartbeat()), second + 0.5)
        assert we.complaints(second + 0.9) == ()


def test_an_autopilot_that_signs_is_told_where_we_have_no_key():
    we = guard(None)
    assert we.admit(packet(Peer(None).heartbeat()), 0.0)
    assert we.complaints(0.0) == ()
    assert we.admit(packet(Peer().heartbeat()), 1.0), "without a key all is heard"
    assert we.complaints(1.0) == (COMPLAINTS["no key"],)


def test_the_component_obeys_only_its_own_kind_and_says_why():
    component = Component(MavlinkSettings(), guard=guard())
    stranger, peer = Peer(None), Peer()
    said = []
    for second in range(10):
        component.receive(stranger.heartbeat(), second)
        said += component.due(second, QUIET)
    assert component.autopilot_heard_s is None
    assert component.system_id == 1
    texts = [dialect.decode(found.raw) for frame in said for found in Framer().feed(frame)]
    assert [m.text for m in texts if m.get_type() == "STATUSTEXT"] == [COMPLAINTS["unsigned"]]
    component.receive(peer.heartbeat(), 11.0)
    assert component.system_id == 7


@pytest.mark.parametrize("key", [None, KEY])
def test_an_autopilot_that_never_answers_is_told_until_it_does(key):
    """What it does with messages that it does not trust: nothing, without a word."""
    component, peer = Component(MavlinkSettings(system_id=7), guard=guard(key)), Peer(key)
    we = component.guard
    for second in range(signing.ASKED):
        assert we.complaints(100.0) == ()
        we.asked(second)
    assert we.complaints(signing.UNANSWERED_S - 0.1) == ()
    assert we.complaints(signing.UNANSWERED_S) == (COMPLAINTS["unanswered"],)
    component.receive(bytes(common.MAVLink_command_ack_message(511, 0).pack(peer.mav)), 100.0)
    assert we.complaints(200.0) == ()


def test_questions_for_the_pose_that_nobody_answers_are_told_to_the_operator():
    """An autopilot with a key that we do not have, on a port where it does not sign itself."""
    component, peer = Component(MavlinkSettings()), Peer(None)
    said = []
    for tenth in range(200):
        if tenth % 10 == 0:
            component.receive(peer.heartbeat(), tenth / 10)
        said += component.due(tenth / 10, QUIET)
    assert component.sent["COMMAND_LONG"] >= signing.ASKED
    texts = [dialect.decode(found.raw) for frame in said for found in Framer().feed(frame)]
    assert [m.text for m in texts if m.get_type() == "STATUSTEXT"] == [COMPLAINTS["unanswered"]]
