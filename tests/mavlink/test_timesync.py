"""The autopilot's clock: within half the way's asymmetry, over jitter, drift, loss and reboots."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from test_component import CALLING, QUIET, heartbeat, said
from test_parameters import answers, packed

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component
from locagen_edge.mavlink.timesync import SyncedClock
from locagen_edge.settings import MavlinkSettings


class Autopilot:
    """Answers over a way with a least delay and jitter on top, its clock ahead and drifting."""

    def __init__(self, seed: int, ahead_ns: int, drift: float = 0.0, jitter_ns: float = 20e6) -> None:
        self._random = random.Random(seed)
        self.ahead_ns, self.drift, self._jitter_ns = ahead_ns, drift, jitter_ns

    def clock(self, now_ns: int) -> int:
        return round(now_ns * (1.0 + self.drift)) + self.ahead_ns

    def delay(self) -> int:
        return round(2e6 + self._random.expovariate(1.0) * self._jitter_ns)

    def answer(self, asked: Any) -> tuple[Any, int]:
        there_ns = asked.ts1 + self.delay()
        return common.MAVLink_timesync_message(self.clock(there_ns), asked.ts1), there_ns + self.delay()


def synced(autopilot: Autopilot, clock: SyncedClock, seconds: int, start_s: int = 0) -> int:
    now_ns = 0
    for second in range(start_s, start_s + seconds):
        if asked := clock.ask(second, second * 10**9):
            answer, now_ns = autopilot.answer(asked)
            clock.answered(answer, now_ns)
    return now_ns


@given(st.integers(0, 1000), st.integers(-(10**15), 10**15), st.floats(-1e-4, 1e-4))
def test_the_offset_is_found_to_a_share_of_the_jitter(seed: int, ahead_ns: int, drift: float) -> None:
    autopilot, clock = Autopilot(seed, ahead_ns, drift), SyncedClock()
    now_ns = synced(autopilot, clock, 60)
    at_ms = clock.boot_ms(now_ns)
    assert at_ms is not None
    # one round trip scatters by 14 ms (two exponentials of 20 ms, halved); drift is 3 ms in the window
    assert at_ms - autopilot.clock(now_ns) * 1e-6 == pytest.approx(0.0, abs=15.0)


def test_on_an_even_way_it_is_exact() -> None:
    autopilot, clock = Autopilot(1, 10**12, jitter_ns=0.0), SyncedClock()
    now_ns = synced(autopilot, clock, 5)
    assert clock.time_us(now_ns) == (autopilot.clock(now_ns) // 1000, True)


def test_answers_that_nobody_asked_for_count_nothing() -> None:
    clock = SyncedClock()
    clock.answered(common.MAVLink_timesync_message(5, 0), 10)
    asked = clock.ask(0.0, 1000)
    assert asked is not None
    answer = common.MAVLink_timesync_message(10**9, 1000)
    clock.answered(answer, 3 * 10**9)  # too late to tell anything
    clock.answered(answer, 500)  # before it was asked
    assert not clock.synced
    assert clock.time_us(5_000_000) == (5000, False)
    clock.answered(answer, 2000)
    clock.answered(common.MAVLink_timesync_message(9 * 10**9, 1000), 2000)  # by another link, or forged
    assert clock.boot_ms(1500) == pytest.approx(1000.0)


def test_it_starts_anew_with_the_autopilot() -> None:
    clock = SyncedClock()
    old, new = Autopilot(1, 10**12, jitter_ns=0.0), Autopilot(2, 0, jitter_ns=0.0)
    synced(old, clock, 20)
    clock.hear(10**6 + 20_000.0, 20 * 10**9)
    assert clock.hear(21_000.0, 21 * 10**9 + 5_000_000)  # of a boot time that went back
    assert not clock.synced
    now_ns = synced(new, clock, 3, 22)
    assert clock.boot_ms(now_ns) == pytest.approx(now_ns * 1e-6, abs=0.1)


def test_a_jump_between_answers_starts_anew_too() -> None:
    clock = SyncedClock()
    synced(Autopilot(1, 10**12, jitter_ns=0.0), clock, 20)
    now_ns = synced(Autopilot(2, 5 * 10**12, jitter_ns=0.0), clock, 1, 20)
    assert clock.boot_ms(now_ns) == pytest.approx(now_ns * 1e-6 + 5e6, abs=0.1)


def test_answers_on_another_clock_than_the_messages_are_not_used() -> None:
    clock = SyncedClock()
    clock.hear(1000.0, 10**9)
    now_ns = synced(Autopilot(1, 1_700_000_000 * 10**9, jitter_ns=0.0), clock, 5)  # the time of day
    assert not clock.synced
    assert clock.boot_ms(now_ns) == pytest.approx(now_ns * 1e-6, abs=1.0)


def test_records_carry_the_autopilots_time_and_say_so() -> None:
    component = Component(MavlinkSettings(), start_s=2.0)
    heard = replace(CALLING, t_ns=12_500_000_000)

    def record(start_s: float) -> Any:
        tunnels = [m for m in said(component, heard, 1, start_s) if m.get_type() == "TUNNEL"]
        return dialect.untunnel(tunnels[0])

    flag = dialect.messages.LOCAGEN_BEARING_FLAGS_AUTOPILOT_TIME
    ours = record(20.0)
    assert (ours.time_usec, ours.flags & flag) == (10_500_000, 0)
    synced(Autopilot(1, 10**12, jitter_ns=0.0), component.clock, 3, 21)
    theirs = record(25.0)
    assert theirs.flags & flag
    assert theirs.time_usec == 1_000_000_000 + 12_500_000


def test_requests_are_answered_on_the_link_and_answers_are_not() -> None:
    component = Component(MavlinkSettings())
    component.receive(packed(common.MAVLink_timesync_message(0, 77)), 12.5, link=1)
    (answer,) = answers(component, 1)
    assert (answer.ts1, answer.tc1) == (77, 12_500_000_000)
    component.receive(packed(common.MAVLink_timesync_message(5, 77)), 12.5, link=1)
    assert answers(component, 1) == []


def test_the_autopilot_alone_is_asked_and_believed() -> None:
    component = Component(MavlinkSettings())
    assert "TIMESYNC" not in {m.get_type() for m in said(component, QUIET, 5)}, "nobody there"
    component.receive(heartbeat(1), 10.0)
    (asked, *_) = [m for m in said(component, QUIET, 1, 10.0) if m.get_type() == "TIMESYNC"]
    answer = common.MAVLink_timesync_message(10**12, asked.ts1)
    component.receive(packed(answer), asked.ts1 * 1e-9 + 0.004)  # the ground station's
    assert not component.clock.synced
    component.receive(packed(answer, 1, 1), asked.ts1 * 1e-9 + 0.004)
    assert component.clock.synced
    assert component.clock.boot_ms(asked.ts1) == pytest.approx(10**6 - 2.0, abs=0.01)
