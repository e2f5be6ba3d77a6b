"""The service on a board: an aarch64 virtual machine with Debian's kernel and systemd; a table of what held.

    python tests/vm/vm.py [--only STEP,...] [--log FILE] PACKAGE.deb

qemu emulates the processor (no KVM needed, no root rights), and counts its instructions: 2 ns each, whichever
of the two cores makes it. Time in there passes with them, so that bounds hold, or not, however busy the
machine is that emulates; half a billion a second is less than one core of a Raspberry Pi 4 makes. Inside,
steps.py does to the service what may happen in a year; a sound card of the kernel's own (snd-aloop) plays a
simulated caller, and this side of the serial line is the autopilot. systemd runs only in there. Exit code 0:
all steps passed, or skipped where a tool is missing, saying so.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import debian
import numpy as np
from pymavlink.dialects.v20 import common

from locagen_edge.settings import from_table
from locagen_edge.sim.scene import Scene

HERE = Path(__file__).parent
BOOT_S = 480.0
STEP_S = 600.0
"""of this machine's time, which goes by some times faster than the emulated one's"""
AZIMUTH_DEG = 40.0
SCENE_S = 22.0
"""ten calls of 1.5 s with pauses of 0.7 s: what repeats has no step in it"""
SETTINGS = """
[audio]
source = "alsa"
device = "Loopback: PCM (hw:0,1)"
device_rate_hz = 48000
device_channels = 4
channel_map = [0, 1, 2]
hop = 1024

# the lightest: an emulated processor is far slower than a board's, and it is the service that is tried
[bearing]
estimator = "far-field"

[daemon]
backoff_s = 1.0

[mavlink]
link = ["serial:/dev/ttyS0:57600"]
"""
UNITS = {
    "card.service": """
[Service]
Type=oneshot
RemainAfterExit=yes
# what unpacked packages lack: the list of libraries that Python finds PortAudio in
ExecStart=/sbin/ldconfig
ExecStart=/bin/sh -ec 'cd /lib/modules/*/kernel/sound; for m in {modules}; do insmod $m.ko; done'
""",
    # a card that is pulled takes its player along
    "player.service": """
[Unit]
Requires=card.service
After=card.service systemd-udevd.service
StartLimitIntervalSec=0
[Service]
ExecStart=/bin/sh -c 'while cat /test/scene.raw; do :; done | \
aplay -q -D hw:Loopback,0 -t raw -f S16_LE -c 4 -r 48000 --buffer-time=200000'
Restart=always
RestartSec=50ms
""",
    "busy@.service": """
[Service]
# beside ours: by itself a template's instances share one slice, and one weight
Slice=system.slice
ExecStart=/bin/sh -c 'while :; do :; done'
""",
    "test.service": """
[Unit]
Wants=multi-user.target player.service
# the service too, though nothing starts it yet: a unit that no other names is forgotten once it has stopped,
# and with it when and how
After=multi-user.target player.service locagen-edge.service
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
ExecStart=/usr/bin/python3 /test/steps.py
# the last lines have to be out before the power is
ExecStopPost=/bin/sleep 2
StandardOutput=tty
StandardError=tty
TTYPath=/dev/ttyAMA0
""",
}
MASKED = ("getty@.service", "serial-getty@.service", "systemd-timesyncd.service", "apt-daily.timer",
          "apt-daily-upgrade.timer", "dpkg-db-backup.timer", "e2scrub_all.timer", "fstrim.timer",
          "motd-news.timer", "e2scrub_reap.service")  # fmt: skip


def scene() -> bytes:
    """Four channels at 48 kHz, int16: a caller at AZIMUTH_DEG, and a silent fourth."""
    settings = from_table({
        "audio": {"rate_hz": 48000, "frame": 4096, "hop": 4096},
        "sim": {"azimuth_deg": AZIMUTH_DEG, "turn_deg_s": 0.0, "rotors": 0, "snr_db": 20.0},
    })  # fmt: skip
    source = Scene(settings)
    blocks = [source.render(4096) for _ in range(math.ceil(SCENE_S * 48000 / 4096))]
    rows = np.concatenate(blocks, axis=1).T
    return (np.pad(rows, ((0, 0), (0, 1))).clip(-1, 1) * 32767).astype("<i2").tobytes()


def overlay(package: Path, folder: Path) -> None:
    """What is laid over the plain Debian: the package as it is, the test's own units, sound and settings."""
    subprocess.run(["dpkg-deb", "-x", package, folder], check=True)
    # in the unpacked Debian /lib is a link, which a folder of that name would replace
    for name in ("lib",):
        shutil.copytree(folder / name, folder / "usr" / name, dirs_exist_ok=True)
        shutil.rmtree(folder / name)
    (folder / "etc/locagen-edge/locagen-edge.toml").write_text(SETTINGS, "utf-8")
    units = folder / "etc/systemd/system"
    units.mkdir(parents=True)
    for name, text in UNITS.items():
        (units / name).write_text(text.replace("{modules}", " ".join(debian.MODULES)), "utf-8")
    for name in MASKED:
        (units / name).symlink_to("/dev/null")
    (folder / "etc/machine-id").write_text("0123456789abcdef0123456789abcdef\n", "utf-8")
    (folder / "etc/hostname").write_text("board\n", "utf-8")
    (folder / "init").symlink_to("/lib/systemd/systemd")
    (folder / "test").mkdir()
    (folder / "test/scene.raw").write_bytes(scene())
    shutil.copy(HERE / "steps.py", folder / "test")


