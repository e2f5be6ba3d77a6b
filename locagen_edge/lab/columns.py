"""What a model learns from, at both levels of the twin, as columns of one row per sample.

Of waveforms, the flight's own stages make the delays: frames of the same length and hop through the very
`Correlator` and `PeakPicker`, so that nothing is learned which the drone will not see.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from locagen_edge.lab.recordings import load
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.twin import sample
from locagen_edge.sim.waveforms import BLOCK_SAMPLES, RECORDED, Waveforms, draw
from locagen_edge.stages.correlation import Correlator
from locagen_edge.stages.tdoa import PeakPicker
from locagen_edge.types import F32, Array, Frame

Columns = dict[str, Array]

MEANING: dict[str, tuple[str, str]] = {
    "delay_s": ("s", "measured t_j - t_i of each pair (i, j), i < j; NaN where a frame has no peak"),
    "sigma_s": ("s", "1-sigma of that delay as the flight states it; infinite where there is no peak"),
    "peak": ("", "height of the correlation's peak, 0 to 1"),
    "power": ("", "in-band mean square of each microphone, full scale 1.0"),
    "correlation": ("", "GCC-PHAT of each pair at correlation.oversample lags a sample, the middle one is 0"),
    "sound": ("", "each microphone's samples, full scale 1.0"),
    "call": ("", "the call in them, before the converter"),
    "calling": ("", "whether the call has begun by the frame's middle"),
    "true_delay_s": ("s", "t_j - t_i of the sound itself, at the microphones' displaced places"),
    "position_m": ("m", "source from the array's middle: x forward, y right (, z down)"),
    "azimuth_rad": ("rad", "0 ahead, positive clockwise seen from above, -pi to pi"),
    "elevation_rad": ("rad", "positive up"),
    "snr_db": ("dB", "in-band, call over sensor noise and rotors"),
    "onset": ("samples", "number of the first sample of the call"),
    "kind": ("", "what sounds"),
}
"""Unit and meaning of every column; true_delay_s and what follows is truth, the rest a drone can know."""


def length(settings: LabSettings) -> int:
    """Samples of one microphone in one row of waveforms."""
    return settings.audio.frame + (settings.scene.frames - 1) * settings.audio.hop


def waveforms(settings: LabSettings, count: int, seed: int, first: int = 0) -> Waveforms:
    """Samples `first` to `first + count` of a seed's row of waveforms.

    Raises `DatasetError` where recorded sounds are asked for and cannot be had.
    """
    scene, rate_hz = settings.scene, settings.audio.rate_hz
    recorded = load(scene.recordings, rate_hz) if RECORDED in scene.sounds else ()
    return draw(
        settings.mic_array, settings.speed_m_s, rate_hz, length(settings),
        settings.twin, scene, count, seed, first, recorded,
    )  # fmt: skip


def columns(settings: LabSettings, count: int, seed: int, first: int = 0) -> Columns:
    """Samples `first` to `first + count` of a seed's row at `dataset.level`: name -> (count, ...)."""
    return LEVELS[settings.dataset.level](settings, count, seed, first)


def _of_arrivals(settings: LabSettings, count: int, seed: int, first: int) -> Columns:
    arrivals = sample(settings, count, seed, first)
    return {
        "delay_s": arrivals.delay_s.T,
        "true_delay_s": arrivals.true_delay_s.T,
        "position_m": arrivals.position_m.T,
        "azimuth_rad": arrivals.azimuth_rad,
    }


def _of_waveforms(settings: LabSettings, count: int, seed: int, first: int) -> Columns:
    block = max(1, BLOCK_SAMPLES // length(settings))  # what is made at once, so that little lies in memory
    ends = [*range(block - first % block, count, block), count]
    pieces, start = [], 0
    flight = Flight(settings)
    for end in ends:
        drawn = waveforms(settings, end - start, seed, first + start)
        pieces.append({**flight.columns(drawn.sound), **_truth(settings, drawn)})
        start = end
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


LEVELS: dict[str, Callable[[LabSettings, int, int, int], Columns]] = {
    "arrivals": _of_arrivals,
    "waveforms": _of_waveforms,
}


def _truth(settings: LabSettings, drawn: Waveforms) -> Columns:
    audio = settings.audio
    middles = audio.frame // 2 + audio.hop * np.arange(settings.scene.frames)
    kept: Columns = {
        name: getattr(drawn, name) for name in ("sound", "call") if name in settings.dataset.keep
    }
    return {
        **kept,
        "calling": _one_frame(middles >= drawn.onset[:, np.newaxis]),
        "true_delay_s": drawn.true_delay_s,
        "position_m": drawn.position_m,
        "azimuth_rad": drawn.azimuth_rad,
        "elevation_rad": drawn.elevation_rad,
        "snr_db": drawn.snr_db,
        "onset": drawn.onset,
        "kind": drawn.kind,
    }


class Flight:
    """The flight's stages from frame to delays, over whole arrays of samples."""

    def __init__(self, settings: LabSettings) -> None:
        audio = settings.audio
        self._frame, self._hop, self._rate_hz = audio.frame, audio.hop, float(audio.rate_hz)
        shape = (settings.mic_array, settings.speed_m_s, self._rate_hz, audio.frame, settings.correlation)
        self._correlate = Correlator(*shape)
        self._pick = PeakPicker(*shape)
        self._keep_correlation = "correlation" in settings.dataset.keep

    def columns(self, sound: F32) -> Columns:
        """Of (samples, mics, n): (samples, frames, pairs ...), without frames where n is one."""
        rows = [self._row(samples) for samples in sound]
        return {name: _one_frame(np.stack([row[name] for row in rows])) for name in rows[0]}

    def _row(self, samples: F32) -> Columns:
        measured: dict[str, list[Array]] = {}
        for frame in self._frames(samples):
            correlation = self._correlate(frame)
            tdoa = self._pick(correlation)
            values: Columns = {
                "delay_s": tdoa.delay_s, "sigma_s": tdoa.sigma_s, "peak": tdoa.peak,
                "power": correlation.power,
            }  # fmt: skip
            if self._keep_correlation:
                values["correlation"] = correlation.values
            for name, value in values.items():
                measured.setdefault(name, []).append(value)
        return {name: np.array(values, dtype=np.float32) for name, values in measured.items()}

    def _frames(self, samples: F32) -> Iterator[Frame]:
        for start in range(0, samples.shape[1] - self._frame + 1, self._hop):
            cut = np.ascontiguousarray(samples[:, start : start + self._frame])
            yield Frame(cut, self._rate_hz, round(start * 1e9 / self._rate_hz), start)


def _one_frame(column: Array) -> Array:
    """Without the axis of frames (samples, frames, ...) where there is but one."""
    return column[:, 0] if column.shape[1] == 1 else column
