"""A real sound server (PulseAudio) of the test's own, with virtual arrays: null sinks and their monitors.

It has its own folders and socket, touches no other server, opens no device, and ends with the test. What is
played into a sink comes out of its monitor sample by sample, in real time by the server's clock.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import threading
import time
from pathlib import Path

import pytest

RATE = 48_000
ARRAYS = {
    "array3": "front-left,front-right,aux0",
    "array4": "front-left,front-right,rear-left,rear-right",
}
"""Sinks and their channels by the names that ALSA's plugin gives to so many: a server that finds other names
mixes, and where none fits it gives silence."""


def needed() -> None:
    """Skips the test where PulseAudio, its tools or ALSA's plugin for it are missing."""
    for program in ("pulseaudio", "pacat"):
        if shutil.which(program) is None:
            pytest.skip("no PulseAudio (pulseaudio, pulseaudio-utils)")
    if not list(Path("/usr/lib").glob("*/alsa-lib/libasound_module_pcm_pulse.so")):
        pytest.skip("ALSA has no plugin for PulseAudio (libasound2-plugins)")


class SoundServer:
    """Started by `start`, killed by `kill`, as often as you like."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._socket = directory / "native"
        self._running: list[subprocess.Popen[bytes]] = []

    def alsa(self) -> str:
        """The lines of asound.conf that make its monitors ALSA devices, by the sinks' names."""
        at = f'type pulse server "unix:{self._socket}"'
        return "\n".join(f'pcm.{name} {{ {at} device "{name}.monitor" }}' for name in ARRAYS)

    def start(self) -> None:
        """The server, and into each sink the file `rows` of this folder, round and round."""
        for name in ("run", "state", "config"):
            (self.directory / name).mkdir(exist_ok=True, mode=0o700)
        self._socket.unlink(missing_ok=True)
        script = []
        for name, places in ARRAYS.items():
            script += [
                f"load-module module-null-sink sink_name={name} rate={RATE} format=s16le "
                f"channels={places.count(',') + 1} channel_map={places}"
            ]
        # last: where its socket is, all the rest is
        script += [f"load-module module-native-protocol-unix socket={self._socket} auth-anonymous=1"]
        path = self.directory / "server.pa"
        path.write_text("\n".join(script) + "\n", encoding="utf-8")
        options = "-n --daemonize=no --exit-idle-time=-1 --use-pid-file=no --disable-shm=yes --realtime=no"
        self._begin(
            "pulseaudio", *options.split(), "--high-priority=no", "--log-level=error", "-F", str(path)
        )
        until = time.monotonic() + 20.0
        while not self._socket.exists() and time.monotonic() < until:
            time.sleep(0.01)
        for name, places in ARRAYS.items():
            n = places.count(",") + 1
            player = self._begin(
                "pacat", "--playback", "--raw", f"--server=unix:{self._socket}", f"--device={name}",
                f"--rate={RATE}", "--format=s16le", f"--channels={n}", f"--channel-map={places}",
                "--latency-msec=50",  # else the sink, and its monitor, go by steps of two seconds
            )  # fmt: skip
            sound = (self.directory / f"rows{n}").read_bytes()
            threading.Thread(target=_play, args=(player, sound), daemon=True).start()

    def kill(self) -> None:
        """As a crash: nobody is told anything."""
        for process in self._running:
            process.kill()
        for process in self._running:
            process.wait()
        self._running.clear()

    def _begin(self, *command: str) -> subprocess.Popen[bytes]:
        folder = self.directory
        own = {
            "HOME": folder, "XDG_RUNTIME_DIR": folder / "run", "PULSE_RUNTIME_PATH": folder / "run",
            "PULSE_STATE_PATH": folder / "state", "XDG_CONFIG_HOME": folder / "config",
            "DBUS_SESSION_BUS_ADDRESS": "unix:path=/nowhere", "DBUS_SYSTEM_BUS_ADDRESS": "unix:path=/nowhere",
        }  # fmt: skip
        process = subprocess.Popen(
            ("setpriv", "--pdeathsig", "KILL", *command),  # however the test ends
            env=os.environ | {key: str(value) for key, value in own.items()},
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._running.append(process)
        return process


def _play(player: subprocess.Popen[bytes], sound: bytes) -> None:
    assert player.stdin is not None
    with contextlib.suppress(OSError, ValueError):  # the player has gone
        while True:
            player.stdin.write(sound)
