"""When something that repeats is due. No clock: time is passed in."""

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
