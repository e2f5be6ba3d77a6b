"""The sound of each call, with what came before it: parts of a recording, cut from the frames that fly.

They hold the microphones at the processing rate, in the channels that `audio.channel_map` chooses them from,
as FLAC once they are whole: `replay` reads them with the settings beside them. Time is that of the frames.

Frames come with the channels' delays and gains taken out: the settings beside say that there are none left.
"""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from locagen_edge.errors import StorageError
from locagen_edge.framing import as_captured
from locagen_edge.settings import Settings
from locagen_edge.store.flac import pack
from locagen_edge.store.folder import prepare
from locagen_edge.store.part import Block, Bound, Part, Session, recover
from locagen_edge.types import Frame

MB = 1_000_000
PART_BYTES = 2**31
"""a snippet is bounded in seconds"""


class Snippets:
    """Remembers the last seconds, and writes from there on while something calls.

    Methods raise `OSError` or `StorageError` where the disk is full or gone; the next call is tried anew.
    """

    def __init__(self, directory: Path, settings: Settings) -> None:
        self._directory = directory
        self._settings = settings
        self._log = settings.log
        self._bound = Bound(directory, round(self._log.snippets_mb * MB), give_up_oldest=True)
        self._held: deque[Block] = deque()  # with `origin_ns` the time of its own first row
        self._held_rows = 0
        self._next: int | None = None  # number of the first sample that has not been heard
        self._part: Part | None = None
        self._written_s = 0.0
        self._origin_ns = 0  # time of the first row since the beginning or the last gap
        self._called_ns = 0  # when something was last calling
        self._synced_s = 0.0

    def apply(self, settings: Settings) -> None:
        """What stands beside a snippet that begins from here on. Bounds stay those of the beginning."""
        self._settings = settings

    def hear(self, frame: Frame, utc: datetime, *, begins: bool, calling: bool) -> str:
        """Takes every frame, in order. Name of the snippet that it went into; empty: none.

        `begins`: a call begins in this frame; `calling`: one goes on, or more.
        """
        block = self._new(frame)
        if calling:
            self._called_ns = frame.t_ns
        self._hold(block)
        try:
            if begins and self._part is None:
                self._begin(block, utc)
            elif self._part is not None:
                self._write(self._part, block)
            return self._end_if_due(frame)
        except (OSError, StorageError):
            with suppress(OSError):
                self.end()
            raise

    def end(self) -> None:
        """Finishes the snippet that is being written, if any."""
        part, self._part = self._part, None
        if part is not None:
            room = self._bound.room_for(part, part.size)  # for a moment there are both
            part.close()
            if room:
                pack(self._directory / f"{part.name}.wav")

    def _new(self, frame: Frame) -> Block:
        """What of this frame has not been heard yet."""
        length = frame.samples.shape[1]
        known = 0 if self._next is None else self._next - frame.start
        follows = 0 <= known < length and frame.overruns == 0
        if not follows:
            known = 0  # sound was lost, or the source began anew
        gap = None if follows else max(frame.overruns, 1)
        self._next = frame.start + length
        rows = as_captured(frame.samples[:, known:], self._settings.audio.channel_map)
        return Block(rows, frame.rate_hz, frame.t_ns + round(known / frame.rate_hz * 1e9), gap)

    def _hold(self, block: Block) -> None:
        """The last `log.before_s`, and at least this block."""
        self._held.append(block)
        self._held_rows += len(block.rows)
        most = self._log.before_s * block.rate_hz
        while len(self._held) > 1 and self._held_rows - len(self._held[0].rows) >= most:
            self._held_rows -= len(self._held.popleft().rows)

    def _begin(self, block: Block, utc: datetime) -> None:
        prepare(self._directory)
        for path in recover(self._directory):
            pack(path)
        self._bound.count()
        session = Session.begin(self._directory, utc)
        self._written_s = 0.0
        array = replace(self._settings.array, delays_s=(), gains_db=())
        settings = replace(self._settings, array=array)
        self._part = Part(self._directory, session, block, PART_BYTES, settings)
        for number, held in enumerate(self._held):
            self._write(self._part, held, first=number == 0)

    def _write(self, part: Part, block: Block, *, first: bool = False) -> None:
        if first or block.gap is not None:
            self._origin_ns = block.origin_ns
        block = replace(block, origin_ns=self._origin_ns, gap=None if first else block.gap)
        if not self._bound.room_for(part, block.size):
            raise StorageError(f"{self._directory}: log.snippets_mb is less than one snippet")
        part.write(block)
        self._written_s += len(block.rows) / block.rate_hz

    def _end_if_due(self, frame: Frame) -> str:
        if self._part is None:
            return ""
        name = self._part.name
        quiet_s = (frame.t_ns - self._called_ns) * 1e-9
        if quiet_s > self._log.after_s or self._written_s >= self._log.longest_s:
            self.end()
        elif time.monotonic() - self._synced_s > self._log.sync_s:
            self._synced_s = time.monotonic()
            self._part.sync()
        return name
