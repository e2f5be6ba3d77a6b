"""The whole daemon as it runs on the board: CPU, memory, threads, files, delay and growth.

    python bench/bench_daemon.py [--quick] [--frames N] [--output FILE]

The real process, `locagen-edge run`, hears a scene in real time: a recording of 48 kHz and 16 bit, rendered
beforehand, resampled by the daemon, so that the synthesis costs it nothing. Chains:

    paper    GCC-PHAT and a plane wave's least squares (bearing.estimator = "far-field")
    steered  the default
    card     the default, and the sound comes from a sound card (a virtual one, through ALSA and PortAudio)
    mask     the default with the network that says which frequencies are the caller's

and, in the same run, `plain_daemon.py`: numpy and mavutil, as most people would write it.

CPU is the process's own time (user and system, without its start) over the wall's. PSS is what
/proc/PID/smaps_rollup says at the end. Delay is from a frame's last sample to the datagram on the loopback,
as the kernel has stamped it; the resampler's wait is in it for `card` only, a recording is read ahead. There
the daemon sends every frame's bearing (mavlink.rate_hz = 20). Growth:
frames go through pipeline and MAVLink component in this process as fast as they can; slope of its resident
memory over the second half. `nothing` is what as many wake-ups cost without any work: a loop of asyncio that
hands an empty job to a thread at every hop. The process runs in an empty folder with a home of its own: what
is there afterwards beyond the state directory is listed, and, where strace is installed, every file that was
opened for writing.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import report
import soundfile
from pymavlink import mavutil

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.framer import Framer
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import from_table
from locagen_edge.sim.scene import Scene, frames

sys.path.insert(0, str(report.ROOT / "tests"))
from alsa import card

CHAINS: dict[str, dict[str, Any]] = {
    "paper": {"bearing": {"estimator": "far-field"}},
    "steered": {},
    "card": {"audio": {"source": "alsa", "device": "array3", "device_channels": 3}},
    "mask": {"denoise": {"kind": "mask"}},
}
GOALS: dict[str, dict[str, float]] = {
    "paper": {"cpu_percent": 1.0, "pss_mib": 75.0, "first_bearing_s": 1.5},
    "steered": {"first_bearing_s": 1.5},
    "mask": {"cpu_percent": 4.0, "pss_mib": 75.0},
}
DELAY_GOAL_MS = {"median": 2.0, "p99": 5.0}
RATE_HZ = 48_000
QUIET_S = {"paper": 0.3, "steered": 0.85, "card": 0.85, "mask": 0.85}
"""Noise before the first call: the steered estimator has to have heard the rotors before it hears anybody."""
WINDOW_S = 5.0
"""CPU is told of the least busy and the middling one of such windows: a machine has other things to do."""
NOTHING = """
import asyncio, concurrent.futures
async def main():
    executor, loop = concurrent.futures.ThreadPoolExecutor(1), asyncio.get_running_loop()
    while True:
        await asyncio.sleep(0.0512)
        await loop.run_in_executor(executor, int)
asyncio.run(main())
"""
SO_TIMESTAMPNS = 35
"""Linux, <asm-generic/socket.h>: not in Python's socket module"""


@dataclass(frozen=True)
class Times:
    """How long, in seconds."""

    warm: float
    """before a process is measured"""
    measure: float
    trace: float
    listen: float
    """to what a process sends, from its start"""
    starts: int
    """how often it is started to be listened to"""


FULL, QUICK = Times(5.0, 45.0, 6.0, 10.0, 4), Times(1.5, 1.0, 2.5, 3.5, 1)


# --- the scene ----------------------------------------------------------------------------------------


def render(path: Path, seconds: float, quiet_s: float) -> None:
    """The default scene at the card's rate, 16 bit; nobody calls for `quiet_s`."""
    scene = Scene(from_table({"audio": {"rate_hz": RATE_HZ, "frame": 4096, "hop": 2048}}))
    quiet = round(quiet_s * RATE_HZ)
    n = round(seconds * RATE_HZ)
    held = np.zeros((3, quiet), dtype=np.float32)
    with soundfile.SoundFile(path, "w", RATE_HZ, 3, "PCM_16") as file:
        for first in range(0, n, RATE_HZ):
            call, *others = scene.parts(min(RATE_HZ, n - first))
            late = np.concatenate([held, call], axis=1)
            held = late[:, call.shape[1] :]
            file.write((late[:, : call.shape[1]] + sum(others)).T)


