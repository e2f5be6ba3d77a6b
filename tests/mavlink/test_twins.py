"""Laws of our ids on a network: another under them is told once, our own echo never, neither is obeyed."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from test_component import CALLING, QUIET, TICK_S, decode, heartbeat, said, texts

from locagen_edge.mavlink import dialect, twins
from locagen_edge.mavlink.component import Component, Hands
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.signing import Guard
from locagen_edge.mavlink.twins import HEARD, WITHIN_S, Numbers
from locagen_edge.settings import MavlinkSettings, PoseSettings

TAKEN = "Ids 1/191 are taken: set mavlink.component_id"


class Other:
    """A component under our ids, with what it sends."""

    def __init__(self, begins: int = 0) -> None:
        self._mav = common.MAVLink(None, 1, 191)
        self._mav.seq = begins

    def says(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def heartbeat(self) -> bytes:
        return self.says(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))


def numbered(numbers: Numbers, component: Component, now_s: float) -> dict[int, list[bytes]]:
    """What leaves on two links."""
    frames = component.due(now_s, QUIET)
    return {link: [numbers.number(frame, link) for frame in frames] for link in (0, 1)}


def test_another_under_our_ids_is_told_once_while_we_go_on_and_again_when_it_has_gone() -> None:
    component, other = Component(MavlinkSettings(), pose=PoseSettings(rate_hz=0.0)), Other()
    told = ""
    beats = 0
    for tick in range(round(60.0 / TICK_S)):
        now_s = tick * TICK_S
        if tick % round(1.0 / TICK_S) == 0 and now_s < 20.0:
            component.receive(heartbeat(1) + other.heartbeat(), now_s)
        messages = decode(component.due(now_s, QUIET))
        told += "".join(texts(messages))
        beats += sum(m.get_type() == "HEARTBEAT" for m in messages)
        assert all(m.system_status == 4 for m in messages if m.get_type() == "HEARTBEAT"), "no fault of ours"
    assert told == f"{TAKEN}Cleared: {TAKEN}"
    assert beats == 60
    assert len(TAKEN.replace("1/191", "254/194")) <= dialect.TEXT_BYTES


@pytest.mark.parametrize(("key", "version_1"), [(None, False), (bytes(32), False), (None, True)])
def test_our_own_heartbeats_that_come_back_by_another_link_are_no_other(key, version_1) -> None:
    """A router, or an autopilot with two links to us, hands on to one what we say on the other."""
    numbers, guard = Numbers(), Guard(key, timestamp=10**13)
    component = Component(MavlinkSettings(), guard=Guard(key, timestamp=10**13), numbers=numbers)
    for tick in range(400):
        now_s = tick * TICK_S
        for link, frames in numbered(numbers, component, now_s).items():
            for frame in frames:
                back = as_version_1(frame) if version_1 else guard.sign(frame, link)
                component.receive(back, now_s + 0.3, 1 - link)
        assert component.complaints(now_s) == ()
        assert component.answers(0) == component.answers(1) == [], "nothing is said to ourselves"


def as_version_1(frame: bytes) -> bytes:
    """As an autopilot hands it on to a link that is set to MAVLink 1; ids above 255 cannot."""
    if frame[8] or frame[9]:
        return b""
    body = bytes((frame[1], *frame[4:8])) + frame[10:-2]
    seed = dialect.LAYOUTS[frame[7]].crc_extra
    return b"\xfe" + body + dialect.checksum(body, seed).to_bytes(2, "little")


def test_what_our_last_start_left_behind_in_a_router_is_not_told() -> None:
    component, other = Component(MavlinkSettings()), Other()
    for _ in range(HEARD - 1):
        component.receive(other.heartbeat(), 0.0)
    assert component.complaints(1.0) == ()
    component.receive(other.heartbeat(), WITHIN_S + 1.0)
    assert component.complaints(WITHIN_S + 1.0) == ()


def test_nothing_that_comes_under_our_ids_is_obeyed_or_answered() -> None:
    """Two that answer one another go on for ever."""
    done: list[Any] = []
    hands = Hands(apply=done.append, listen=done.append, forget_noise=lambda: done.append("forget"))
    component, other = Component(MavlinkSettings(), hands=hands), Other()
    asked = [
        common.MAVLink_ping_message(1, 1, 0, 0),
        common.MAVLink_timesync_message(0, 1),
        common.MAVLink_param_request_list_message(1, 191),
        common.MAVLink_param_set_message(1, 191, b"LG_TRK_COAST", 4.0, 9),
        common.MAVLink_command_long_message(1, 191, 31011, 0, 0, 0, 0, 0, 0, 0, 0),
        common.MAVLink_command_ack_message(511, 0, 0, 0, 1, 191),
        common.MAVLink_file_transfer_protocol_message(0, 1, 191, bytes(251)),
    ]
    for message in asked:
        component.receive(other.says(message), 1.0)
    said(component, CALLING, 3, 1.0)
    assert component.answers(0) == []
    assert done == []


@given(st.lists(st.integers(0, 3), max_size=600))
def test_each_link_counts_its_own_frames_without_a_gap(links: list[int]) -> None:
    numbers, sender = Numbers(), dialect.Sender(1, 191)
    expected = dict.fromkeys(range(4), 0)
    for link in links:
        frame = numbers.number(sender.pack(dialect.heartbeat(4)), link)
        (packet,) = Framer().feed(frame)
        assert packet.sequence == expected[link] % 256
        assert dialect.decode(packet.raw).type == 18
        assert numbers.ours(packet)
        expected[link] += 1
    assert len(numbers._beats) <= twins.ECHOES
