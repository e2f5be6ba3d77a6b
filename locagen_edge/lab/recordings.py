"""Recorded sounds for the twin: every sound file of a folder, mono, at the rate of the scene."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np
import soundfile
import soxr

from locagen_edge.errors import DatasetError
from locagen_edge.types import F32

ENDINGS = (".wav", ".flac", ".ogg")


@lru_cache(maxsize=2)  # a worker makes one shard after another from the same folder
def load(folder: str, rate_hz: int) -> tuple[tuple[str, F32], ...]:
    """(name, (n,)) of all sound files below a folder, in the order of their names.

    Channels are averaged. Raises `DatasetError` where there is none, or one cannot be read.
    """
    files = sorted(p for p in Path(folder).rglob("*") if p.suffix.lower() in ENDINGS)
    if not files:
        raise DatasetError(f"{folder}: holds no {', '.join(ENDINGS)} file")
    sounds = []
    for file in files:
        mono = read_sound(file, rate_hz)
        if mono.any():  # a file of zeros cannot call
            sounds.append((file.relative_to(folder).as_posix(), mono))
    if not sounds:
        raise DatasetError(f"{folder}: holds nothing but silence")
    return tuple(sounds)


def read_sound(file: Path, rate_hz: int) -> F32:
    """(n,) mean of the channels. Raises `DatasetError` where it cannot be read."""
    try:
        sound, file_hz = soundfile.read(file, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, OSError) as error:
        raise DatasetError(f"{file}: cannot be read: {error}") from error
    mono = np.nan_to_num(sound, posinf=0.0, neginf=0.0).mean(axis=1)
    return np.asarray(soxr.resample(mono, file_hz, rate_hz), dtype=np.float32)


def fingerprint(folder: str, rate_hz: int) -> str:
    """SHA-256 of names and sounds, so that two data sets from different files are told apart."""
    digest = hashlib.sha256()
    for name, sound in load(folder, rate_hz):
        digest.update(f"{name}\0{len(sound)}\0".encode())
        digest.update(sound.tobytes())
    return digest.hexdigest()
