"""Which messages the autopilot is asked to send, and when it is asked again. No I/O, time passed in.

ArduPilot sends neither attitude nor position to an onboard computer until asked by
MAV_CMD_SET_MESSAGE_INTERVAL, and forgets it when it starts anew. So all is asked for after a gap in its
heartbeats, when its clock goes back, when what came stays away (it may have started faster than that), and,
of what every vehicle has, when it never came: a command may have been lost.
"""

from __future__ import annotations

import math
from collections import deque

from locagen_edge.mavlink.pose import ATTITUDE_QUATERNION, GLOBAL_POSITION_INT, WANTED

GAP_S = 3.5
"""three heartbeats missed: it may have started anew"""
LOST_S, LOST_PERIODS = 1.0, 4.0
"""what came and has been silent for so long, and so many of its periods, is gone"""
AGAIN_S = 10.0
"""what stays away is asked for again this often"""
PACE_S = 0.1
"""between two commands, so that a slow link carries them beside the rest"""

_NEVER_MISSING = (ATTITUDE_QUATERNION, GLOBAL_POSITION_INT)


class Streams:
    """Decides what to ask for next. `rate_hz`: of attitudes; 0: nothing is ever asked for."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._queue: deque[int] = deque()
        self._arrived_s: dict[int, float] = {}
        self._asked_s = -math.inf
        self._beat_s = -math.inf

    def hear_heartbeat(self, now_s: float) -> None:
        """Of the autopilot."""
        if now_s - self._beat_s > GAP_S:
            self.ask_all()
        self._beat_s = now_s

    def hear_message(self, id: int, now_s: float) -> None:
        """Of the autopilot, with what was asked for or not."""
        self._arrived_s[id] = now_s

    def ask_all(self) -> None:
        self._queue = deque(WANTED)

    def due(self, now_s: float) -> tuple[int, int] | None:
        """The message to ask for now and its interval in microseconds; None: nothing, or nobody to ask."""
        if self.rate_hz <= 0.0 or now_s - self._beat_s > GAP_S or now_s - self._asked_s < PACE_S:
            return None
        if not self._queue and any(self._is_lost(id, now_s) for id in _NEVER_MISSING):
            self.ask_all()
        if not self._queue and now_s - self._asked_s > AGAIN_S:
            self._queue.extend(id for id in _NEVER_MISSING if self._silent_s(id, now_s) > AGAIN_S)
        if not self._queue:
            return None
        self._asked_s = now_s
        id = self._queue.popleft()
        return id, round(1e6 / (self.rate_hz * WANTED[id]))

    def _is_lost(self, id: int, now_s: float) -> bool:
        """Whether it came since it was asked for, and does no more."""
        came = self._arrived_s.get(id, -math.inf) > self._asked_s
        return came and self._silent_s(id, now_s) > max(LOST_S, LOST_PERIODS / (self.rate_hz * WANTED[id]))

    def _silent_s(self, id: int, now_s: float) -> float:
        return now_s - self._arrived_s.get(id, -math.inf)