def card_of(sound: Path, folder: Path) -> dict[str, str]:
    """The environment in which ALSA knows a card that plays the sound, from its begin at each opening."""
    folder.mkdir()
    rows, rate_hz = soundfile.read(sound)
    virtual = card.VirtualCard(card.build(folder), folder, name="array3", rate_hz=rate_hz, rows=rows)
    return {"ALSA_CONFIG_PATH": str(virtual.directory / "asound.conf")}


def write_settings(path: Path, sound: Path, port: int, table: dict[str, Any], rate_hz: float) -> None:
    tables = {
        "audio": {"source": "wav", "file": str(sound)},
        "mavlink": {"link": [f"udpout:127.0.0.1:{port}"], "rate_hz": rate_hz},
        **table,
    }
    lines = []
    for name, keys in tables.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {value!r}".replace("'", '"') for key, value in keys.items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


# --- the other end ------------------------------------------------------------------------------------


class Peer:
    """Takes datagrams, each with the kernel's own time of arrival, in monotonic ns."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, bytes]] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.2)
        self.port = int(self._socket.getsockname()[1])
        self._open = True
        self._thread = threading.Thread(target=self._take, daemon=True)
        self._thread.start()

    def _take(self) -> None:
        while self._open:
            with contextlib.suppress(TimeoutError):
                data, ancillary, _, _ = self._socket.recvmsg(2048, 64)
                stamp_ns = time.monotonic_ns()
                for level, kind, value in ancillary:
                    if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS):
                        seconds, ns = struct.unpack("qq", value)
                        stamp_ns += seconds * 1_000_000_000 + ns - time.time_ns()
                self.heard.append((stamp_ns, data))

    def close(self) -> list[tuple[int, bytes]]:
        self._open = False
        self._thread.join()
        self._socket.close()
        return self.heard


@dataclass(frozen=True)
class Heard:
    """What the peer made of it."""

    delays_s: list[float]
    """from the last sample to the datagram, of each bearing"""
    first_ns: int | None
    """when the first bearing came"""


def ours(datagrams: list[tuple[int, bytes]], frame_s: float) -> Heard:
    """Of each bearing, whose first datagram is the value LG_AZB; the record behind it, LOCAGEN_BEARING, has
    the time of the sound's middle."""
    framer, delays, first, begun = Framer(), {}, None, None
    for stamp_ns, data in datagrams:
        for packet in framer.feed(data):
            if packet.message_id == dialect.NAMED_VALUE_FLOAT:
                begun = begun or stamp_ns
            if packet.message_id != dialect.LOCAGEN_BEARING:
                continue
            message = dialect.decode(packet.raw)
            if message.event_id > 0 and begun is not None:
                first = first or begun
                # the first time that this frame is told of: the same may be said again
                delays.setdefault(message.time_usec, (begun * 1e-3 - message.time_usec) * 1e-6 - frame_s / 2)
            begun = None
    return Heard(list(delays.values()), first)


def plain(datagrams: list[tuple[int, bytes]]) -> Heard:
    """Of DEBUG_VECT."""
    parser = mavutil.mavlink.MAVLink(None)
    parser.robust_parsing = True
    delays, first = [], None
    for stamp_ns, data in datagrams:
        for message in parser.parse_buffer(data) or ():
            if message.get_type() == "DEBUG_VECT":
                first = first or stamp_ns
                delays.append((stamp_ns * 1e-3 - message.time_usec) * 1e-6)
    return Heard(delays, first)


# --- a process ----------------------------------------------------------------------------------------


def cpu_s(pid: int) -> float:
    """Time of all threads on a core, user and system."""
    spent = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            spent += int((task / "schedstat").read_text().split()[0])
    return spent * 1e-9


def memory_mib(pid: int) -> dict[str, float]:
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    found = {key: int(kb) / 1024 for key, kb in re.findall(r"^(\w+): +(\d+) kB", text, re.MULTILINE)}
    private = found["Private_Clean"] + found["Private_Dirty"]
    return {"pss_mib": found["Pss"], "rss_mib": found["Rss"], "private_mib": private}


def threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def listing(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if not p.is_dir()}


