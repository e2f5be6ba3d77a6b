"""The direction of greatest likelihood, from the spectra themselves and whitened by the noise's own matrix.

Delays throw away what does not fit into one number a pair; the search over directions keeps it. In plain
noise it comes close to the Cramer-Rao bound, and it hears under rotors, which are loud but always come from
the same places: the noise's cross-spectral matrix is learnt while nothing calls, held while something does,
and divided out. The mathematics and its sources: `csrc/locagen.h`.
"""

from __future__ import annotations

import math

from locagen_edge.geometry import tolerance_rad
from locagen_edge.kernel import Steered
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import LARGEST_AZIMUTH_SIGMA_RAD, NOWHERE_RAD, no_bearing
from locagen_edge.types import Bearing, Frame, Tdoa

NAME = "steered"

DEAD = 1e-5
"""Of the loudest microphone's power: what the kernel takes for a dead one."""

LOOKS = 7
"""Frames of noise per microphone before the first bearing (1.1 s for three at the default hop): a matrix
learnt from fewer is nearly singular, and whitening by it invents sources."""


class SteeredLocator:
    """Searches every frame, and learns the noise from those that held no call. One per stream."""

    def __init__(self, settings: Settings):
        steered, audio = settings.steered, settings.audio
        self._search = Steered(
            settings.mic_array.positions_m,
            frame=audio.frame,
            hop=audio.hop,
            rate_hz=float(audio.rate_hz),
            speed_m_s=settings.speed_m_s,
            band_hz=(settings.correlation.band_hz[0], settings.correlation.band_hz[1]),
            taper=steered.taper,
            smooth_bins=steered.smooth_bins,
            floor=10 ** (settings.correlation.floor_dbfs / 10),
        )
        # A microphone that fails for a moment must not be missing from the matrix for long after; one that
        # has failed for good must not keep the others from learning.
        self._bad_hops = 0
        self._looks = LOOKS * settings.mic_array.mics
        self._to_learn = self._looks
        self._tolerance = tolerance_rad(settings.mic_array, settings.array.tolerance_m)
        self.apply(settings)

    def apply(self, settings: Settings, /) -> None:
        """Score and memory as these settings say; the noise's matrix stays."""
        self._least_score = settings.steered.score
        self._share = 1.0 - math.exp(-settings.hop_s / settings.steered.forget_s)
        self._patience = settings.steered.forget_s / settings.hop_s

    def forget(self) -> None:
        """Begins anew with the noise's matrix."""
        self._search.reset()
        self._to_learn = self._looks

    def __call__(self, frame: Frame, _: Tdoa, /) -> Bearing:
        power, bad_mics = self._search.listen(frame.samples)
        failing = bad_mics != 0 or power.min() < DEAD * power.max()
        self._bad_hops = self._bad_hops + 1 if failing else 0
        self._search.hear(1.0)
        found = self._search.search(1)
        if not found or self._to_learn > 0 or found[0].score < self._least_score:
            return no_bearing(NAME)
        source = found[0]
        azimuth_sigma, elevation_sigma = source.sigma_rad()
        # positions that are off turn a source below by as much over cos(elevation)
        tolerance = self._tolerance / max(math.cos(source.elevation_rad), 0.1)
        azimuth_sigma = math.hypot(azimuth_sigma, tolerance)
        elevation_sigma = math.hypot(elevation_sigma, tolerance)
        return Bearing(
            azimuth_rad=source.azimuth_rad if azimuth_sigma < LARGEST_AZIMUTH_SIGMA_RAD else None,
            azimuth_sigma_rad=min(azimuth_sigma, NOWHERE_RAD),
            elevation_rad=source.elevation_rad,
            elevation_sigma_rad=min(elevation_sigma, NOWHERE_RAD),
            misfit=0.0,  # the score has judged already whether a source explains the frame
            estimator=NAME,
        )

    def settle(self, call: bool, /) -> None:
        """Whether the frame was taken for a call: if not, it is noise to learn from.

        So a caller too faint to be detected is learnt too, and fades within `steered.forget_s`.
        """
        if not call and (self._bad_hops == 0 or self._bad_hops > self._patience):
            self._search.learn(self._share)
            self._to_learn = max(self._to_learn - 1, 0)
