"""A thread that writes, behind a bounded queue: a slow disk never holds up sound or event loop.

What finds the queue full is dropped and counted: the newest, because what is older is already promised.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

log = logging.getLogger(__name__)

T = TypeVar("T")

IDLE_S = 0.5
"""how often `idle` is called while nothing comes"""


class Worker(Generic[T]):
    """Calls `write(item)` for each item, in order; `idle()` now and then; `end()` once, last. In one thread.

    These three handle their own `OSError`. Any other exception is a fault of ours: told once, and all that
    comes afterwards is dropped.
    """

    def __init__(
        self,
        name: str,
        most: int,
        write: Callable[[T], None],
        idle: Callable[[], None],
        end: Callable[[], None],
    ) -> None:
        self.dropped = 0
        """items for which the queue had no room"""
        self.failure = ""
        """a fault of ours, in words"""
        self._queue: queue.Queue[T | None] = queue.Queue(most)
        self._write, self._idle, self._end = write, idle, end
        self._closing = threading.Event()
        # a daemon thread: one that hangs in a disk must not keep the process from ending
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> bool:
        """From any thread, without waiting. False: dropped and counted."""
        if not self._closing.is_set() and self._thread.is_alive():
            try:
                self._queue.put_nowait(item)
                return True
            except queue.Full:
                pass
        self.dropped += 1
        return False

    def close(self, timeout_s: float) -> bool:
        """Writes what is in the queue, then ends. False: the disk still hangs after so long."""
        self._closing.set()
        with suppress(queue.Full):  # then the thread is not waiting
            self._queue.put_nowait(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not (self._closing.is_set() and self._queue.empty()):
                try:
                    item = self._queue.get(timeout=IDLE_S)
                except queue.Empty:
                    self._idle()
                    continue
                if item is not None:
                    self._write(item)
            self._end()
        except Exception as error:
            self.failure = f"{self._thread.name}: {error!r}: nothing more is written"
            log.exception("%s", self.failure)
