"""JSON lines that outlive a loss of power: one record a line, and a reader that bears a torn one.

A line is written whole or its end is missing, so a torn one is the last of its file, or stands before a start
of the program that went on behind it. It holds no newline of its own (JSON writes one as \\n).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Record = dict[str, Any]


def encode(record: Record) -> bytes:
    """One line with its newline, in ASCII. Raises `ValueError` for a number that JSON has no word for."""
    return json.dumps(record, separators=(",", ":"), allow_nan=False).encode("ascii") + b"\n"


def read(path: Path) -> Iterator[Record]:
    """The whole records of a file, in order; what is torn is passed over. Raises `OSError`."""
    with path.open("rb") as file:
        for line in file:
            try:
                record = json.loads(line)
            except ValueError:  # torn JSON, or bytes that are no text
                continue
            if line.endswith(b"\n") and isinstance(record, dict):
                yield record
