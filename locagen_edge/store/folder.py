"""Folders that never hold more than they may: files told by a pattern, the oldest gone first.

Names begin with a time or a number, so that the order of names is that of age; a clock that was set back
makes files seem older than they are, never lost track of. What does not fit the pattern is somebody else's:
it is neither counted nor touched.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from locagen_edge.errors import StorageError

PART = ".part"
"""ends the name of a file that is still being written"""


def prepare(directory: Path) -> None:
    """Makes the folder where it is not there. Raises `StorageError` where nothing can be written into it."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe = directory / f".{os.getpid()}{PART}"
        try:
            probe.touch()
        finally:
            probe.unlink(missing_ok=True)
    except FileExistsError as error:
        raise StorageError(f"{directory}: is a file, not a folder") from error
    except OSError as error:
        raise StorageError(f"{directory}: cannot be written to: {error.strerror}") from error


def groups(directory: Path, pattern: re.Pattern[str]) -> dict[str, list[Path]]:
    """Files whose names fit, by the first group of the pattern, oldest first. Raises `OSError`."""
    found: dict[str, list[Path]] = {}
    for path in directory.iterdir():
        match = pattern.fullmatch(path.name)
        if match:
            found.setdefault(match[1], []).append(path)
    return dict(sorted(found.items()))


def size_of(paths: list[Path]) -> int:
    """Bytes; a file that has gone meanwhile has none."""
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size
        except FileNotFoundError:
            continue
    return total


def make_room(directory: Path, pattern: re.Pattern[str], most: int, keep: str = "") -> int:
    """Deletes the oldest groups until all together, without the group `keep`, are `most` bytes or less.

    A group with a file still being written stays. Returns the bytes that are left. Raises `OSError`.
    """
    sizes = {}
    old = groups(directory, pattern)
    old.pop(keep, None)
    for name, paths in old.items():
        sizes[name] = size_of(paths)
    left = sum(sizes.values())
    for name, paths in old.items():
        if left <= most:
            break
        if any(path.name.endswith(PART) for path in paths):
            continue
        for path in paths:
            path.unlink(missing_ok=True)
        left -= sizes[name]
    return left


def free_bytes(directory: Path) -> int:
    """What may still be written to the disk below, by users that are not root. Raises `OSError`."""
    return shutil.disk_usage(directory).free


def finish(path: Path) -> Path:
    """Takes the `.part` from a file's name: it is whole now. Raises `OSError`."""
    final = path.with_name(path.name.removesuffix(PART))
    os.replace(path, final)
    sync(path.parent)
    return final


def sync(directory: Path) -> None:
    """New names outlive a loss of power from here on. Raises `OSError`."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
