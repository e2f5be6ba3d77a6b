"""What the process asks of the C library about memory."""

from __future__ import annotations

import ctypes
from contextlib import suppress

M_ARENA_MAX = -8
"""<malloc.h>"""


def one_arena() -> None:
    """All threads share one heap: call it before the first of them starts.

    glibc otherwise gives the pipeline's thread a heap of its own, in which loading a model leaves 9 MB that
    nobody uses again. Other C libraries have no arenas, and nothing happens.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)
