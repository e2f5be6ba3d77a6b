"""Commands that are ours to obey, and how they are acknowledged. No I/O, time passed in.

A command to our own ids is always answered with COMMAND_ACK, to its sender alone. Sent again within
`RESEND_S` (its acknowledgement was lost) it gets the same answer and is not done a second time. A command to
all components of the vehicle is done only where it asks for nothing but a message, and is acknowledged only
then: an acknowledgement of "not supported" by one of many would be taken for the vehicle's.

Starting, stopping and forgetting the noise have numbers of MAVLink's user range. The standard commands that
come near (MAV_CMD_PREFLIGHT_CALIBRATION, MAV_CMD_DO_SET_MODE, MAV_CMD_LOGGING_START) mean other things to an
autopilot, and autopilots have been seen to obey what was addressed to a component that was not there.
Protocol: mavlink.io/en/services/command.html.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.dialect import messages

RESEND_S = 3.0
"""the same command from the same sender within this time is the same one, sent again"""
SENDERS = 16
"""senders whose last command is remembered"""
FASTEST_US = 50_000
"""20 a second, as `mavlink.rate_hz` allows"""

ACCEPTED: int = messages.MAV_RESULT_ACCEPTED
DENIED: int = messages.MAV_RESULT_DENIED
UNSUPPORTED: int = messages.MAV_RESULT_UNSUPPORTED

Answer = tuple[int, list[Any]]
"""the result, and messages that were asked for"""
Given = tuple[float, ...]
"""param1 to param4"""


class Desk(Protocol):
    """What commands act on: the component."""

    def listen(self, on: bool, /) -> None:
        """Starts or stops listening."""

    def forget_noise(self) -> None:
        """Starts learning the noise from nothing."""

    def requested(self, message_id: int, /) -> Any | None:
        """A message of ours that may be asked for once."""

    def interval_s(self, message_id: int, link: int, /) -> float | None:
        """How often a message of ours is sent there; infinite: it is switched off; None: none of ours."""

    def set_interval(self, message_id: int, period_s: float | None, link: int, /) -> bool:
        """On that link; None: as the settings say. False: it is none that can be set."""

    def may_change(self, now_s: float, /) -> bool:
        """Whether one more command is obeyed now."""


def _listen(desk: Desk, given: Given, _: int) -> Answer:
    if given[0] not in (0.0, 1.0):
        return DENIED, []
    desk.listen(given[0] == 1.0)
    return ACCEPTED, []


def _forget_noise(desk: Desk, _: Given, __: int) -> Answer:
    desk.forget_noise()
    return ACCEPTED, []


def _request(desk: Desk, given: Given, link: int) -> Answer:
    wanted = whole(given[0])
    if wanted == dialect.MESSAGE_INTERVAL:
        return _get_interval(desk, given[1:], link)
    message = None if wanted is None else desk.requested(wanted)
    return (DENIED, []) if message is None else (ACCEPTED, [message])


def _capabilities(desk: Desk, given: Given, link: int) -> Answer:
    version = (float(dialect.AUTOPILOT_VERSION), 0.0)
    return _request(desk, version, link) if given[0] == 1.0 else (DENIED, [])


def _get_interval(desk: Desk, given: Given, link: int) -> Answer:
    wanted = whole(given[0])
    if wanted is None or not 0 <= wanted <= 0xFFFF:
        return DENIED, []
    period_s = desk.interval_s(wanted, link)
    us = 0 if period_s is None else -1 if math.isinf(period_s) else round(period_s * 1e6)  # 0: not available
    return ACCEPTED, [messages.MAVLink_message_interval_message(wanted, us)]


def _set_interval(desk: Desk, given: Given, link: int) -> Answer:
    wanted, us = whole(given[0]), given[1]
    if wanted is None or not (us in (-1.0, 0.0) or FASTEST_US <= us <= 3.6e9):
        return DENIED, []
    period_s = None if us == 0.0 else math.inf if us < 0.0 else us * 1e-6
    return (ACCEPTED if desk.set_interval(wanted, period_s, link) else DENIED), []


def whole(value: float) -> int | None:
    """The number that a parameter of type float stands for, where it is one."""
    return int(value) if math.isfinite(value) and value == round(value) and abs(value) < 1 << 24 else None


@dataclass(frozen=True, slots=True)
class Command:
    """One line of the table."""

    name: str
    text: str
    do: Callable[[Desk, Given, int], Answer]
    """the last: the link by which it came"""
    reads: bool = False
    """asks for a message, changes nothing"""
    of_link: bool = False
    """what it changes is that link's alone"""


