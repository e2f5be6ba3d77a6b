"""The best that is possible: for whole-sample delays, and for sound.

A method whose input is a pair of whole numbers gives one answer per pair of numbers. The one with the
smallest expected |error| is the circular median of all azimuths that lead to that pair; nothing that sees
only those numbers, learned or not, does better. For sound itself the bound is that of Cramer and Rao.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from locagen_edge.geometry import MicArray
from locagen_edge.types import F32, F64

Cells = np.ndarray


def cells(delay_s: F32, rate_hz: float) -> Cells:
    """(samples,) one whole number for each combination of whole-sample delays (pairs, samples)."""
    steps = np.rint(delay_s.astype(np.float64) * rate_hz).astype(np.int64)
    number = np.zeros(steps.shape[1], np.int64)
    for row in steps:
        number = number * 4096 + (row + 2048)  # 2047 samples of delay are 14 m at 48 kHz
    return number


def circular_median(azimuth_rad: F64) -> float:
    """The angle with the smallest mean |circular error| to all of (samples,), to a quarter degree or better.

    The mean |error| is piecewise linear with its corners at the samples and opposite them, so it is looked
    for on the circle's quarter degrees and then, within one, as the plain median of the unwrapped angles.
    """
    grid = np.radians(np.arange(-180.0, 180.0, 0.25))
    # of a large cell 2000 angles tell the neighbourhood well enough
    few = azimuth_rad[:: max(len(azimuth_rad) // 2000, 1)]
    cost = np.abs(_wrapped(few[None] - grid[::8, None])).mean(axis=1)
    start = grid[::8][cost.argmin()]
    turned = _wrapped(azimuth_rad - start)
    return float(_wrapped(start + np.median(turned)))


def _wrapped(angle: F64) -> F64:
    wrapped: F64 = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The best answer for each cell that was seen."""

    cell: Cells
    """(cells,) ascending"""
    azimuth_rad: F64
    """(cells,)"""


def best_table(delay_s: F32, azimuth_rad: F32, rate_hz: float) -> Table:
    """The circular median of each cell of a large draw: delays (pairs, samples), azimuths (samples,)."""
    number = cells(delay_s, rate_hz)
    order = np.argsort(number, kind="stable")
    seen, starts = np.unique(number[order], return_index=True)
    groups = np.split(azimuth_rad[order].astype(np.float64), starts[1:])
    return Table(seen, np.array([circular_median(group) for group in groups]))


def look_up(table: Table, delay_s: F32, rate_hz: float) -> F64:
    """Azimuths (samples,); a cell that the table never saw gets the answer of the nearest number."""
    number = cells(delay_s, rate_hz)
    at = np.searchsorted(table.cell, number).clip(1, len(table.cell) - 1)
    left, right = table.cell[at - 1], table.cell[at]
    found: F64 = table.azimuth_rad[np.where(number - left < right - number, at - 1, at)]
    return found


def errors_rad(estimate_rad: F64, true_rad: F32 | F64) -> F64:
    """|circular error| (samples,), 0 to pi."""
    error: F64 = np.abs(_wrapped(np.asarray(estimate_rad, np.float64) - np.asarray(true_rad, np.float64)))
    return error


def mae_deg(estimate_rad: F64, true_rad: F32 | F64) -> float:
    """Mean |circular error| in degrees."""
    return math.degrees(float(errors_rad(estimate_rad, true_rad).mean()))


# --- sound --------------------------------------------------------------------------------------------


def arrival_sigma_s(snr_db: float, band_hz: tuple[float, ...], seconds: float, mics: int) -> float:
    """1-sigma of one arrival, seconds, that an unknown sound leaves at best.

    1 / sigma^2 = sum_f 2 M s^2 / (1 + M s) (2 pi f)^2 over the bins of the band, `seconds`^-1 apart, with
    the same SNR s in each and independent noise in M microphones. Hahn & Tretter, "Optimum processing for
    delay-vector estimation in passive signal arrays", IEEE Trans. Information Theory 19 (1973).
    """
    snr = 10.0 ** (snr_db / 10.0)
    frequency = np.arange(math.ceil(band_hz[0] * seconds), math.floor(band_hz[1] * seconds) + 1) / seconds
    gain = 2.0 * mics * snr**2 / (1.0 + mics * snr)
    return float(1.0 / math.sqrt(gain * ((2.0 * math.pi * frequency) ** 2).sum()))


def expected_deg(
    array: MicArray, speed_m_s: float, azimuth_rad: F64, elevation_rad: F64, sigma_s: float | F64
) -> F64:
    """The smallest mean |azimuth error| (n,) in degrees of far sources whose arrivals are off by sigma_s.

    J = sum_m (tau'_m - mean)^2 / sigma^2, with tau'_m the change of an arrival with the azimuth, which
    shrinks with the elevation's cosine; a Gaussian error of variance 1 / J has the mean sqrt(2 / (pi J)).
    """
    across = np.stack([-np.sin(azimuth_rad), np.cos(azimuth_rad), np.zeros_like(azimuth_rad)])
    slope = -(array.positions_m @ (across * np.cos(elevation_rad))) / speed_m_s
    spread = ((slope - slope.mean(axis=0)) ** 2).sum(axis=0)
    mean: F64 = np.degrees(sigma_s * np.sqrt(2.0 / (math.pi * np.maximum(spread, 1e-30))))
    return mean


def displacement_sigma_s(position_error_m: float, speed_m_s: float, elevation_rad: F64) -> F64:
    """1-sigma of an arrival (n,) at a microphone that is off by up to this along x and y, uniform."""
    sigma: F64 = position_error_m / math.sqrt(3.0) * np.cos(elevation_rad) / speed_m_s
    return sigma
