"""Samples of the twin as the models take them, whichever level made them, and the best that they allow."""

from __future__ import annotations

import dataclasses

import numpy as np

from locagen_edge.lab.bound import (
    arrival_sigma_s,
    best_table,
    displacement_sigma_s,
    errors_rad,
    expected_deg,
    look_up,
)
from locagen_edge.lab.columns import Columns, columns
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.triangulation import Azimuths
from locagen_edge.lab.twin import noise_s, sample
from locagen_edge.sim.arrivals import Arrivals
from locagen_edge.types import F64

NAMES = ("delay_s", "true_delay_s", "position_m", "azimuth_rad")
TABLE = 1_000_000
"""Draws for the best answer to each combination of whole-sample delays."""


def of_columns(read: Columns) -> Arrivals:
    """`Arrivals` from columns of a data set: one sample per frame in which the call has begun."""
    delay_s, true_s = read["delay_s"], read["true_delay_s"]
    position_m, azimuth = read["position_m"], read["azimuth_rad"]
    if delay_s.ndim == 3:  # several frames a sample
        row, frame = np.nonzero(read["calling"])
        delay_s, true_s = delay_s[row, frame], true_s[row]
        position_m, azimuth = position_m[row], azimuth[row]
    x_y = np.ascontiguousarray(position_m.T[:2])
    return Arrivals(np.ascontiguousarray(delay_s.T), np.ascontiguousarray(true_s.T), x_y, azimuth)


def draw(s: LabSettings, count: int, seed: int) -> Arrivals:
    """`count` samples at `dataset.level`, with more than one frame a sample as many more."""
    return of_columns(columns(s, count, seed))


def heard(data: Arrivals) -> Arrivals:
    """Those samples in which every pair has a peak: silence has nothing to learn from."""
    rows = np.isfinite(data.delay_s).all(axis=0)
    return Arrivals(
        data.delay_s[:, rows], data.true_delay_s[:, rows], data.position_m[:, rows], data.azimuth_rad[rows]
    )


def mean_error_deg(azimuths: Azimuths, data: Arrivals) -> float:
    """Mean |azimuth error| in degrees; a sample without an answer counts as a guess, 90 degrees."""
    answered = heard(data)
    total = float(errors_rad(azimuths(answered.delay_s), answered.azimuth_rad).sum())
    silent = len(data.azimuth_rad) - len(answered.azimuth_rad)
    return float(np.degrees(total + silent * np.pi / 2.0) / len(data.azimuth_rad))


def at_snr(s: LabSettings, snr_db: float) -> LabSettings:
    """The same at one SNR, whatever the range."""
    return dataclasses.replace(
        s,
        twin=dataclasses.replace(s.twin, noise="snr", snr_db=snr_db),
        scene=dataclasses.replace(s.scene, snr_span_db=0.0, snr_at_m=0.0),
    )


def best_deg(s: LabSettings, data: Arrivals) -> float:
    """The smallest mean |azimuth error| in degrees that these samples of one SNR allow.

    Whole-sample arrivals: of the best answer for each combination of delays. Arrivals without rounding, and
    frames of sound: the Cramer-Rao bound of white sound and sensor noise, with the microphones' displacement
    as one more error of the arrivals. Rotors, wind and echoes can only add to it.
    """
    rate_hz = s.audio.rate_hz
    if s.dataset.level == "arrivals" and s.twin.rounding != "none":
        large = sample(s, TABLE, s.data.seed + 3)
        table = best_table(large.delay_s, large.azimuth_rad, rate_hz)
        return mean_error_deg(lambda delay_s: look_up(table, delay_s, rate_hz), data)
    horizontal = np.hypot(*data.position_m.astype(np.float64))
    height = s.twin.height_m + 0.5 * s.twin.height_span_m
    elevation: F64 = np.arctan2(np.full_like(horizontal, height), horizontal)
    sigma = arrival_sigma_s(
        s.twin.snr_db, s.correlation.band_hz, s.audio.frame / rate_hz, s.mic_array.mics
    ) if s.dataset.level == "waveforms" else noise_s(s)  # fmt: skip
    moved = displacement_sigma_s(s.twin.position_error_m, s.speed_m_s, elevation)
    off = expected_deg(
        s.mic_array, s.speed_m_s, data.azimuth_rad.astype(np.float64), elevation, np.hypot(sigma, moved)
    )
    return float(np.minimum(off, 90.0).mean())
