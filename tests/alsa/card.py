"""Builds the virtual capture card (pcm_virtual.c), and holds its controls.

`VirtualCard.play` runs a scenario of scenarios.py in a process of its own: ALSA and PortAudio read their
configuration once, at their start.
"""

from __future__ import annotations

import ctypes.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
ROWS = 65_521  # the ramp's period, a prime: it hides no repetition of blocks
CHANNEL_STEP = 8191  # rows by which one channel's ramp is ahead of the one before


def ramp(channels: int) -> np.ndarray:
    """(ROWS, channels) int16: every sample tells its row and its channel."""
    row = np.arange(ROWS)[:, np.newaxis] + CHANNEL_STEP * np.arange(channels)
    return (row % ROWS - ROWS // 2).astype("<i2")


def row_of(samples: np.ndarray, channel: int) -> np.ndarray:
    """The row numbers, modulo ROWS, of samples of one channel at full scale 1.0."""
    return (np.rint(np.asarray(samples) * 32768).astype(int) + ROWS // 2 - CHANNEL_STEP * channel) % ROWS


class Missing(RuntimeError):
    """Something of the machine's, in words."""


def build(directory: Path) -> Path:
    """The plugin, compiled. Raises `Missing` where what it needs is not there."""
    if ctypes.util.find_library("portaudio") is None:
        raise Missing("PortAudio is not installed (libportaudio2)")
    compiler = shutil.which("cc")
    if compiler is None:
        raise Missing("no C compiler to build the virtual sound card with")
    library = directory / "libasound_module_pcm_virtual.so"
    flags = ["-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-DPIC", "-shared"]
    headers = "#include <alsa/asoundlib.h>\n#include <alsa/pcm_external.h>\n"
    probe = subprocess.run(
        [compiler, "-E", "-x", "c", "-"], input=headers, text=True, capture_output=True, check=False
    )
    if probe.returncode:
        raise Missing("ALSA's headers are not installed (libasound2-dev)")
    subprocess.run([compiler, *flags, "-o", library, HERE / "pcm_virtual.c", "-lasound"], check=True)
    return library


def packed(rows: np.ndarray, sample: str) -> bytes:
    """Rows at full scale 1.0 as a card gives them that has this ALSA format."""
    if sample == "FLOAT_LE":
        return rows.astype("<f4").tobytes()
    bits = {"S16_LE": 16, "S24_3LE": 24, "S32_LE": 32}[sample]
    whole = np.rint(rows * 2.0 ** (bits - 1)).clip(-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1)
    if sample == "S24_3LE":
        return whole.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    return whole.astype(f"<i{bits // 8}").tobytes()


class VirtualCard:
    """A card that plays `rows` (n, channels), full scale 1.0, round and round, on a configuration of its own.

    `more`: lines for that configuration, as other devices on top of this one.
    """

    def __init__(
        self,
        library: Path,
        directory: Path,
        name: str = "array4",
        rate_hz: int = 10_000,
        sample: str = "S16_LE",
        rows: np.ndarray | None = None,
        more: str = "",
    ) -> None:
        self.directory = directory
        self.rate_hz = rate_hz
        rows = ramp(4) / 32768 if rows is None else rows
        (directory / "rows").write_bytes(packed(rows, sample))
        (directory / "control").write_bytes(bytes(4096))
        (directory / "asound.conf").write_text(
            "</usr/share/alsa/alsa.conf>\n"
            f'pcm_type.virtual {{ lib "{library}" }}\n'
            f'pcm.{name} {{ type virtual file "{directory}/rows" control "{directory}/control" '
            f"channels {rows.shape[1]} rate {rate_hz} format {sample} }}\n{more}\n",
            encoding="utf-8",
        )

    def play(self, scenario: str, stall_s: float = 0.3, **audio: object) -> dict:
        """What the scenario found, run with these settings of [audio]."""
        table = {
            "audio": {
                "source": "alsa", "device": "array", "device_rate_hz": self.rate_hz, "device_channels": 4,
                "channel_map": [2, 0, 3], **audio,
            },
            "daemon": {"stall_s": stall_s},
        }  # fmt: skip
        child = subprocess.run(
            [sys.executable, "-W", "error", HERE / "scenarios.py", scenario],
            input=json.dumps({"table": table, "control": str(self.directory / "control")}),
            env=os.environ | {"ALSA_CONFIG_PATH": str(self.directory / "asound.conf")},
            text=True, capture_output=True, timeout=60, check=False,
        )  # fmt: skip
        assert child.returncode == 0, child.stderr
        return json.loads(child.stdout)


MAP = (2, 0, 3)


def rows_of(frame: dict, channels: tuple[int, ...] = MAP) -> np.ndarray:
    """(n,) row numbers, which must agree between the microphones."""
    rows = np.stack([row_of(s, channel) for s, channel in zip(frame["samples"], channels, strict=True)])
    assert (rows == rows[0]).all()
    return rows[0]


def assert_whole(frame: dict) -> None:
    """Every row once and in order."""
    assert (np.diff(rows_of(frame)) % ROWS == 1).all()
