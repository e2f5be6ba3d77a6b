"""Monotonic time of a card's samples, how fast its crystal runs, and whether sound was lost in silence.

The card's crystal is off by up to 100 ppm and the pointer into its buffer moves in steps, so time follows the
count of samples, slowly corrected. What a wall clock says is never asked: it may be set while we listen.

Drift is the slope of a straight line through the medians of each quarter of a second over the last ten
minutes (Press et al., *Numerical Recipes*, section 15.2, with the sigma of its residuals): where these
scatter by 1 ms it is known to 300 ppm after two seconds, 4 ppm after a minute, 0.1 ppm after ten.
"""

from __future__ import annotations

import collections
import math

import numpy as np

from locagen_edge.types import Drift

LOSS_S = 0.05  # more than the coarsest pointer of a USB card moves at once (a few ms to 20 ms)
LOSS_POLLS = 5  # a late pointer recovers within a poll or two; sound that is lost stays lost
CERTAIN_S = 0.5  # more than a card's whole buffer: no pointer lags so far, and none has to be waited for
DRIFT_S = 10.0  # jitter averages out, and 100 ppm of clock error lag by 1 ms
POINT_NS = 250_000_000
POINTS = 2400
LEAST_POINTS = 6
"""before a slope is told"""
LEAST_NS = 1e3
"""scatter of the points at the least: 1 us, the time that a poll takes"""


class SampleClock:
    """One stretch of sound without a loss; begin another after each.

    Args:
        rate_hz: nominal, of the card.
        known: its drift, as a stretch before told it.
    """

    def __init__(self, rate_hz: float, known: Drift | None = None) -> None:
        self.origin_ns = 0
        """monotonic time of the first sample, as the card's clock stands now"""
        self.drift = known
        """of the card against CLOCK_MONOTONIC; None until it is known at all"""
        self._rate_hz = rate_hz
        self._polls = 0
        self._late_ns: collections.deque[int] = collections.deque(maxlen=LOSS_POLLS)
        self._first_ns = 0  # origin at the first poll
        self._asked_ns = 0
        self._since: list[int] = []  # origins since the last point, less the first
        self._since_ns = 0
        self._points: collections.deque[tuple[float, float]] = collections.deque(maxlen=POINTS)
        self._due = LEAST_POINTS  # points until the next fit

    def update(self, samples: int, now_ns: int) -> bool:
        """`samples` had come by `now_ns`. False: count and clock have parted: sound was lost in silence."""
        origin_ns = now_ns - round(samples * 1e9 / self._rate_hz)
        if self._polls == 0:
            self.origin_ns = self._first_ns = origin_ns
            self._since_ns = self._asked_ns = now_ns
        late_ns = origin_ns - self.origin_ns
        if abs(late_ns) > CERTAIN_S * 1e9:
            return False
        self._late_ns.append(late_ns)
        self._polls += 1
        share = max(1.0 / self._polls, 1.0 - math.exp((self._asked_ns - now_ns) / (DRIFT_S * 1e9)))
        self._asked_ns = now_ns
        self.origin_ns += round(late_ns * share)
        lasting = len(self._late_ns) == LOSS_POLLS
        limit_ns = LOSS_S * 1e9
        if lasting and (min(self._late_ns) > limit_ns or max(self._late_ns) < -limit_ns):
            return False
        self._measure(origin_ns, now_ns)
        return True

    def _measure(self, origin_ns: int, now_ns: int) -> None:
        self._since.append(origin_ns - self._first_ns)
        if now_ns - self._since_ns < POINT_NS:
            return
        self._points.append(((now_ns + self._since_ns) / 2e9, float(np.median(self._since))))
        self._since, self._since_ns = [], now_ns
        self._due -= 1
        if self._due > 0:
            return
        self._due = len(self._points) // 10  # a tenth more tells a little more: no need to fit each time
        slope = _slope(np.array(self._points))
        if self.drift is None or slope.sigma_ppm <= self.drift.sigma_ppm or len(self._points) == POINTS:
            self.drift = slope


def _slope(points: np.ndarray) -> Drift:
    """From (n, 2) seconds and ns: origins that fall by 1000 ns a second belong to a card 1 ppm fast."""
    t, origin = (points - points.mean(axis=0)).T
    spread = float(t @ t)
    slope = float(t @ origin) / spread
    left = origin - slope * t
    scatter = max(math.sqrt(float(left @ left) / (len(t) - 2)), LEAST_NS)
    return Drift(ppm=-slope * 1e-3, sigma_ppm=scatter / math.sqrt(spread) * 1e-3)
