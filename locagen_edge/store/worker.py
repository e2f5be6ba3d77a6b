"""A thread that writes, behind a bounded queue: a slow disk never holds up sound or event loop.

It looks every `turn_s`, at least every `TURN_S`, and writes all that has come since: a thread that woke up
for each item would cost more than what it does for it. What finds the queue full is dropped and counted: the
newest, because what is older is already promised.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

log = logging.getLogger(__name__)

T = TypeVar("T")

TURN_S = 0.25


class Worker(Generic[T]):
    """In one thread: `write(item)` for each item in order, `turn()` after each turn, `end()` once, last.

    These three handle their own `OSError`. Any other exception is a fault of ours: told once, and all that
    comes afterwards is dropped.
    """

    def __init__(
        self,
        name: str,
        most: float,
        write: Callable[[T], None],
        turn: Callable[[], None],
        end: Callable[[], None],
        turn_s: float,
        size: Callable[[T], float] = lambda _: 1.0,
    ) -> None:
        self.dropped = 0
        """items for which the queue had no room"""
        self.failure = ""
        """a fault of ours, in words"""
        self._most, self._size, self._filled = most, size, 0.0
        self._queue: deque[T] = deque()
        self._write, self._turn, self._end = write, turn, end
        self._turn_s = min(turn_s, TURN_S)
        self._lock = threading.Lock()
        self._closing = False
        self._wake = threading.Event()
        # a daemon thread: one that hangs in a disk must not keep the process from ending
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Items in the queue."""
        return len(self._queue)

    def put(self, item: T, *, urgent: bool = False) -> bool:
        """From any thread, without waiting. False: dropped and counted."""
        with self._lock:  # nothing comes in behind what `close` has promised to write
            if self._closing or self._filled >= self._most or not self._thread.is_alive():
                self.dropped += 1
                return False
            self._queue.append(item)
            self._filled += self._size(item)
        if urgent or self._filled > self._most / 2:
            self._wake.set()
        return True

    def close(self, timeout_s: float) -> bool:
        """Writes what is in the queue, then ends. False: the disk still hangs after so long."""
        with self._lock:
            self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._closing:
                self._wake.wait(self._turn_s)
                self._wake.clear()
                self._write_all()
                self._turn()
            self._write_all()  # put just before `close`
            self._end()
        except Exception as error:
            self.failure = f"{self._thread.name}: {error!r}: nothing more is written"
            log.exception("%s", self.failure)

    def _write_all(self) -> None:
        """What is in the queue now: what comes meanwhile waits for the next turn."""
        for _ in range(len(self._queue)):
            with self._lock:
                item = self._queue.popleft()
                self._filled -= self._size(item)
            self._write(item)
