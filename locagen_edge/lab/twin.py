"""Samples of the twin under the workshop's settings, for any rate and spacing.

The seam for whoever makes shards, or waveforms: `sample(settings, count, seed, first)` gives any piece of a
seed's endless row, so pieces can be made anywhere and joined.
"""

from __future__ import annotations

import dataclasses

from locagen_edge.lab.bound import arrival_sigma_s
from locagen_edge.lab.settings import LabSettings, triangle
from locagen_edge.sim.arrivals import Arrivals, draw


def sample(settings: LabSettings, count: int, seed: int, first: int = 0) -> Arrivals:
    """Samples `first` to `first + count` of a seed's row."""
    return draw(
        settings.mic_array,
        settings.speed_m_s,
        settings.audio.rate_hz,
        settings.twin,
        noise_s(settings),
        count,
        seed,
        first,
    )


def noise_s(settings: LabSettings) -> float:
    """1-sigma of each arrival, seconds."""
    twin = settings.twin
    if twin.noise == "snr":
        audio = settings.audio
        return arrival_sigma_s(
            twin.snr_db, settings.correlation.band_hz, audio.frame / audio.rate_hz, settings.mic_array.mics
        )
    return 1e-6 * twin.noise_us if twin.noise == "fixed" else 0.0


def at_rate(settings: LabSettings, rate_hz: int) -> LabSettings:
    """The same, sampled at another rate."""
    return dataclasses.replace(settings, audio=dataclasses.replace(settings.audio, rate_hz=rate_hz))


def with_spacing(settings: LabSettings, spacing_m: float) -> LabSettings:
    """The same with an equilateral triangle of this side."""
    return dataclasses.replace(
        settings, array=dataclasses.replace(settings.array, positions_m=triangle(spacing_m))
    )


def with_twin(settings: LabSettings, **keys: object) -> LabSettings:
    """The same with other keys in [twin]."""
    return dataclasses.replace(settings, twin=dataclasses.replace(settings.twin, **keys))  # type: ignore[arg-type]
