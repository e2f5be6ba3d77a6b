"""A frame's scores by direction -> Bearing of somebody who calls again and again, each time too faintly.

A call that no frame finds by itself leaves something where it comes from: frames that score more there than
noise does, though less than a call has to. Noise leaves as much, but now here and now there; a caller always
in one place. So what frames score above the usual is added up by direction, slowly forgotten, and is a
bearing while the frame itself adds to a sum that is far ahead of every other ("track before detect":
Blackman & Popoli, *Design and Analysis of Modern Tracking Systems* (1999)). A frame adds no more than `MOST`,
so that no bang makes a caller by itself (Huber, "A robust version of the probability ratio test", Ann. Math.
Stat. 36 (1965)).

Sums turn with the vehicle where its heading is known, so that callers keep their places; elsewhere a drone
that turns smears them, and less is found. What it leans and moves by is not followed.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.geometry import NOWHERE_RAD, heading, wrap
from locagen_edge.settings import Settings
from locagen_edge.types import F32, F64, Bearing, Evidence, Quaternion

NAME = "repeats"

SCORE = 20.0
"""Added to the average of what noise scores: the least that it gives, however still it keeps."""
USUAL_S = 20.0
"""Memory of that average."""
LOUDEST = 2.0
"""It takes no more than so many times itself at once: a call."""
YOUNG_S = 20.0
"""Nothing is added up before the noise is known so long."""
LEAST = 0.7
"""Of the usual, from which a frame's score towards one azimuth counts."""
MOST = 4.0
"""And up to which: one bang, however loud, is not enough."""
AHEAD_S = 0.08
"""A sum has to be ahead by so many seconds (times the usual) for each unit of `detection.evidence`."""
LOBE_RAD = math.radians(32.0)
"""Around the highest sum; what is further off is another direction's."""
NEAR = 2
"""Columns to each side that the bearing is the mean of."""
LONGEST_STEP_S = 0.2
"""After a gap one frame still counts as one."""
LOST_S = 5.0
"""Without a heading for so long, directions are the body's; for less nothing is added up."""
SIGMA_RAD = math.radians(3.0)
"""Of a bearing: 68 % within 2.2 degrees, 95 % within 5.4, beside simulated rotors (`docs/denoise.md`)."""


class Repeats:
    """Sums of one stream."""

    def __init__(self, settings: Settings):
        self.apply(settings)
        self.forget()

    def apply(self, settings: Settings) -> None:
        """New memory and limit; the sums stay."""
        self._memory_s = settings.detection.repeats_s
        self._ahead_s = AHEAD_S * settings.detection.evidence

    def forget(self) -> None:
        """Neither noise nor callers are known."""
        self._usual = self._weight = self._known_s = 0.0
        self._sums: F64 = np.zeros((1, 1))
        self._compass = False
        self._lost_s = 0.0

    def __call__(
        self, scores: F32, evidence: Evidence | None, elapsed_s: float, attitude: Quaternion | None = None
    ) -> Bearing | None:
        """`scores` (elevations, azimuths) of one frame, azimuths the body's, evenly around, the first at 0;
        `evidence`: the frame's own verdict, None while its noise is being learnt; `elapsed_s`: since the
        frame before."""
        if evidence is None or self._memory_s <= 0.0:
            self.forget()
            return None
        if self._sums.shape != scores.shape:
            self._sums = np.zeros(scores.shape)
        self._follow(attitude is not None, elapsed_s)
        if self._compass is not (attitude is not None) or not np.isfinite(scores).all():
            return None
        middle = scores.size // 2
        # the median; numpy's own takes five times as long
        above = scores - np.partition(scores, middle, axis=None)[middle]
        best = float(above.max())
        usual = SCORE + (self._usual / self._weight if self._weight else 0.0)
        step_s = min(elapsed_s, LONGEST_STEP_S)
        self._learn(min(best, LOUDEST * usual), step_s)
        if self._known_s < YOUNG_S or best <= LEAST * usual:
            return None
        added = step_s * np.clip(above / usual - LEAST, 0.0, MOST)
        turned = 0.0 if attitude is None else heading(attitude) / (2.0 * math.pi) * scores.shape[1]
        self._sums += _turned(added, turned)
        return self._told(_turned(self._sums, -turned), added, evidence)

    def _follow(self, compass: bool, elapsed_s: float) -> None:
        self._lost_s = 0.0 if compass else self._lost_s + elapsed_s
        if compass is not self._compass and (compass or self._lost_s > LOST_S):
            self._sums[:] = 0.0  # of other axes
            self._compass = compass
        self._sums *= math.exp(-elapsed_s / self._memory_s)

    def _learn(self, best: float, elapsed_s: float) -> None:
        share = 1.0 - math.exp(-elapsed_s / USUAL_S)
        self._usual += share * (best - self._usual)
        self._weight += share * (1.0 - self._weight)
        self._known_s += elapsed_s

    def _told(self, sums: F64, added: F64, evidence: Evidence) -> Bearing | None:
        """From the sums as the body sees them."""
        smooth = ((np.roll(sums, 1, axis=1) + 2.0 * sums + np.roll(sums, -1, axis=1)) / 4.0).max(axis=0)
        step = 2.0 * math.pi / len(smooth)
        best, lobe = int(smooth.argmax()), math.ceil(LOBE_RAD / step)
        here = (best + np.arange(-lobe, lobe + 1)) % len(smooth)
        near = (best + np.arange(-NEAR, NEAR + 1)) % len(smooth)
        elsewhere = smooth.copy()
        elsewhere[here] = 0.0
        if smooth[best] - float(elsewhere.max()) <= self._ahead_s or added[:, near].max() <= 0.0:
            return None
        middle = best + float(smooth[near] @ np.arange(-NEAR, NEAR + 1)) / float(smooth[near].sum())
        return Bearing(
            azimuth_rad=wrap(middle * step),
            azimuth_sigma_rad=SIGMA_RAD,
            elevation_rad=None,
            elevation_sigma_rad=NOWHERE_RAD,
            misfit=0.0,
            estimator=NAME,
            evidence=evidence,
        )


def _turned(values: F64, columns: float) -> F64:
    """(rows, n) around a circle, moved by so many columns, between them by shares."""
    whole = math.floor(columns)
    share = columns - whole
    moved: F64 = np.roll(values, whole, axis=1)
    return moved if share == 0.0 else (1.0 - share) * moved + share * np.roll(moved, 1, axis=1)
