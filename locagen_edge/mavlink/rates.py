"""How often what repeats goes, on each link: as the settings say, unless that link has asked otherwise.

As with an autopilot: MAV_CMD_SET_MESSAGE_INTERVAL holds for the link on which it came. A slow radio that asks
for less takes nothing from the cable beside it. No I/O, time passed in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from locagen_edge.mavlink.pace import Every


class Rates:
    """`periods_s`: by message id, as the settings say; infinite: never. `least_quiet_s`: see `due`."""

    def __init__(self, periods_s: Mapping[int, float], least_quiet_s: float) -> None:
        self._least_quiet_s = least_quiet_s
        self._periods_s: Mapping[int, float] = {}
        self._every: dict[tuple[int | None, int, bool], Every] = {}
        self._asked: dict[int, set[int]] = {id: set() for id in periods_s}
        self.follow(periods_s)

    def follow(self, periods_s: Mapping[int, float]) -> None:
        """The settings say so now. Links that have asked keep what they have asked for."""
        for id, period_s in periods_s.items():
            if self._periods_s.get(id) != period_s:
                self._put(None, id, period_s)
        self._periods_s = periods_s

    def ask(self, link: int, id: int, period_s: float | None) -> None:
        """On this link so from now on; None: as the settings say again."""
        if period_s is not None:
            self._asked[id].add(link)
            self._put(link, id, period_s)
            return
        self._asked[id].discard(link)
        for quiet in (False, True):
            self._every.pop((link, id, quiet), None)

    def period_s(self, link: int, id: int) -> float:
        return self._every[link if link in self._asked[id] else None, id, False].period_s

    def apart(self, id: int) -> frozenset[int]:
        """Links that get this message at times of their own."""
        return frozenset(self._asked.get(id, ()))

    def due(self, id: int, now_s: float, *, quiet: bool = False) -> list[int | None]:
        """Whose turn it is: links that have asked, and None: all others.

        `quiet`: for saying that there is nothing, on a count of its own, no more often than `least_quiet_s`.
        """
        who = (None, *sorted(self._asked[id]))
        return [link for link in who if self._every[link, id, quiet].due(now_s)]

    def _put(self, link: int | None, id: int, period_s: float) -> None:
        for quiet in (False, True):
            every = self._every.setdefault((link, id, quiet), Every(math.inf))
            every.period_s = max(period_s, self._least_quiet_s) if quiet else period_s
