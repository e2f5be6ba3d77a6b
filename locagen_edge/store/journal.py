"""A log of JSON lines in a folder, in parts of a bounded size, the oldest part gone for a new one.

All parts together never hold more than they may, whatever the records. A start goes on in the last part where
it has room, on a new line: what a loss of power tore stays torn alone.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from locagen_edge.errors import StorageError
from locagen_edge.jsonl import Record, encode, read
from locagen_edge.store.folder import groups, make_room, size_of, sync

FILES = re.compile(r"(log-\d{6,})\.jsonl")


class Journal:
    """Appends. Each method raises `OSError` where the disk is full or gone; a later call tries anew."""

    def __init__(self, directory: Path, total_bytes: int, part_bytes: int) -> None:
        self._directory = directory
        self._total = total_bytes
        self._part = part_bytes
        self._file: BinaryIO | None = None
        self._name = ""
        self._size = 0
        self._torn = False  # whether the part ends in half a record
        self._others = 0  # bytes of all parts but this one

    def append(self, record: Record) -> bool:
        """Writes one record, to the operating system at once. False: it is larger than all of the log."""
        line = encode(record)
        if len(line) >= self._total:  # a torn line before it needs one byte more
            return False
        try:
            if self._file is None:
                self._reopen()
            if self._size and self._size + len(line) >= self._part:
                self._begin(int(self._name.split("-")[1]) + 1)
            most = self._total - self._size - len(line) - self._torn
            if self._others > most:
                self._others = make_room(self._directory, FILES, most, keep=self._name)
            assert self._file is not None
            if self._torn:
                line = b"\n" + line
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            self.abandon()
            raise
        self._size += len(line)
        self._torn = False
        return True

    def sync(self) -> None:
        """What was appended outlives a loss of power."""
        if self._file is not None:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        try:
            self.sync()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Closes the part as it is; the next record opens it anew."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _reopen(self) -> None:
        self._directory.mkdir(parents=True, exist_ok=True)
        names = list(groups(self._directory, FILES))
        self._begin(int(names[-1].split("-")[1]) if names else 1)

    def _begin(self, number: int) -> None:
        """Opens the part of this number: unbuffered, so that each record is one write of the system."""
        if self._file is not None:
            self.close()
        self._name = f"log-{number:06d}"
        path = self._directory / f"{self._name}.jsonl"
        self._file = path.open("ab", buffering=0)
        self._size = path.stat().st_size
        self._torn = self._size > 0 and not self._ends_whole()
        self._others = make_room(self._directory, FILES, self._total, keep=self._name)
        sync(self._directory)

    def _ends_whole(self) -> bool:
        with (self._directory / f"{self._name}.jsonl").open("rb") as file:
            file.seek(-1, os.SEEK_END)
            return file.read(1) == b"\n"


def records(directory: Path) -> Iterator[Record]:
    """All whole records of a log, oldest first, also while it is being written.

    Raises `OSError`, and `StorageError` for a folder without a log.
    """
    parts = groups(directory, FILES)
    if not parts:
        raise StorageError(f"{directory}: there is no log (log-*.jsonl) in this folder")
    for paths in parts.values():
        try:
            yield from read(paths[0])
        except FileNotFoundError:  # given up for a new one meanwhile
            continue


def size(directory: Path) -> int:
    """Bytes of all parts. Raises `OSError`."""
    return sum(size_of(paths) for paths in groups(directory, FILES).values())
