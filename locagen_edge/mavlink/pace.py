"""When something that repeats is due, and how much of a flood is. No clock: time is passed in."""

from __future__ import annotations

import math


class Every:
    """Says when a period has passed, without drift; after a pause it begins anew at once.

    `period_s` may be changed at any time; infinite: never due.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self._last_s = -math.inf

    def due(self, now_s: float) -> bool:
        next_s = self._last_s + self.period_s
        if math.isinf(self.period_s) or now_s < next_s:
            return False
        on_time = now_s - next_s < self.period_s
        self._last_s = next_s if on_time else now_s
        return True


class AtMost:
    """Lets through so many a second, and so many at once after a pause: a token bucket."""

    def __init__(self, per_s: float, at_once: int) -> None:
        self._per_s, self._most = per_s, float(at_once)
        self._left = self._most
        self._now_s = -math.inf
        self.held_back = 0
        """how many were not let through"""

    def admits(self, now_s: float) -> bool:
        self._left = min(self._left + max(now_s - self._now_s, 0.0) * self._per_s, self._most)
        self._now_s = max(now_s, self._now_s)
        if self._left < 1.0:
            self.held_back += 1
            return False
        self._left -= 1.0
        return True
