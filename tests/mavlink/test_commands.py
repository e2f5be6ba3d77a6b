"""Laws of commands: each to us is acknowledged to its sender, done once, and none to others is touched."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from test_component import CALLING, QUIET, TICK_S, decode, said, texts
from test_parameters import answers, packed, setting

from locagen_edge import __version__
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.commands import ACCEPTED, DENIED, RESEND_S, TABLE, UNSUPPORTED
from locagen_edge.mavlink.component import CHANGES_AT_ONCE, CHANGES_PER_S, Component, Hands, Status
from locagen_edge.mavlink.computer import Computer
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.identity import machine_uid, version_number
from locagen_edge.settings import MavlinkSettings

LISTEN, FORGET = common.MAV_CMD_USER_1, common.MAV_CMD_USER_2
REQUEST, INTERVAL = common.MAV_CMD_REQUEST_MESSAGE, common.MAV_CMD_SET_MESSAGE_INTERVAL


def command(number: int, *given: float, system: int = 1, component: int = 191, as_int: bool = False) -> Any:
    four = [*given, 0.0, 0.0, 0.0, 0.0][:4]
    if as_int:
        return common.MAVLink_command_int_message(system, component, 0, number, 0, 0, *four, 0, 0, 0.0)
    return common.MAVLink_command_long_message(system, component, number, 0, *four, 0.0, 0.0, 0.0)


def ask(component: Component, message: Any, now_s: float = 0.0, link: int = 0) -> list[Any]:
    component.receive(packed(message), now_s, link)
    return answers(component, link)


def on_link(component: Component, link: int, status: Status, seconds: float, start_s: float) -> list[Any]:
    """What goes out on one link of several."""
    frames = []
    for tick in range(round(seconds / TICK_S)):
        common_ones = component.due(start_s + tick * TICK_S, status)
        frames += [frame for frame in common_ones if link not in component.apart(frame)]
        frames += component.own.get(link, [])
    return decode(frames)


def setting_message(number: int) -> Any:
    return common.MAVLink_param_set_message(1, 191, b"LG_TRK_COAST", 2.0 + number % 7, 9)


def results(messages: list[Any]) -> list[int]:
    return [m.result for m in messages if m.get_type() == "COMMAND_ACK"]


def hands() -> tuple[Hands, list[Any]]:
    done: list[Any] = []
    return Hands(listen=done.append, forget_noise=lambda: done.append("forget"), uid=77), done


@given(st.integers(0, 65535), st.tuples(*[st.floats(width=32)] * 4), st.booleans())
def test_every_command_to_us_is_acknowledged_to_its_sender_once(
    number: int, given: tuple[float, ...], as_int: bool
) -> None:
    component = Component(MavlinkSettings())
    got = ask(component, command(number, *given, as_int=as_int), link=3)
    acks = [m for m in got if m.get_type() == "COMMAND_ACK"]
    assert len(acks) == 1
    assert (acks[0].command, acks[0].target_system, acks[0].target_component) == (number, 255, 190)
    assert answers(component, 0) == []
    if number not in TABLE:
        assert acks[0].result == UNSUPPORTED


@given(st.sampled_from(sorted(TABLE)), st.tuples(*[st.floats(width=32) | st.integers(-1, 60000)] * 4))
def test_no_parameter_of_a_known_command_raises(number: int, given: tuple[float, ...]) -> None:
    assert len(results(ask(Component(MavlinkSettings()), command(number, *given)))) == 1


ASKED = sorted(
    {dialect.PING, dialect.TIMESYNC, dialect.PARAM_SET, dialect.PARAM_REQUEST_READ, 21, 75, 76, 110}
)


@given(st.lists(st.tuples(st.sampled_from(ASKED), st.binary(max_size=255), st.booleans()), max_size=8))
def test_nothing_that_is_asked_raises(asked: list[tuple[int, bytes, bool]]) -> None:
    component = Component(MavlinkSettings(), hands=hands()[0])
    for k, (id, content, ours) in enumerate(asked):
        head = b"\xfd" + bytes((len(content), 0, 0, k, 255, 190)) + id.to_bytes(3, "little")
        crc = dialect.checksum(head[1:] + content, dialect.LAYOUTS[id].crc_extra).to_bytes(2, "little")
        message = dialect.decode(head + content + crc)
        if ours and "target_system" in message.fieldnames:
            message.target_system, message.target_component = 1, 191
        frame = dialect.messages.MAVLink(None, 255, 190)
        component.receive(bytes(message.pack(frame)), 0.1 * k)
        component.due(0.1 * k, CALLING)
        component.answers(0)
    assert component.system_id == 1


@pytest.mark.parametrize(("system", "target"), [(1, 1), (2, 191), (0, 191), (0, 0), (1, 192)])
def test_what_is_not_for_us_is_neither_done_nor_acknowledged(system: int, target: int) -> None:
    moving, done = hands()
    component = Component(MavlinkSettings(), hands=moving)
    for number, one in ((LISTEN, 0.0), (FORGET, 0.0), (REQUEST, 148.0), (31099, 0.0)):
        assert ask(component, command(number, one, system=system, component=target)) == []
    assert done == []


def test_a_broadcast_is_answered_only_where_a_message_is_asked_for_that_we_have() -> None:
    moving, done = hands()
    component = Component(MavlinkSettings(), hands=moving)
    for number, one in ((LISTEN, 0.0), (FORGET, 0.0), (INTERVAL, 251.0), (REQUEST, 33.0), (400, 1.0)):
        assert ask(component, command(number, one, component=0)) == []
    assert done == []
    got = ask(component, command(REQUEST, 148.0, component=0))
    assert [m.get_type() for m in got] == ["COMMAND_ACK", "AUTOPILOT_VERSION"]


@pytest.mark.parametrize("unused", [0.0, math.nan])
def test_sent_again_it_is_acknowledged_again_and_done_once(unused: float) -> None:
    moving, done = hands()
    component = Component(MavlinkSettings(), hands=moving)
    for k in range(3):
        assert results(ask(component, command(FORGET, *[unused] * 4), now_s=0.5 * k)) == [ACCEPTED]
    assert done == ["forget"]
    assert results(ask(component, command(FORGET, *[unused] * 4), now_s=1.1 + RESEND_S)) == [ACCEPTED]
    assert done == ["forget", "forget"]


def test_start_and_stop() -> None:
    moving, done = hands()
    component = Component(MavlinkSettings(), hands=moving)
    assert results(ask(component, command(LISTEN, 0.0))) == [ACCEPTED]
    quiet = said(component, CALLING, 5)
    assert {m.get_type() for m in quiet} == {"HEARTBEAT", "STATUSTEXT"}, (
        "no bearing of what is not listened to"
    )
    assert {m.system_status for m in quiet if m.get_type() == "HEARTBEAT"} == {common.MAV_STATE_STANDBY}
    assert texts(quiet) == ["Stopped listening, as commanded"]
    assert results(ask(component, command(LISTEN, 1.0), now_s=5.0)) == [ACCEPTED]
    again = said(component, CALLING, 5, 5.0)
    assert "NAMED_VALUE_FLOAT" in {m.get_type() for m in again}
    assert done == [False, True]
    assert results(ask(component, command(LISTEN, 7.0))) == [DENIED]
    assert results(ask(component, command(LISTEN, math.nan))) == [DENIED]


def test_intervals_of_our_own_messages() -> None:
    component = Component(MavlinkSettings())

    def values_in_10_s(start_s: float, link: int = 0) -> int:
        return sum(
            m.get_type() == "NAMED_VALUE_FLOAT" and m.name == "LG_AZB"
            for m in on_link(component, link, CALLING, 10, start_s)
        )

    assert values_in_10_s(0) == 20
    for k, (us, wanted) in enumerate(((200_000, 50), (-1, 0), (0, 20))):
        assert results(ask(component, command(INTERVAL, 251, us))) == [ACCEPTED]
        assert values_in_10_s(100.0 * (k + 1)) == wanted
        (ack, told) = ask(component, command(common.MAV_CMD_GET_MESSAGE_INTERVAL, 251))
        assert ack.result == ACCEPTED
        assert told.interval_us == (us or 500_000)
        assert values_in_10_s(100.0 * (k + 1) + 20, link=1) == 20, "the other link's are as the settings say"
        (_, told) = ask(component, command(common.MAV_CMD_GET_MESSAGE_INTERVAL, 251), link=1)
        assert told.interval_us == 500_000
    for id, us in ((0, 100_000), (33, 100_000), (251, 10), (251, math.nan), (math.inf, 0), (251, -2)):
        assert results(ask(component, command(INTERVAL, id, us))) == [DENIED]
    assert ask(component, command(REQUEST, 244, 0))[1].interval_us == 1_000_000  # of HEARTBEAT
    assert ask(component, command(REQUEST, 244, 33))[1].interval_us == 0, "none of ours"
    assert ask(component, command(REQUEST, 244, 390))[1].interval_us == -1, "switched off"


@hypothesis_settings(max_examples=20)  # minutes of a component's time each
@given(st.lists(st.tuples(st.integers(0, 2), st.sampled_from([-1.0, 0.0, 1e5, 1e6, 4e6])), max_size=6))
def test_an_interval_holds_on_the_link_that_asked_and_on_no_other(asked: list[tuple[int, float]]) -> None:
    component, wanted = Component(MavlinkSettings()), {0: 0.0, 1: 0.0, 2: 0.0}
    for k, (link, us) in enumerate(asked):
        assert results(ask(component, command(INTERVAL, 59500, us), 10.0 * k, link)) == [ACCEPTED]
        wanted[link] = us
    for link, us in wanted.items():
        heard = on_link(component, link, CALLING, 20, 1000.0 * (link + 1))
        kinds = Counter(m.get_type() for m in heard)
        rate = {0.0: 2.0, -1.0: 0.0}.get(us, 1e6 / us if us else 0.0)
        assert kinds["LOCAGEN_BEARING"] == kinds["TUNNEL"] == pytest.approx(20 * rate, abs=1)
        assert kinds["HEARTBEAT"] == 20
        quiet = on_link(component, link, QUIET, 20, 1000.0 * (link + 1) + 500)
        told = sum(m.get_type() == "LOCAGEN_BEARING" for m in quiet)
        assert told == pytest.approx(20 * min(rate, 1.0), abs=1), (
            "once a second at most that nothing is heard"
        )


def test_the_same_command_by_two_links_is_for_both_and_done_once_where_it_is_for_all() -> None:
    moving, done = hands()
    component = Component(MavlinkSettings(), hands=moving)
    for link in (0, 1):
        assert results(ask(component, command(INTERVAL, 251, 100_000), 0.1 * link, link)) == [ACCEPTED]
        assert results(ask(component, command(FORGET), 0.1 * link, link)) == [ACCEPTED]
    assert done == ["forget", "forget"], "another command came between"
    for link in (0, 1):
        assert results(ask(component, command(FORGET), 10.0 + 0.1 * link, link)) == [ACCEPTED]
    assert done == ["forget"] * 3
    assert [component.interval_s(251, link) for link in (0, 1, 2)] == pytest.approx([0.1, 0.1, 0.5])


def test_of_a_flood_of_changes_only_so_many_are_obeyed_and_questions_still_are() -> None:
    """2000 a second, each of which would have all settings checked."""
    moving, done = hands()
    applied: list[Any] = []
    component = Component(MavlinkSettings(), hands=replace(moving, apply=applied.append))
    for k in range(10_000):
        component.receive(packed(setting_message(k) if k % 2 else command(FORGET, k % 100)), k / 2000.0)
        component.answers(0)
    most = CHANGES_AT_ONCE + 5.0 * CHANGES_PER_S + 1
    assert most / 4 < len(applied) + len(done) <= most
    assert results(ask(component, command(REQUEST, 148.0), 5.0)) == [ACCEPTED]
    assert results(ask(component, command(FORGET, 7.0), 9.0)) == [ACCEPTED], "after the flood all is obeyed"


def test_the_last_record_comes_again_on_request_while_its_switch_is_on() -> None:
    component = Component(MavlinkSettings(send_tunnel=False))
    assert results(ask(component, command(REQUEST, 59500))) == [DENIED], "none so far"
    said(component, CALLING, 1)
    component.receive(packed(command(REQUEST, 59500)), 2.0)
    frames = b"".join(component.answers(0))
    ack, record = (dialect.decode(packet.raw) for packet in Framer().feed(frames))
    assert ack.result == ACCEPTED
    assert record.get_msgId() == 59500
    component.receive(setting("LG_TX_RECORDS", 0.0), 3.0)
    answers(component)
    assert results(ask(component, command(REQUEST, 59500), 4.0)) == [DENIED]


def test_who_we_are() -> None:
    component = Component(MavlinkSettings(), hands=hands()[0])
    for number, one in ((REQUEST, 148.0), (common.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1.0)):
        ack, version = ask(component, command(number, one))
        assert ack.result == ACCEPTED
        assert version.uid == 77
        major, minor, patch = (int(part) for part in __version__.split(".")[:3])
        assert version.flight_sw_version >> 8 == major << 16 | minor << 8 | patch
        assert version.capabilities & common.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        assert not version.capabilities & common.MAV_PROTOCOL_CAPABILITY_FTP
    assert version_number("1.2.3") == 0x010203FF
    assert version_number("1.2.3rc1") & 0xFF == 0


def test_a_computers_number_is_its_own_and_not_its_machine_id(tmp_path) -> None:
    one, other, none = tmp_path / "one", tmp_path / "other", tmp_path / "none"
    one.write_text("0123456789abcdef0123456789abcdef\n")
    other.write_text("0123456789abcdef0123456789abcdee\n")
    assert machine_uid(one) == machine_uid(one) != machine_uid(other)
    assert f"{machine_uid(one):016x}" not in one.read_text()
    assert machine_uid(none) == 0


def test_the_computers_status_is_what_the_kernel_tells(tmp_path) -> None:
    for folder in ("proc", "sys/class/thermal/thermal_zone0"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "proc/uptime").write_text("12.5 3.0\n")
    (tmp_path / "proc/meminfo").write_text("MemTotal: 2097152 kB\nMemFree: 1 kB\nMemAvailable: 1048576 kB\n")
    (tmp_path / "sys/class/thermal/thermal_zone0/temp").write_text("48312\n")
    computer = Computer(tmp_path, tmp_path)
    (tmp_path / "proc/stat").write_text(
        "cpu 0 0 0 0 0\ncpu0 100 0 100 800 0 0 0 0\ncpu1 0 0 0 1000 0 0 0 0\n"
    )
    assert computer.status(0).cpu_cores == (255,) * 8, "a load takes two readings"
    (tmp_path / "proc/stat").write_text(
        "cpu 0 0 0 0 0\ncpu0 150 0 125 825 0 0 0 0\ncpu1 0 0 0 1100 0 0 0 0\n"
    )
    status = computer.status(5_000_000)
    assert status.cpu_cores[:3] == (75, 0, 255)
    assert (status.uptime, status.ram_total, status.ram_usage, status.time_usec) == (12500, 2048, 1024, 5000)
    assert status.temperature_core[:2] == (48, 127)
    assert 0 < status.storage_usage[0] <= status.storage_total[0]


def test_the_computers_status_of_a_computer_that_tells_nothing(tmp_path) -> None:
    component = Component(
        MavlinkSettings(send_computer_status=True),
        hands=Hands(computer=Computer(tmp_path, tmp_path / "x").status),
    )
    (status, *_) = [m for m in said(component, QUIET, 1) if m.get_type() == "ONBOARD_COMPUTER_STATUS"]
    assert (status.ram_total, status.storage_total[0], status.cpu_cores[0]) == (0xFFFFFFFF, 0xFFFFFFFF, 255)
    assert len(decode(component.due(2.0, QUIET))) > 0
