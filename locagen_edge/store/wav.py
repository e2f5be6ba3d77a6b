"""A WAV file that is valid at every moment after its first `sync`, and mended after the last.

Why not libsndfile: it writes the header's lengths when the file is closed, which a loss of power prevents.
Here `sync` writes them beside the samples, and `mend` sets them by the file's length where it never came to
that.

Form: RIFF (IBM and Microsoft 1991) with WAVE_FORMAT_EXTENSIBLE and no speaker positions (Microsoft, "Multiple
channel audio data and WAVE files", 2001), int16 or float32. 32-bit lengths: a file has to end below 4 GiB.
"""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np

from locagen_edge.types import Array

HEADER = struct.Struct("<4sI4s 4sIHHIIHHHHI16s 4sII 4sI")
LONGEST = 2**32 - 1 - HEADER.size
"""bytes of samples that a header can promise"""
_GUID_TAIL = bytes.fromhex("000000001000800000aa00389b71")
_TAGS = {"int16": 1, "float32": 3}  # WAVE_FORMAT_PCM, WAVE_FORMAT_IEEE_FLOAT


def header(rate_hz: int, channels: int, sample: str, rows: int) -> bytes:
    """The bytes before the first sample. `sample`: int16 or float32."""
    width = np.dtype(sample).itemsize
    align = width * channels
    data = rows * align
    return HEADER.pack(
        b"RIFF", HEADER.size - 8 + data, b"WAVE",
        b"fmt ", 40, 0xFFFE, channels, rate_hz, rate_hz * align, align, 8 * width,
        22, 8 * width, 0, struct.pack("<H", _TAGS[sample]) + _GUID_TAIL,
        b"fact", 4, rows,
        b"data", data,
    )  # fmt: skip


class WavWriter:
    """Writes a new file. Each method raises `OSError` where the disk is full or gone."""

    def __init__(self, path: Path, rate_hz: int, channels: int, sample: str) -> None:
        self._form = (rate_hz, channels, sample)
        self._align = np.dtype(sample).itemsize * channels
        self.rows = 0
        self._file = path.open("xb")
        self._file.write(header(*self._form, 0))

    @property
    def size(self) -> int:
        """bytes"""
        return HEADER.size + self.rows * self._align

    def write(self, rows: Array) -> None:
        """Rows (n, channels) of the sample type that the file was made for."""
        _, channels, sample = self._form
        if rows.dtype != sample or rows.shape[1] != channels:
            raise ValueError(f"rows of {rows.shape[1]} {rows.dtype} in a file of {channels} {sample}")
        self._file.write(np.ascontiguousarray(rows.astype(rows.dtype.newbyteorder("<"), copy=False)).data)
        self.rows += len(rows)

    def sync(self) -> None:
        """What was written is on the disk, and the header says so."""
        self._file.flush()
        os.pwrite(self._file.fileno(), header(*self._form, self.rows), 0)
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """All is on the disk, and the file is closed; `abandon` it where this raises."""
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        """Closes the file as it is; nothing happens where it is closed."""
        with suppress(OSError):  # what could not be flushed: closed all the same
            self._file.close()


def mend(path: Path) -> int:
    """Sets a header by the file's length, and cuts off a row that is not whole. Rows that are left.

    Raises `OSError`, and `ValueError` where there are bytes but not behind a header of ours.
    """
    with path.open("r+b") as file:
        first = file.read(HEADER.size)
        if len(first) < HEADER.size:
            return 0
        rate_hz, channels, align, sample = _form_of(first)
        rows = (os.fstat(file.fileno()).st_size - HEADER.size) // align
        file.truncate(HEADER.size + rows * align)
        file.seek(0)
        file.write(header(rate_hz, channels, sample, rows))
        file.flush()
        os.fsync(file.fileno())
    return rows


def _form_of(first: bytes) -> tuple[int, int, int, str]:
    fields = HEADER.unpack(first)
    channels, rate_hz, align, rows = fields[6], fields[7], fields[9], fields[-3]
    for sample in _TAGS:
        with suppress(struct.error):  # numbers that no header holds
            if align and first == header(rate_hz, channels, sample, rows):
                return rate_hz, channels, align, sample
    raise ValueError("its header is damaged")
