"""All that a source delivers, on disk in parts (`store/part.py`), before anything is made of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from locagen_edge.errors import StorageError
from locagen_edge.jsonl import Record, encode
from locagen_edge.settings import Settings
from locagen_edge.store.folder import free_bytes, prepare
from locagen_edge.store.part import Block, Bound, Part, Session, recover
from locagen_edge.store.worker import Worker
from locagen_edge.types import F64, Array

Sound = tuple[Block, Settings]
"""with the settings it came under"""

MB = 1_000_000
WAITING_S = 10.0
"""sound that may wait for the disk"""
CLOSE_S = 10.0
"""how long the end waits for a slow disk"""


@dataclass(frozen=True)
class Progress:
    """What a person wants to see."""

    seconds: float
    """recorded"""
    name: str
    """of the part that is being written"""
    kept_bytes: int
    """all parts in the folder"""
    lost: int
    """blocks for which the disk was too slow"""
    rms: F64
    """(channels,) since the last time, full scale 1.0"""
    peak: F64
    """(channels,)"""


class Recorder:
    """A `Tap` that writes. Its methods are quick, and may be called from any one thread at a time.

    Raises `StorageError` where the folder cannot be written to or the disk has no room from the start. What
    comes later is in `failure`, in words: nothing is written from then on, and what was written is whole.
    """

    def __init__(
        self, directory: Path, settings: Settings, utc: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self._failure = ""
        self._directory = directory
        self._settings = settings
        self._of_part = settings
        self._bounds = settings.record
        prepare(directory)
        recover(directory)
        self._part: Part | None = None
        self._bound = Bound(
            directory, round(self._bounds.total_mb * MB), give_up_oldest=self._bounds.when_full == "oldest"
        )
        self._synced_s = 0.0
        self._gap: int | None = None
        self._lock = threading.Lock()
        self._seconds = 0.0
        self._counted = 0  # rows in the two sums below
        self._squares: F64 = np.zeros(0)
        self._peak: F64 = np.zeros(0)
        try:
            self._session = Session.begin(directory, utc())
            self._bound.count()
            self._check_free()
        except OSError as error:
            raise StorageError(f"{directory}: {error.strerror}") from error
        if self._failure:
            raise StorageError(self._failure)
        self._worker: Worker[Sound | bytes] = Worker(
            "recorder", WAITING_S, self._write, self._sync_if_due, self._end,
            turn_s=settings.record.sync_s / 4, size=_seconds,
        )  # fmt: skip

    # --- from the source's thread

    def block(self, rows: Array, rate_hz: float, origin_ns: int) -> None:
        """Takes rows (n, channels), int16 or float32."""
        if self._worker.put((Block(rows, rate_hz, origin_ns, self._gap), self._settings)):
            self._gap = None
        else:
            self.gap(1)

    def gap(self, overruns: int) -> None:
        self._gap = overruns + (self._gap or 0)

    # --- from anywhere

    def apply(self, settings: Settings) -> None:
        """Settings that hold from here on: they begin a part, so that those beside a part hold for all of it.

        The sound comes a frame or two before what is made of it. Bounds stay those of the beginning.
        """
        if settings != self._settings:
            self._settings = settings

    @property
    def failure(self) -> str:
        """Why nothing more is written, in words; empty while all is well."""
        return self._failure or self._worker.failure

    def note(self, record: Record) -> None:
        """A record more beside the sound, under a `type` of its own. Raises `ValueError` like `encode`."""
        self._worker.put(encode(record))

    def progress(self) -> Progress:
        """What there is so far; the levels begin anew."""
        with self._lock:
            rms = np.sqrt(self._squares / max(self._counted, 1))
            peak = self._peak
            self._counted, self._squares, self._peak = 0, np.zeros_like(rms), np.zeros_like(peak)
            part = self._part
            return Progress(
                self._seconds,
                part.name if part else "",
                self._bound.others + (part.size if part else 0),
                self._worker.dropped,
                rms,
                peak,
            )

    def close(self) -> None:
        """Writes what waits, and finishes the part. Raises `StorageError` where the disk hangs."""
        if not self._worker.close(CLOSE_S):
            raise StorageError(
                f"{self._directory}: the disk hangs: the last part is finished by the next start"
            )

    # --- in the writing thread

    def _write(self, item: Sound | bytes) -> None:
        if self._failure:
            return
        try:
            if isinstance(item, bytes):
                if self._part is not None and self._room_for(self._part, len(item)):
                    self._part.line(item)
            else:
                self._write_block(*item)
        except OSError as error:
            self._fail(f"{self._directory}: {error.strerror}: the recording ends here")

    def _write_block(self, block: Block, settings: Settings) -> None:
        part, same = self._part, settings is self._of_part
        if part is not None and not (same and part.takes(block, self._bounds.part_s)):
            self._finish()
        if self._part is None:
            self._bound.count()
            part_bytes = round(self._bounds.part_mb * MB)
            self._part = Part(self._directory, self._session, block, part_bytes, settings)
            self._of_part = settings
        if self._room_for(self._part, block.size):
            self._part.write(block)
            self._count(block)

    def _room_for(self, part: Part, size: int) -> bool:
        if not self._bound.room_for(part, size):
            self._fail(
                f"{self._directory}: record.total_mb = {self._bounds.total_mb:g} MB of recordings are there: "
                'move them away, or set record.when_full = "oldest"'
            )
        return not self._failure

    def _count(self, block: Block) -> None:
        rows = block.rows.astype(np.float64)
        if block.rows.dtype == np.int16:
            rows /= 32768.0
        rows = np.nan_to_num(rows, posinf=0.0, neginf=0.0)
        with self._lock:
            if len(self._squares) != rows.shape[1]:
                self._squares, self._peak, self._counted = np.zeros(rows.shape[1]), np.zeros(rows.shape[1]), 0
            self._squares = self._squares + np.sum(rows**2, axis=0)
            self._peak = np.maximum(self._peak, np.max(np.abs(rows), axis=0))
            self._counted += len(rows)
            self._seconds += len(rows) / block.rate_hz

    def _sync_if_due(self) -> None:
        if self._failure or time.monotonic() - self._synced_s < self._bounds.sync_s:
            return
        self._synced_s = time.monotonic()
        try:
            if self._part is not None:
                self._part.sync()
            self._check_free()
        except OSError as error:
            self._fail(f"{self._directory}: {error.strerror}: the recording ends here")

    def _check_free(self) -> None:
        wanted = self._bounds.free_mb * MB
        free = free_bytes(self._directory)
        if free < wanted:
            self._bound.give_up(round(wanted - free), self._part.name if self._part else "")
            free = free_bytes(self._directory)
        if free < wanted:
            self._fail(
                f"{self._directory}: {free / MB:.0f} MB are free on the disk, record.free_mb = "
                f"{self._bounds.free_mb:g} MB have to stay so: make room, or record elsewhere"
            )

    def _fail(self, text: str) -> None:
        self._failure = text
        self._end()

    def _finish(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            part.close()

    def _end(self) -> None:
        try:
            self._finish()
        except OSError as error:
            self._failure = self._failure or f"{self._directory}: {error.strerror}: the recording ends here"
            with suppress(StorageError):  # else the next start in this folder mends it
                recover(self._directory)


def _seconds(item: Sound | bytes) -> float:
    return 0.0 if isinstance(item, bytes) else len(item[0].rows) / item[0].rate_hz