class Home:
    """A place of its own to run in, with more in its environment if need be: what is written shows."""

    def __init__(self, folder: Path, more: dict[str, str] | None = None) -> None:
        self.folder = folder
        self._more = more or {}
        for name in ("home", "tmp", "state", "work"):
            (folder / name).mkdir(parents=True)

    @property
    def environment(self) -> dict[str, str]:
        kept = {"PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "VIRTUAL_ENV"}
        return {key: value for key, value in os.environ.items() if key in kept} | {
            "HOME": str(self.folder / "home"),
            "TMPDIR": str(self.folder / "tmp"),
            "STATE_DIRECTORY": str(self.folder / "state"),
            "PYTHONPATH": str(report.ROOT),
            "OPENBLAS_NUM_THREADS": "1",  # as in the unit
            "PYTHONDONTWRITEBYTECODE": "1",
            **self._more,
        }

    def start(self, command: list[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            command, cwd=self.folder / "work", env=self.environment, stderr=subprocess.DEVNULL
        )

    @property
    def strays(self) -> list[str]:
        """Files beyond the state directory."""
        return sorted(name for name in listing(self.folder) if not name.startswith("state/"))


def stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def measure(command: list[str], home: Home, times: Times) -> dict[str, Any]:
    """CPU, memory, threads and strays of a process that has run for a while."""
    process = home.start(command)
    try:
        time.sleep(times.warm)
        shares = []
        for _ in range(max(1, round(times.measure / WINDOW_S))):
            before, start = cpu_s(process.pid), time.monotonic()
            time.sleep(min(WINDOW_S, times.measure))
            shares.append(100.0 * (cpu_s(process.pid) - before) / (time.monotonic() - start))
        found = {
            "cpu_percent": float(np.median(shares)),
            "cpu_percent_least": min(shares),
            "load": os.getloadavg()[0],
            **memory_mib(process.pid),
            "threads": threads(process.pid),
        }
    finally:
        stop(process)
    return found | {"files_outside_state": home.strays}


def listen(command: list[str], home: Home, peer: Peer, seconds: float) -> tuple[int, list[tuple[int, bytes]]]:
    """When the process was started, and all it has sent."""
    start_ns = time.monotonic_ns()
    process = home.start(command)
    try:
        time.sleep(seconds)
    finally:
        stop(process)
    return start_ns, peer.close()


def opened_for_writing(command: list[str], home: Home, seconds: float) -> list[str] | None:
    """Every file beyond the state directory that was opened for writing or made; None without strace."""
    if shutil.which("strace") is None:
        return None
    log = home.folder / "strace"
    calls = "trace=open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,link,symlink"
    process = home.start(["strace", "-f", "-qq", "-e", calls, "-o", str(log), *command])
    time.sleep(seconds)
    stop(process)
    text = log.read_text(encoding="utf-8", errors="replace")
    written = set()
    for line in text.splitlines():
        if " = -1 " in line or not (path := re.search(r'"([^"]+)"', line)):
            continue
        changes = not re.search(r"\bopen(at)?\(", line) or re.search(r"O_(WRONLY|RDWR|CREAT)", line)
        if changes and not path[1].startswith((str(home.folder / "state"), "/dev/")):
            written.add(path[1])
    return sorted(written)


def chain(name: str, folder: Path, times: Times) -> dict[str, Any]:
    """All figures of one chain's daemon."""
    sound = folder / f"{name}.wav"
    render(sound, max(times.warm + times.measure, times.listen) + 5.0, QUIET_S[name])
    settings = folder / f"{name}.toml"
    more = card_of(sound, folder / "sound-card") if name == "card" else {}
    command = [sys.executable, "-m", "locagen_edge", "run", "--quiet", "--settings", str(settings)]
    hop = from_table({})
    frame_s = hop.audio.frame / hop.audio.rate_hz

    peer = Peer()  # somebody listens, or each datagram costs an error as well
    write_settings(settings, sound, peer.port, CHAINS[name], 2.0)
    found = measure(command, Home(folder / f"{name}-cpu", more), times)
    found["files_opened_for_writing"] = opened_for_writing(
        command, Home(folder / f"{name}-files", more), times.trace
    )
    peer.close()

    delays, firsts = [], []
    for run in range(times.starts):
        peer = Peer()
        write_settings(settings, sound, peer.port, CHAINS[name], 20.0)
        start_ns, datagrams = listen(command, Home(folder / f"{name}-{run}", more), peer, times.listen)
        heard = ours(datagrams, frame_s)
        delays += heard.delays_s
        if heard.first_ns:
            firsts.append((heard.first_ns - start_ns) * 1e-9)
    found["delay_ms"] = report.summary([1e3 * delay for delay in delays]) | {"bearings": len(delays)}
    found["first_bearing_s"] = float(np.median(firsts)) if firsts else None
    return found


def plain_daemon(folder: Path, times: Times) -> dict[str, Any]:
    """The same of the plain one, on the paper chain's sound."""
    sound = folder / "paper.wav"
    command = [sys.executable, str(report.ROOT / "bench" / "plain_daemon.py"), str(sound)]
    peer = Peer()
    found = measure([*command, f"udpout:127.0.0.1:{peer.port}"], Home(folder / "plain-cpu"), times)
    peer.close()
    peer = Peer()
    address = f"udpout:127.0.0.1:{peer.port}"
    start_ns, datagrams = listen([*command, address], Home(folder / "plain-0"), peer, times.listen)
    heard = plain(datagrams)
    found["delay_ms"] = report.summary([1e3 * delay for delay in heard.delays_s])
    found["first_bearing_s"] = (heard.first_ns - start_ns) * 1e-9 if heard.first_ns else None
    return found


# --- growth -------------------------------------------------------------------------------------------


def growth(total: int) -> dict[str, Any]:
    """Resident memory of the default chain, sound to MAVLink frames, in this process over so many frames."""
    settings = from_table({})
    pipeline, component = Pipeline(settings), Component(settings.mavlink, whole=settings)
    scene = list(islice(frames(settings), min(total, 2000)))
    hop_ns = round(settings.hop_s * 1e9)
    rss: list[tuple[int, float]] = []
    sent, start_s = 0, time.monotonic()
    for n in range(total):  # the scene again and again, time going on
        frame = replace(scene[n % len(scene)], t_ns=n * hop_ns, start=n * settings.audio.hop)
        estimate = pipeline.process(frame)
        status = Status(
            hearing=True,
            track=estimate.track,
            snr_db=estimate.detection.snr_db,
            faults=estimate.faults,
            others=estimate.tracks[1:],
            positions=estimate.positions,
            t_ns=frame.middle_ns,
        )
        sent += len(component.due(frame.t_ns * 1e-9, status))
        if n % max(total // 100, 1) == 0:
            rss.append((n, memory_mib(os.getpid())["rss_mib"]))
    late = np.array(rss[len(rss) // 2 :])
    return {
        "frames": total,
        "messages": sent,
        "seconds": time.monotonic() - start_s,
        "rss_mib": [round(mib, 2) for _, mib in rss],
        "slope_mib_per_million_frames": float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) * 1e6,
    }


# --- report -------------------------------------------------------------------------------------------


def show(name: str, found: dict[str, Any]) -> None:
    delay, first = found.get("delay_ms", {}), found.get("first_bearing_s")
    print(
        f"{name:10}{found['cpu_percent']:7.2f} %{found['cpu_percent_least']:7.2f} %"
        f"{found['pss_mib']:9.1f}{found['private_mib']:8.1f}{found['threads']:9}"
        f"{delay.get('median', math.nan):10.2f}{delay.get('p99', math.nan):8.2f}"
        f"{math.nan if first is None else first:10.2f}{len(found['files_outside_state']):8}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--quick", action="store_true", help="seconds instead of minutes: a test that it runs"
    )
    parser.add_argument("--frames", type=int, default=200_000, help="for growth (default 200,000)")
    parser.add_argument("--output", type=Path, default=report.default("daemon"))
    options = parser.parse_args()
    times = QUICK if options.quick else FULL
    results: dict[str, Any] = {}
    print(
        f"{'':10}{'CPU':>9}{'least':>9}{'PSS MiB':>9}{'own':>8}{'threads':>9}{'delay ms':>10}{'p99':>8}"
        f"{'first, s':>10}{'strays':>8}"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for chosen in list(CHAINS)[:1] if options.quick else CHAINS:
            try:
                results[chosen] = chain(chosen, folder, times)
            except card.Missing as missing:
                print(f"{chosen:10}left out: {missing}")
            else:
                show(chosen, results[chosen])
        results["plain"] = plain_daemon(folder, times)
        show("plain", results["plain"])
        results["nothing"] = measure([sys.executable, "-c", NOTHING], Home(folder / "nothing"), times)
        show("nothing", results["nothing"])
    grown = growth(1000 if options.quick else options.frames)
    print(
        f"growth: {grown['slope_mib_per_million_frames']:+.2f} MiB per million frames "
        f"({grown['frames']} frames in {grown['seconds']:.0f} s)"
    )
    goals = {"chains": GOALS, "delay_ms": DELAY_GOAL_MS}
    report.write(options.output, daemons=results, growth=grown, goals=goals)
    print(f"written to {options.output}")


if __name__ == "__main__":
    main()
