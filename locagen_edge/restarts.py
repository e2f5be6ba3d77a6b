"""Restarts in a row are put off, longer and longer: who cannot run leaves the board to others.

systemd does this itself (RestartSteps=) from version 254 on, and complains of it before; Debian 12 has 252.
So the unit restarts at once, and the program waits here, before it opens anything: not at all the first time,
since a crash in flight is no reason to be deaf, then 1, 2, 4 .. 30 s. A run of a minute, or a clean end,
counts as well again.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

FIRST_S = 1.0
LONGEST_S = 30.0
"""well below the unit's TimeoutStartSec"""
STEADY_S = 60.0
"""A run that lasted for so long was none of a row of failures."""
FILE = "restarts"


def put_off_s(directory: Path, now_s: float) -> float:
    """Seconds that this start should wait, by the starts noted in `directory`; notes this one.

    `now_s` is the system's monotonic time, which all starts since boot share. A note that is damaged, or
    cannot be written, puts nothing off: better too many starts than none.
    """
    note = directory / FILE
    failed = 0
    with contextlib.suppress(OSError, ValueError):
        count, started_s = note.read_text(encoding="ascii").split()
        if 0.0 <= now_s - float(started_s) < STEADY_S:
            failed = int(count) + 1
    wait_s = min(FIRST_S * 2.0 ** min(failed - 2, 10), LONGEST_S) if failed > 1 else 0.0
    with contextlib.suppress(OSError):
        note.write_text(f"{failed} {now_s + wait_s}\n", encoding="ascii")
    return wait_s


def forget(directory: Path) -> None:
    """After a clean end: the next start is the first of its kind."""
    with contextlib.suppress(OSError):
        (directory / FILE).unlink()
