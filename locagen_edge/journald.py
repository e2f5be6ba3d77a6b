"""Log lines as the reader wants them: with a letter for people, with a level for systemd's journal.

The journal takes the level from a prefix `<3>` at the beginning of each line (sd-daemon(3)); `journalctl -p
warning` then shows what matters. Whether stderr is the journal is told by JOURNAL_STREAM (systemd.exec(5)).
"""

from __future__ import annotations

import logging
import os
from typing import TextIO

LEVELS = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""ours from here on, syslog's; below: 7, debug"""


class _WithLevel(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        """Every line of it: a traceback has many, and each is an entry of its own."""
        level = next((theirs for ours, theirs in LEVELS if record.levelno >= ours), 7)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


def formatter(stream: TextIO) -> logging.Formatter:
    """The formatter for a log on `stream`."""
    if _is_journal(stream):
        return _WithLevel("%(message)s")
    return logging.Formatter("%(levelname).1s %(message)s")


def _is_journal(stream: TextIO) -> bool:
    """JOURNAL_STREAM is DEVICE:INODE of the stream; a child whose stderr goes elsewhere inherits it too."""
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"