TABLE: Mapping[int, Command] = {
    messages.MAV_CMD_USER_1: Command(
        "MAV_CMD_USER_1",
        "Listen: param1 = 1 start, 0 stop. While stopped, sound is neither looked at nor kept, and the "
        "heartbeat says STANDBY. After a start of the program it listens.",
        _listen,
    ),
    messages.MAV_CMD_USER_2: Command(
        "MAV_CMD_USER_2",
        "Forget the learnt noise (level and, with `steered`, the rotors' matrix) and learn it anew: some "
        "seconds in which nothing should call.",
        _forget_noise,
    ),
    messages.MAV_CMD_SET_MESSAGE_INTERVAL: Command(
        "MAV_CMD_SET_MESSAGE_INTERVAL",
        "param1 a message of ours that repeats, param2 its interval in us (50000 or more; 0: as the settings "
        "say, -1: never), on the link by which it came, until the program ends. LOCAGEN_POSITION and TUNNEL "
        "go with LOCAGEN_BEARING. Not for HEARTBEAT.",
        _set_interval,
        of_link=True,
    ),
    messages.MAV_CMD_GET_MESSAGE_INTERVAL: Command(
        "MAV_CMD_GET_MESSAGE_INTERVAL", "param1 a message: MESSAGE_INTERVAL.", _get_interval, reads=True
    ),
    messages.MAV_CMD_REQUEST_MESSAGE: Command(
        "MAV_CMD_REQUEST_MESSAGE",
        "param1: AUTOPILOT_VERSION, MESSAGE_INTERVAL (of param2), ONBOARD_COMPUTER_STATUS, or the last "
        "LOCAGEN_BEARING or LOCAGEN_POSITION.",
        _request,
        reads=True,
    ),
    messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: Command(
        "MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES",
        "param1 = 1: AUTOPILOT_VERSION, as older ground stations ask for it.",
        _capabilities,
        reads=True,
    ),
}


class Commands:
    """Obeys commands for one component."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._done: dict[tuple[int, int], tuple[tuple[Any, ...], float, int]] = {}

    def obey(
        self, message: Any, sender: tuple[int, int], link: int, now_s: float, *, to_all: bool
    ) -> list[Any]:
        """The answers to a COMMAND_LONG or COMMAND_INT from `sender` (system, component) by that link."""
        given = tuple(getattr(message, f"param{n}") for n in range(1, 5))
        known = TABLE.get(message.command)
        if to_all and (known is None or not known.reads):
            return []
        if known is None:
            return [_ack(message.command, UNSUPPORTED, sender)]
        if known.reads:
            result, asked = known.do(self._desk, given, link)
            return [] if to_all and result != ACCEPTED else [_ack(message.command, result, sender), *asked]
        # packed: an unused parameter is often NaN, which equals no other
        this = (message.command, struct.pack("<4f", *given), link if known.of_link else None)
        what, when_s, result = self._done.get(sender, ((), -math.inf, 0))
        if what != this or now_s - when_s > RESEND_S:
            if not self._desk.may_change(now_s):
                return []
            result, _ = known.do(self._desk, given, link)
            self._done.pop(sender, None)
            if len(self._done) >= SENDERS:
                del self._done[next(iter(self._done))]
        self._done[sender] = (this, now_s, result)
        return [_ack(message.command, result, sender)]


def _ack(command: int, result: int, sender: tuple[int, int]) -> Any:
    return messages.MAVLink_command_ack_message(command, result, 0, 0, *sender)
