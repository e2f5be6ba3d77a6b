"""The paper's experiment on sound: delays measured on simulated frames, whole-sample and sub-sample, and what
an FFT filter before them is worth.

    whole-sample   the highest point of the plain cross-correlation, sample by sample
    sub-sample     the flight's own correlation and peak

Both of the frame as it was heard, and of the frame after the filter. All methods learn from the same frames
and are asked about the same others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from locagen_edge.lab.columns import Flight, length, waveforms
from locagen_edge.lab.methods import take, train
from locagen_edge.lab.samples import at_snr, best_deg, heard, mean_error_deg
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.triangulation import Azimuths, least_squares
from locagen_edge.sim.arrivals import Arrivals
from locagen_edge.sim.waveforms import BLOCK_SAMPLES
from locagen_edge.types import F32

SNR_DB = 10.0
HELD_OUT = 10_000

SCENES: dict[str, dict[str, Any]] = {
    "white, 10 dB": {},
    "the same in wind": {"wind_m_s": 8.0, "wind_dbfs": -10.0},
}
"""What differs in [scene]; the wind is 20 dB louder than the call, most of it below the band."""

PAPER_DEG = {"MLP, whole-sample delays": 13.38, "MLP, whole-sample, filtered": 13.37}

Delays = Callable[[F32], F32]
"""Sound (samples, mics, n) to delays (pairs, samples) in seconds."""


def from_waveforms(s: LabSettings, samples: int, held_out: int) -> dict[str, Any]:
    """MAE in degrees of every method in every scene; `samples` frames to learn from."""
    return {
        "snr_db": SNR_DB,
        "samples": samples,
        "held_out": held_out,
        "paper_deg": PAPER_DEG,
        "mae_deg": {name: _scene(s, keys, samples, held_out) for name, keys in SCENES.items()},
    }


def _scene(s: LabSettings, keys: dict[str, Any], samples: int, held_out: int) -> dict[str, float]:
    s = at_snr(s, SNR_DB)
    s = dataclasses.replace(
        s,
        scene=dataclasses.replace(s.scene, frames=1, lead_s=0.0, sounds=("white",), **keys),
        dataset=dataclasses.replace(s.dataset, level="waveforms", keep=()),
    )
    measures = {
        "whole": lambda sound: whole_sample_delays(s, sound),
        "whole, filtered": lambda sound: whole_sample_delays(s, band_filtered(s, sound)),
        "kernel": flight_delays(s),
        "kernel, filtered": lambda sound: flight_delays(s)(band_filtered(s, sound)),
    }
    learn, ask = (
        _measured(s, measures, samples, s.data.seed),
        _measured(s, measures, held_out, s.data.seed + 1),
    )

    def trained(name: str, kind: str) -> Azimuths:
        return train(name, s, heard(learn[kind])).azimuths

    methods = {
        "MLP, whole-sample delays": (trained("mlp", "whole"), "whole"),
        "MLP, whole-sample, filtered": (trained("mlp", "whole, filtered"), "whole, filtered"),
        "least squares, whole-sample": (least_squares(s), "whole"),
        "MLP, sub-sample delays": (trained("mlp", "kernel"), "kernel"),
        "MLP, sub-sample, filtered": (trained("mlp", "kernel, filtered"), "kernel, filtered"),
        "MLP, all pairs, sub-sample": (trained("mlp-pairs", "kernel"), "kernel"),
        "least squares, sub-sample": (least_squares(s), "kernel"),
    }
    row = {name: mean_error_deg(azimuths, ask[kind]) for name, (azimuths, kind) in methods.items()}
    exact = dataclasses.replace(s, twin=dataclasses.replace(s.twin, position_error_m=0.0))
    row["bound, microphones displaced"] = best_deg(s, ask["kernel"])
    row["bound, sound alone"] = best_deg(exact, ask["kernel"])
    return row


def _measured(s: LabSettings, measures: dict[str, Delays], count: int, seed: int) -> dict[str, Arrivals]:
    """The same frames measured in every way."""
    block = max(1, BLOCK_SAMPLES // length(s))
    delays: dict[str, list[F32]] = {name: [] for name in measures}
    truth = []
    for first in range(0, count, block):  # little lies in memory at once
        drawn = waveforms(s, min(block, count - first), seed, first)
        truth.append((drawn.true_delay_s.T, drawn.position_m.T[:2], drawn.azimuth_rad))
        for name, measure in measures.items():
            delays[name].append(measure(drawn.sound))
    true_s, position_m, azimuth = (np.concatenate(parts, axis=-1) for parts in zip(*truth, strict=True))
    return {
        name: take(Arrivals(np.concatenate(parts, axis=1), true_s, position_m, azimuth), slice(0, count))
        for name, parts in delays.items()
    }


def flight_delays(s: LabSettings) -> Delays:
    """As they are measured in flight."""
    flight = Flight(s)
    return lambda sound: np.ascontiguousarray(flight.columns(sound)["delay_s"].T)


def whole_sample_delays(s: LabSettings, sound: F32) -> F32:
    """The lag of the highest cross-correlation among the whole samples that the geometry allows."""
    array, rate_hz, n = s.mic_array, s.audio.rate_hz, sound.shape[2]
    spectrum = np.fft.rfft(sound, 2 * n, axis=2)  # zeros behind, so that nothing comes round
    first, second = np.array(array.pairs).T
    values = np.fft.irfft(spectrum[:, second] * np.conj(spectrum[:, first]), axis=2)
    most = int(np.ceil(array.longest_delay_s(s.speed_m_s) * rate_hz))
    lags = np.arange(-most, most + 1)
    best = values[:, :, lags].argmax(axis=2)  # negative lags lie at the end
    delay_s: F32 = (lags[best].T / rate_hz).astype(np.float32)
    return delay_s


def band_filtered(s: LabSettings, sound: F32) -> F32:
    """The same frames (samples, mics, n) with the bins of their spectra outside of filter.band_hz at zero."""
    frequency = np.fft.rfftfreq(sound.shape[2], 1.0 / s.audio.rate_hz)
    low, high = s.filter.band_hz
    spectrum = np.fft.rfft(sound, axis=2) * ((frequency >= low) & (frequency <= high))
    return np.fft.irfft(spectrum, sound.shape[2], axis=2).astype(np.float32)
