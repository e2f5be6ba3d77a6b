"""SIGTERM, from the first moment of the process to its last: obeyed once, cleanly.

asyncio's own handlers live no longer than its loop: a signal just before or after would kill the process in
the middle of what it writes. Here one handler stays, and what it does changes.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType

_stop: Callable[[], object] | None = None
"""what to call; None: leave at once, nothing has begun"""


def _obey(_number: int, _frame: FrameType | None) -> None:
    if _stop is None:
        sys.exit(0)
    _stop()


@contextmanager
def obeyed() -> Iterator[None]:
    """SIGTERM ends the process with exit code 0, by `sys.exit` until `calls` knows better.

    For the main thread. Afterwards it is ignored: the end has come anyway.
    """
    signal.signal(signal.SIGTERM, _obey)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def calls(stop: Callable[[], object]) -> None:
    """From inside the event loop: SIGTERM and SIGINT call `stop` there."""
    global _stop
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGINT, stop)
    if signal.getsignal(signal.SIGTERM) is not _obey:  # called from a program that has its own ways
        loop.add_signal_handler(signal.SIGTERM, stop)
        return

    def soon() -> None:
        if not loop.is_closed():  # else it stops already
            loop.call_soon_threadsafe(stop)  # wakes the loop where it sleeps

    _stop = soon


def with_code(code: int) -> None:
    """SIGTERM leaves with this exit code instead of 0: what was asked for is not done by then."""
    global _stop
    _stop = partial(sys.exit, code)
