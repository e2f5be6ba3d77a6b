"""Overlapping frames out of blocks of any length, and frames in step with the clock.

Every source delivers its sound in blocks of its own size; the pipeline wants `frame` samples every `hop`.
Two laws: how the sound was cut into blocks never shows in the frames, and no frame ever holds sound from
both sides of a gap, because correlations across a splice are worth nothing.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from locagen_edge.types import F32, Array, Drift, Frame

FULL_SCALE = 0.999
"""of 1.0: a converter that is driven beyond its end stays there"""
CLIPPED_SHARE = 0.01
"""of all samples, from which sound counts as clipped: single knocks on a microphone are none"""


class Tap(Protocol):
    """Hears all that a source delivers, before channels are chosen and rates changed.

    The same blocks with the same origins, cut and resampled again, give the same frames, bit for bit. Both
    are called in the thread that reads the source, and must not wait.
    """

    def block(self, rows: Array, rate_hz: float, origin_ns: int) -> None:
        """Rows (n, channels), int16 or float32, its own to keep, and `Framer.origin_ns` as it is for them."""

    def gap(self, overruns: int) -> None:
        """Sound was lost before the next block; 0: none was, but the next begins anew."""


def as_captured(samples: F32, channel_map: tuple[int, ...]) -> F32:
    """(mics, n) as the rows (n, channels) that `audio.channel_map` would choose them from."""
    rows = np.zeros((samples.shape[1], max(channel_map) + 1), dtype=np.float32)
    rows[:, list(channel_map)] = samples.T
    return rows


class Framer:
    """Cuts a stream into frames. Time is counted in samples from `origin_ns`."""

    def __init__(self, frame: int, hop: int, mics: int, rate_hz: float, origin_ns: int = 0) -> None:
        self.origin_ns = origin_ns
        """monotonic time of the first sample since the last gap; set it anew as it becomes better known"""
        self._frame = frame
        self._hop = hop
        self._rate_hz = rate_hz
        self._held: F32 = np.empty((mics, 0), dtype=np.float32)
        self._start = 0  # number of the first sample held
        self._origin = 0  # number of the first sample since the last gap
        self._overruns = 0

    def push(self, block: F32) -> list[Frame]:
        """The frames that (mics, n) more samples complete, in order. They own their samples."""
        held = np.concatenate([self._held, block], axis=1, dtype=np.float32)
        frames = []
        at = 0
        while held.shape[1] - at >= self._frame:
            start = self._start + at
            samples = held[:, at : at + self._frame].copy()
            frames.append(Frame(samples, self._rate_hz, self._time_ns(start), start, self._overruns))
            self._overruns = 0
            at += self._hop
        self._held = held[:, at:].copy()  # a view would keep the whole of a long block alive
        self._start += at
        return frames

    @property
    def missing(self) -> int:
        """How many more samples make the next frame whole."""
        return self._frame - len(self._held[0])

    def gap(self, overruns: int = 1) -> None:
        """Sound was lost here, `overruns` times: what has not filled a frame is dropped.

        Sample numbers and time go on from the last sample pushed; set `origin_ns` where more is known.
        """
        self._start += self._held.shape[1]
        self._held = self._held[:, :0]
        self.origin_ns = self._time_ns(self._start)
        self._origin = self._start
        self._overruns += overruns

    def _time_ns(self, sample: int) -> int:
        return self.origin_ns + round((sample - self._origin) * 1e9 / self._rate_hz)


@dataclass
class Losses:
    """What of a source's sound is missing, and how its clock runs: counted frame by frame."""

    overruns: int = 0
    """times that sound was lost"""
    lost_s: float = 0.0
    """between the frames before and after: by these, by frames dropped unheard, while the source was away"""
    drift: Drift | None = None
    _ended_ns: int | None = None
    _away: bool = False

    def reopened(self) -> None:
        """The next frame is the first of another opening."""
        self._away = True

    def count(self, frame: Frame) -> None:
        """Takes each frame in order."""
        if self._ended_ns is not None and (frame.overruns or self._away):
            self.lost_s += max(frame.t_ns - self._ended_ns, 0) * 1e-9
        self.overruns += frame.overruns
        self._ended_ns, self._away = frame.end_ns, False
        self.drift = frame.drift or self.drift

    def __str__(self) -> str:
        overruns = f"{self.overruns} overruns" if self.overruns != 1 else "1 overrun"
        clock = f", clock {self.drift}" if self.drift is not None else ""
        return f"{overruns}, {self.lost_s:.1f} s of sound lost{clock}"


async def in_real_time(
    frames_from: Callable[[int], Generator[Frame, None, None]],
) -> AsyncGenerator[Frame, None]:
    """Frames whose time counts from now (monotonic), each when its last sample would have been heard.

    Where the reader is late, frames come as fast as they are taken until it has caught up: none is dropped.
    """
    with closing(frames_from(time.monotonic_ns())) as frames:
        for frame in frames:
            await asyncio.sleep(max(0.0, (frame.end_ns - time.monotonic_ns()) * 1e-9))
            yield frame
