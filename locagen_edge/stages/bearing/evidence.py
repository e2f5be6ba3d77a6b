"""How sure it is that something calls, at a constant false-alarm rate, and since when.

The kernel's score of a direction is a likelihood ratio against the learnt noise, with the looks of each
direction and part of the band lessened by how they have strayed before (`csrc/locagen.h`). What is left of
the noise's temper is divided out here: the ratio is the best score over its own average while nothing called
("cell averaging", in time: Finn & Johnson, "Adaptive detection mode with threshold control as a function of
spatially sampled clutter-level estimates", RCA Review 29 (1968)).

The onset is the change point of greatest likelihood in the frames' own scores towards the caller (Page,
"Continuous inspection schemes", Biometrika 41 (1954)).
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.types import F32

SCORE = 20.0
"""Added to the average: the least that noise gives, however still it keeps."""
YOUNG, YOUNG_S = 600.0, 1.6
"""The average counts as at least so much while the noise has just been learnt, of a matrix from few frames;
falls by e in each of these times."""
MEMORY_S = 20.0
LOUDEST = 5.0
"""The average takes no more than so many times its level at once: a call that was not recognised."""
CLIP = 60.0
"""A frame's score counts up to here, so that one clap does not outweigh a second of voice."""
UNSURE_S = 10.0
"""So long it is not known whether what scores more is noise, or somebody who has called from the start."""
DRIFT = 3.0
"""By how much a frame of a call is above what is usual, at least."""
LEAST_USUAL = 4.0
"""What a frame of noise scores in one direction, at least."""
SHARE = 0.25
"""The same as a share of the highest of late: the louder the call, the sharper its begin."""
RECENT_S = 0.3
HISTORY_S = 2.0
RISE_S = 0.08
"""From a call's begin to the end of the first frame that it fills enough to be seen in, on average."""


class Usual:
    """What the best score of noise alone is, on average: at first of late, for rotors that hunt show it soon;
    then of `MEMORY_S`. `looks`: what an average of the spectra scores over what a frame does."""

    def __init__(self, looks: float = 1.0) -> None:
        self._average, self._heard_s, self._frames = 0.0, 0.0, 0
        self._clip = CLIP * looks
        self._youth = YOUNG

    def ratio(self, score: float) -> float:
        return score / self.level

    @property
    def young(self) -> bool:
        """Whether the noise is hardly known yet."""
        return self._youth > SCORE / 10.0

    @property
    def level(self) -> float:
        """The score whose ratio is 1."""
        return SCORE + max(self._average, self._youth)

    @property
    def known(self) -> float:
        """The same without what the noise counts as for being hardly known yet."""
        return SCORE + self._average

    def age(self, elapsed_s: float) -> None:
        """Time in which something called."""
        self._youth *= math.exp(-elapsed_s / YOUNG_S)

    def learn(self, score: float, elapsed_s: float) -> None:
        """A score of noise alone."""
        most = LOUDEST * self.level
        if self._heard_s < UNSURE_S:
            most = min(most, self._clip)
        self.age(elapsed_s)
        self._frames += 1
        self._heard_s += elapsed_s
        # 3 / (n + 2): each score weighs about as the square of the number of those before it
        share = max(1.0 - math.exp(-elapsed_s / MEMORY_S), 3.0 / (self._frames + 2))
        self._average += share * (min(score, most) - self._average)


class Onsets:
    """The frames' scores of the last seconds, direction by direction."""

    def __init__(self, hop_s: float):
        self._hop_s = hop_s
        self._recent = max(1, round(RECENT_S / hop_s))
        self._ring: F32 | None = None
        self._frames = max(2, round(HISTORY_S / hop_s))
        self._next = self._held = 0
        self._usual: F32 | None = None

    def hear(self, scores: F32) -> None:
        """(directions...) of one frame."""
        if self._ring is None:
            self._ring = np.empty((self._frames, scores.size), np.float32)
        np.minimum(scores.ravel(), np.float32(CLIP), out=self._ring[self._next])
        self._next = (self._next + 1) % self._frames
        self._held = min(self._held + 1, self._frames)

    def learn(self, lag: int, elapsed_s: float) -> None:
        """The frame `lag` before the last held no call."""
        if self._ring is None or self._held <= lag:
            return
        share = np.float32(1.0 - math.exp(-elapsed_s / MEMORY_S))
        then = self._ring[(self._next - 1 - lag) % self._frames]
        if self._usual is None:
            self._usual = then.copy()
        else:
            self._usual += share * (then - self._usual)

    def _towards(self, direction: int) -> list[float]:
        """Each frame's score there, the last first."""
        if self._ring is None:
            return []
        scores: list[float] = self._ring[:, direction].tolist()
        last = self._next
        return (scores[:last][::-1] + scores[last:][::-1])[: self._held]

    def _usual_towards(self, direction: int) -> float:
        return 0.0 if self._usual is None else float(self._usual[direction])

    def going_on(self, direction: int) -> bool:
        """Whether it still calls from there: an average over a second remembers what has ended."""
        recent = self._towards(direction)[: self._recent]
        usual = max(self._usual_towards(direction), LEAST_USUAL)
        return sum(recent) > len(recent) * (usual + DRIFT)

    def since_s(self, direction: int) -> float:
        """For how long it has called from there, at the last frame's end; `HISTORY_S` at most."""
        scores, usual = self._towards(direction), self._usual_towards(direction)
        drift = max(DRIFT, SHARE * (max(scores[: self._recent], default=0.0) - usual))
        total, most, frames = 0.0, -math.inf, 0
        for n, score in enumerate(scores):
            total += score - usual - drift
            if total > most:
                most, frames = total, n
        return frames * self._hop_s + RISE_S

    def forget(self) -> None:
        """Time has gone by unheard."""
        self._held = 0
