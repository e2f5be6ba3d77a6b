"""A part of a recording: three files of one name, a time and a number.

- `.wav`: the channels as captured, at the device's rate (`store/wav.py`);
- `.blocks.jsonl`: one record `part` (session, number of its first row in it, UTC and monotonic time of its
  beginning), then one `block` for each piece that came (rows; `origin_ns`, what the card's clock then said of
  the first row since the last loss), and `gap` where sound was lost. With these `replay` gives the same
  frames with the same times as the live run, bit for bit. Others, as a vehicle's pose, may stand between;
- `.toml`: the settings of that day.

While it grows its names end in `.part`, and a lock says that it is being written. What a loss of power or a
kill leaves behind, `recover` finishes.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from locagen_edge.errors import StorageError
from locagen_edge.jsonl import encode
from locagen_edge.settings import Settings, sample
from locagen_edge.store.folder import PART, finish, groups, make_room, sync
from locagen_edge.store.wav import LONGEST, WavWriter, mend
from locagen_edge.types import Array

log = logging.getLogger(__name__)

FILES = re.compile(r"(\d{8}T\d{6}Z-\d{4,})\.(?:flac|(?:wav|blocks\.jsonl|toml)(?:\.part)?)")
"""the sound of a call is packed when it is whole (`store/flac.py`)"""
BLOCKS = ".blocks.jsonl"


@dataclass(frozen=True, eq=False)
class Block:
    """Rows as a source delivered them (`framing.Tap`)."""

    rows: Array
    rate_hz: float
    origin_ns: int
    gap: int | None
    """overruns before it; 0: nothing was lost, but it begins anew; None: it follows on the one before"""

    @property
    def lines(self) -> bytes:
        """Its records."""
        gap = b"" if self.gap is None else encode({"type": "gap", "overruns": self.gap})
        return gap + encode({"type": "block", "rows": len(self.rows), "origin_ns": self.origin_ns})

    @property
    def size(self) -> int:
        """bytes on disk"""
        return self.rows.nbytes + len(self.lines)


@dataclass
class Session:
    """What goes on from part to part."""

    utc: datetime
    """when it began"""
    number: int = 0
    """of the part that was begun last"""
    row: int = 0
    """number of the next row"""
    name: str = field(default_factory=lambda: str(uuid.uuid4()))

    @classmethod
    def begin(cls, directory: Path, utc: datetime) -> Session:
        """Numbers go on behind what has the same time: a clock that is set back overwrites nothing."""
        stamp = _stamp(utc)
        old = (int(name.split("-")[1]) for name in groups(directory, FILES) if name.startswith(stamp))
        return cls(utc, max(old, default=0))


def _stamp(utc: datetime) -> str:
    return utc.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")


class Bound:
    """Keeps a folder of parts, with the one that is being written, under so many bytes."""

    def __init__(self, directory: Path, most: int, *, give_up_oldest: bool) -> None:
        self.others = 0
        """bytes of all parts but the one that is being written; set anew by `count`"""
        self._directory, self._most, self._give_up_oldest = directory, most - BEGINNING, give_up_oldest

    def count(self, keep: str = "") -> None:
        self.others = make_room(self._directory, FILES, NO_BOUND, keep)

    def room_for(self, part: Part, size: int) -> bool:
        """Whether the part may grow by so much, if need be at the cost of the oldest."""
        most = self._most - part.size - size
        if self.others > most and self._give_up_oldest:
            self.others = make_room(self._directory, FILES, most, part.name)
        return self.others <= most

    def give_up(self, size: int, keep: str) -> None:
        """Deletes the oldest, so much of it or a little more, where that is allowed."""
        if self._give_up_oldest:
            self.others = make_room(self._directory, FILES, max(self.others - size, 0), keep)


NO_BOUND = 2**63
BEGINNING = 20_000
"""bytes that a part has before its first row, settings and all: no more than these"""


class Part:
    """The three files of one part. Methods raise `OSError`."""

    def __init__(
        self, directory: Path, session: Session, first: Block, part_bytes: int, settings: Settings
    ) -> None:
        session.number += 1
        self.name = f"{_stamp(session.utc)}-{session.number:04d}"
        self._session = session
        self._first = first
        self._most = min(part_bytes, LONGEST)
        self._paths = [directory / f"{self.name}{suffix}{PART}" for suffix in (".wav", BLOCKS, ".toml")]
        # first: its lock says that the rest is not forsaken
        self._lines: BinaryIO = self._paths[1].open("xb")
        try:
            _lock(self._lines)
            with self._paths[2].open("wb") as file:
                self._beside = file.write(self._settings_text(settings))
                file.flush()
                os.fsync(file.fileno())
            sample_type = str(first.rows.dtype)
            self._sound = WavWriter(self._paths[0], round(first.rate_hz), first.rows.shape[1], sample_type)
            self.line(self._first_record())
            self.sync()  # a part without its record would seem to be of another session
            sync(directory)
        except OSError:
            with suppress(OSError):
                self._lines.close()
            raise

    def _settings_text(self, settings: Settings) -> bytes:
        return f"# As it was when {self.name} was recorded.\n{sample(settings)}".encode()

    def _first_record(self) -> bytes:
        return encode(
            {
                "type": "part",
                "session": self._session.name,
                "row": self._session.row,
                "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "t_ns": time.monotonic_ns(),
                "rate_hz": self._first.rate_hz,
                "channels": self._first.rows.shape[1],
                "sample": str(self._first.rows.dtype),
            }
        )

    @property
    def size(self) -> int:
        """bytes"""
        return self._sound.size + self._beside

    def takes(self, block: Block, most_s: float) -> bool:
        """Whether this block belongs here: the same form, and the part is not too large with it."""
        a, b = self._first, block
        same = (a.rate_hz, a.rows.shape[1], a.rows.dtype) == (b.rate_hz, b.rows.shape[1], b.rows.dtype)
        longest = round(most_s * a.rate_hz)
        return same and self.size + b.size <= self._most and self._sound.rows + len(b.rows) <= longest

    def write(self, block: Block) -> None:
        self.line(block.lines)
        self._sound.write(block.rows)
        self._session.row += len(block.rows)

    def line(self, line: bytes) -> None:
        """One record more beside the sound."""
        self._lines.write(line)
        self._beside += len(line)

    def sync(self) -> None:
        """All is on the disk, and the header says so."""
        self._lines.flush()
        os.fsync(self._lines.fileno())
        self._sound.sync()

    def close(self) -> None:
        """Whole, and under its final name; under its temporary one where anything is raised."""
        try:
            self.sync()
            self._sound.close()
            for path in reversed(self._paths):  # the sound comes last: where it is, the rest is
                finish(path)
        finally:
            self._sound.abandon()
            with suppress(OSError):
                self._lines.close()


def _lock(file: BinaryIO) -> bool:
    """Marks a file as being written, until it is closed or the process ends. False: another process has."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def recover(directory: Path) -> list[Path]:
    """Finishes what a kill or a loss of power left under temporary names; the recordings that were mended.

    What another process is writing now is left alone. Raises `StorageError`.
    """
    mended = []
    try:
        for name, paths in groups(directory, FILES).items():
            left = [path for path in paths if path.name.endswith(PART)]
            if left and not _is_being_written([path for path in paths if BLOCKS in path.name]):
                mended += _mend(directory / f"{name}.wav", left)
    except OSError as error:
        raise StorageError(f"{error.filename or directory}: {error.strerror}") from error
    return mended


def _is_being_written(paths: list[Path]) -> bool:
    for path in paths:
        try:
            with path.open("rb") as file:
                if not _lock(file):
                    return True
        except FileNotFoundError:  # it was just finished
            return True
    return False


def _mend(final: Path, left: list[Path]) -> list[Path]:
    """Mends and renames one part's files; its sound where there is any. Raises `OSError`."""
    sound = final.with_name(final.name + PART)
    rows = 0
    if sound in left:
        try:
            rows = mend(sound)
        except ValueError as error:
            log.warning("%s: %s: left as %s.damaged", final, error, final.name)
            sound = sound.rename(final.with_name(f"{final.name}.damaged"))
        else:
            if not rows:  # nothing had come yet
                for path in left:
                    path.unlink(missing_ok=True)
                return []
    for path in sorted(left, key=lambda p: p == sound):
        if path.exists():
            finish(path)
    if not rows:
        return []
    log.warning("%s: was not finished: mended, %d rows are there", final, rows)
    return [final]
