"""The autopilot's clock, by MAVLink's TIMESYNC: no I/O, time passed in.

A request carries our time, the answer carries it back with the autopilot's: halfway between sending and
hearing is when the autopilot read its clock, wrong by at most half the way's asymmetry. Ways differ; so the
offset is the median over the answers with the shortest round trips of the last half minute (the clock filter
of NTP, RFC 5905 section 10, with a median in the place of its single least delay).

Messages that carry `time_boot_ms` give an offset too, late by the shortest delay of the way. It is what holds
until an answer has come, and it is the check on autopilots that answer with another clock than that of their
messages. Protocol: mavlink.io/en/services/timesync.html.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from typing import Any

from locagen_edge.mavlink.dialect import messages
from locagen_edge.mavlink.pose import BootClock

ASK_S = 1.0
"""between two requests; an autopilot answers in some 7 ms"""
KEPT = 30
"""answers kept: crystals drift by 3 ms in 30 s at worst, and the median is half as old"""
SHORTEST = 0.25
"""share of the answers, those with the shortest round trips, that decide"""
LONGEST_NS = 1_000_000_000
"""round trip beyond which an answer tells nothing"""
PENDING = 4
"""requests that may wait for their answers; an answer to none of them is not ours"""
ALIKE_MS = 500.0
"""how late messages may come: further apart, the answers are of another clock"""


class SyncedClock(BootClock):
    """The autopilot's time since boot against our monotonic clock, by answers where there are any."""

    def __init__(self) -> None:
        super().__init__()
        self._asked: deque[int] = deque(maxlen=PENDING)
        self._asked_s = -math.inf
        self._answers: deque[tuple[int, int]] = deque(maxlen=KEPT)  # round trip, offset (ns)
        self._offset_ns: int | None = None

    def hear(self, time_boot_ms: float, arrived_ns: int) -> bool:
        rebooted = super().hear(time_boot_ms, arrived_ns)
        if rebooted:
            self.forget()
        return rebooted

    def forget(self) -> None:
        """The autopilot has started anew, or is another."""
        self._asked.clear()
        self._answers.clear()
        self._offset_ns = None

    def ask(self, now_s: float, now_ns: int) -> Any | None:
        """The request to send now, or None."""
        if now_s - self._asked_s < ASK_S:
            return None
        self._asked_s = now_s
        self._asked.append(now_ns)
        return messages.MAVLink_timesync_message(0, now_ns)

    def answered(self, message: Any, now_ns: int) -> None:
        """An answer of the autopilot; one that comes a second time, by another link, counts once."""
        if message.ts1 not in self._asked or not 0 <= now_ns - message.ts1 <= LONGEST_NS:
            return
        self._asked.remove(message.ts1)
        offset_ns = message.tc1 - (message.ts1 + now_ns) // 2
        if self._offset_ns is not None and abs(offset_ns - self._offset_ns) > LONGEST_NS:
            self._answers.clear()  # its clock was set, or began anew
        self._answers.append((now_ns - message.ts1, offset_ns))
        shortest = sorted(self._answers)[: max(1, math.ceil(SHORTEST * len(self._answers)))]
        self._offset_ns = round(statistics.median(offset for _, offset in shortest))

    @property
    def synced(self) -> bool:
        """Whether answers decide, not arrivals."""
        if self._offset_ns is None:
            return False
        by_arrivals = super().boot_ms(0)
        return by_arrivals is None or abs(by_arrivals - self._offset_ns * 1e-6) < ALIKE_MS

    def boot_ms(self, t_ns: int) -> float | None:
        if self.synced and self._offset_ns is not None:
            return (t_ns + self._offset_ns) * 1e-6
        return super().boot_ms(t_ns)

    def time_us(self, t_ns: int) -> tuple[int, bool]:
        """A monotonic time on the autopilot's clock, in microseconds, and True; or on ours, and False."""
        boot_ms = self.boot_ms(t_ns)
        if boot_ms is None or boot_ms < 0.0:
            return t_ns // 1000, False
        return round(boot_ms * 1000.0), True


def answer(message: Any, now_ns: int) -> Any | None:
    """The answer to a request, with our time; None where the message is an answer itself."""
    return None if message.tc1 else messages.MAVLink_timesync_message(now_ns, message.ts1)
