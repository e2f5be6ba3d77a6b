"""What all estimators share: the answer "nothing", the geometry, and how errors of delays go together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from locagen_edge.geometry import NOWHERE_RAD, MicArray
from locagen_edge.settings import Settings
from locagen_edge.types import F32, F64, Bearing, Evidence, Frame, Mask, Tdoa

Estimator = Callable[[Tdoa], Bearing]
"""From delays to a direction, frame by frame."""


class Locator(Protocol):
    """What the pipeline asks for bearings, once a frame."""

    def __call__(
        self, frame: Frame, tdoa: Tdoa, elapsed_s: float, mask: Mask | None = None, /
    ) -> tuple[Bearing, ...]:
        """Of the sources in the frame, the strongest first; at least one, if only to say "no bearing".
        `elapsed_s`: since the previous frame. `mask`: what of the frame is a caller's; None: not known."""
        ...

    def frame_scores(self) -> F32 | None:
        """What the last frame alone scores, (elevations, azimuths); None where only delays are seen."""

    def settle(self, call: bool, /) -> None:
        """Told afterwards whether the frame was taken for a call."""

    def apply(self, settings: Settings, /) -> None:
        """New limits and rates for the same array; what was learnt stays."""

    def forget(self) -> None:
        """Forgets what was learnt of the noise."""


class OnDelays:
    """A locator that needs the delays only, and remembers nothing."""

    def __init__(self, estimate: Estimator):
        self._estimate = estimate

    def __call__(self, _: Frame, tdoa: Tdoa, __: float, ___: Mask | None = None, /) -> tuple[Bearing, ...]:
        return (self._estimate(tdoa),)

    def frame_scores(self) -> None:
        """Directions are not searched."""

    def settle(self, _: bool, /) -> None:
        """Nothing is learnt."""

    def apply(self, _: Settings, /) -> None:
        """An estimator on delays has no limits of its own."""

    def forget(self) -> None:
        """Nothing was learnt."""


LARGEST_AZIMUTH_SIGMA_RAD = math.radians(60.0)
"""Beyond this the answer is "no bearing"."""


def no_bearing(estimator: str, evidence: Evidence | None = None) -> Bearing:
    """The answer where the sound says nothing: silence, noise alone, or too few live microphones."""
    return Bearing(None, NOWHERE_RAD, None, NOWHERE_RAD, math.inf, estimator, evidence=evidence)


@dataclass(frozen=True, eq=False)
class DelayModel:
    """The array, and the errors of its delays."""

    array: MicArray
    speed_m_s: float
    tolerance_s: float
    """1-sigma of a pair's delay from the microphones' positions"""

    @staticmethod
    def of(settings: Settings) -> DelayModel:
        speed = settings.speed_m_s
        return DelayModel(settings.mic_array, speed, math.sqrt(2.0) * settings.array.tolerance_m / speed)

    @property
    def correlation(self) -> F64:
        """(pairs, pairs): two pairs that share a microphone share half of their error (+ or -)."""
        incidence = np.zeros((len(self.array.pairs), self.array.mics))
        for row, (i, j) in enumerate(self.array.pairs):
            incidence[row, i], incidence[row, j] = -1.0, 1.0
        half: F64 = incidence @ incidence.T / 2.0
        return half

    def sigma_s(self, tdoa: Tdoa) -> F64:
        """(pairs,) 1-sigma of the delays with the tolerance of the positions in it."""
        total: F64 = np.hypot(tdoa.sigma_s, self.tolerance_s)
        return total
