"""Which bearing belongs to which track: global nearest neighbour over all ways of pairing them.

Blackman & Popoli, *Design and Analysis of Modern Tracking Systems* (1999), section 6.4. Callers and bearings
are few, so every pairing within the gates is looked at: 25 for four tracks and two bearings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Pairing = tuple[int | None, ...]
"""for each bearing its track, or None"""


def associate(costs: Sequence[Sequence[float]]) -> Pairing:
    """The best pairing: as many bearings with a track as the gates allow, and of those the least cost.

    `costs[bearing][track]`, infinite outside the gate. No track gets two bearings.
    """
    return _best(costs, frozenset())[2]


def _best(costs: Sequence[Sequence[float]], taken: frozenset[int]) -> tuple[int, float, Pairing]:
    """Bearings left over, cost and pairing; tuples, so that the first decides."""
    if not costs:
        return 0, 0.0, ()
    left, cost, rest = _best(costs[1:], taken)
    found = [(left + 1, cost, (None, *rest))]
    for track, own in enumerate(costs[0]):
        if track not in taken and math.isfinite(own):
            left, cost, rest = _best(costs[1:], taken | {track})
            found.append((left, cost + own, (track, *rest)))
    return min(found, key=lambda option: option[:2])