def qemu(initrd: Path, system: Path, line: Path, only: str) -> list[str]:
    return [
        "qemu-system-aarch64", "-M", "virt", "-cpu", "cortex-a72", "-smp", "2", "-m", "2G",
        "-accel", "tcg,thread=single", "-icount", "shift=1",
        "-display", "none", "-monitor", "none", "-nic", "none", "-no-reboot",
        "-kernel", str(debian.kernel(system)), "-initrd", str(initrd), "-append",
        "console=ttyAMA0 quiet loglevel=3 systemd.unit=test.service systemd.show_status=0 "
        f"systemd.log_target=journal systemd.setenv=ONLY={only} panic=-1",
        "-serial", "stdio",
        "-chardev", f"socket,id=autopilot,path={line},server=on,wait=off",
        "-device", "pci-serial,chardev=autopilot",
    ]  # fmt: skip


class Autopilot:
    """The other end of the serial line: says a heartbeat a second, and keeps what it hears."""

    def __init__(self, path: Path) -> None:
        self.heard: dict[str, int] = {}
        self.azimuths_deg: list[float] = []
        self._path = path
        self._parser = common.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser.robust_parsing = True
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with socket.socket(socket.AF_UNIX) as line:
            while line.connect_ex(str(self._path)):
                time.sleep(0.1)
            line.settimeout(0.2)
            self._talk(line)

    def _talk(self, line: socket.socket) -> None:
        with contextlib.suppress(ConnectionError):  # the machine's end
            for turn in itertools.count():
                with contextlib.suppress(TimeoutError):  # while nobody has the port open, nobody reads
                    if turn % 5 == 0:
                        beat = common.MAVLink_heartbeat_message(common.MAV_TYPE_QUADROTOR, 3, 0, 0, 4, 3)
                        line.sendall(beat.pack(self._parser))
                    if not (data := line.recv(4096)):
                        return
                    self._hear(data)

    def _hear(self, data: bytes) -> None:
        for message in self._parser.parse_buffer(data) or []:
            name = message.get_type()
            self.heard[name] = self.heard.get(name, 0) + 1
            if name == "NAMED_VALUE_FLOAT" and message.name == "LG_AZB":
                self.azimuths_deg.append(message.value)

    def judge(self) -> tuple[bool, str]:
        """The bearings, and that both directions work: who hears our heartbeat asks for the attitude."""
        if len(self.azimuths_deg) < 20 or not self.heard.get("COMMAND_LONG"):
            return False, f"heard {self.heard}"
        errors = (np.array(self.azimuths_deg) - AZIMUTH_DEG + 180) % 360 - 180
        median = float(np.median(np.abs(errors)))
        told = f"{len(errors)} bearings, median error {median:.1f}°; asked for poses; {self.heard}"
        return median < 2.0, told  # far more than noise at 20 dB leaves


def run(package: Path, log: Path, only: str) -> int:
    system = debian.root()
    base = debian.base_archive(system)
    results = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "overlay")
        folder.mkdir()
        overlay(package, folder)
        initrd = Path(scratch, "initrd")
        added = debian.pack(folder, Path(scratch, "overlay.cpio"))
        with initrd.open("wb") as out:
            for part in (base, added):  # the kernel unpacks one after the other
                with part.open("rb") as archive:
                    shutil.copyfileobj(archive, out)
        autopilot = Autopilot(Path(scratch, "line"))
        command = qemu(initrd, system, Path(scratch, "line"), only)
        with (
            log.open("w", encoding="utf-8") as kept,
            subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, errors="replace"
            ) as machine,
        ):
            patience = threading.Timer(BOOT_S, machine.kill)
            patience.start()
            assert machine.stdout is not None
            for line in machine.stdout:
                kept.write(line)
                kept.flush()
                if line.startswith('{"step"'):
                    patience.cancel()
                    results.append(json.loads(line))
                    show(results[-1])
                    patience = threading.Timer(STEP_S, machine.kill)
                    patience.start()
            patience.cancel()
    passed, told = autopilot.judge()
    results.append({"step": "bearings_on_the_serial_line", "passed": passed, "told": told, "seconds": 0.0})
    show(results[-1])
    expected = len(only.split(",")) if only else count_steps()
    if len(results) < expected + 1:
        print(f"only {len(results) - 1} of {expected} steps were made; the machine's console: {log}")
        return 1
    failed = sum(not result["passed"] for result in results)
    print(f"{len(results) - failed} of {len(results)} passed; the machine's console: {log}")
    return int(failed > 0)


def count_steps() -> int:
    from steps import STEPS

    return len(STEPS)


def show(result: dict[str, object]) -> None:
    name = str(result["step"]).replace("_", " ")
    print(f"{'pass' if result['passed'] else 'FAIL'}  {name:30} {result['told']}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("package", type=Path, metavar="PACKAGE.deb", help="the package for arm64")
    parser.add_argument(
        "--log", type=Path, default=debian.BUILD / "vm.log", help="the console (default: %(default)s)"
    )
    parser.add_argument("--only", default="", metavar="STEP,...", help="these steps of steps.py alone")
    arguments = parser.parse_args()
    if lacking := debian.missing("qemu-system-aarch64", "mmdebstrap", "cpio", "dpkg-deb"):
        print(f"skipped: {lacking} (sudo apt install qemu-system-arm mmdebstrap cpio)")
        return
    debian.BUILD.mkdir(parents=True, exist_ok=True)
    sys.exit(run(arguments.package, arguments.log, arguments.only))


if __name__ == "__main__":
    main()
