"""A finished WAV as FLAC of 24 bits, which holds half as much and every player of sound knows.

Sound is written as WAV, which outlives a loss of power at any moment (`store/wav.py`), and packed when it is
whole. 24 bits are 138 dB below full scale: more than any microphone has.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from locagen_edge.store.folder import sync

MOST_CHANNELS = 8
"""of FLAC (RFC 9639, section 9.1.3)"""
_TEMPORARY = ".packing.flac"


def pack(path: Path) -> Path:
    """Puts a FLAC in the place of a WAV, whole or not at all; what cannot be packed stays. The file there is.

    Raises `OSError` where the disk is full or gone.
    """
    import soundfile  # libsndfile is loaded where it is used

    temporary = path.with_name(_TEMPORARY)
    try:
        rows, rate_hz = soundfile.read(path, dtype="float32", always_2d=True)
        if rows.shape[1] > MOST_CHANNELS:
            return path
        soundfile.write(temporary, rows, rate_hz, format="FLAC", subtype="PCM_24")
    except soundfile.LibsndfileError as error:  # a full disk among them, without its number
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise OSError(0, error.error_string, str(path)) from error
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    final = path.with_suffix(".flac")
    os.replace(temporary, final)
    sync(path.parent)
    path.unlink()
    return final
