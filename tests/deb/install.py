"""The package in a clean Debian: installed by apt, used as the service's user, removed, purged.

    python tests/deb/install.py PACKAGE.deb

As root: the clean Debian is a folder that commands are run in with chroot, in namespaces of their own, so
that nothing of it is seen outside and all of it ends with the command. No systemd is started there or here.
Exit code 0: all held, nothing stayed; or skipped where it cannot be done, saying so.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile

from locagen_edge.settings import from_table
from locagen_edge.sim.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "deb"
SUITE = "bookworm"
OTHERS = ("dev", "proc", "run", "sys", "tmp", "var/log", "var/cache", "var/lib/dpkg", "var/lib/apt")
"""what changes with every package: lists, logs, caches"""
AZIMUTH_DEG = 40.0
AS_SERVICE = (
    "setpriv --reuid=locagen-edge --regid=locagen-edge --init-groups "
    "env HOME=/var/lib/locagen-edge STATE_DIRECTORY=/var/lib/locagen-edge"
)


class Failed(Exception):
    pass


class Clean:
    """A clean Debian in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def run(self, command: str, *, ok: tuple[int, ...] = (0,)) -> str:
        """What the command says. Raises `Failed` where its exit code is another."""
        done = subprocess.run(
            ["unshare", "--mount", "--pid", "--ipc", "--uts", "--fork", "--kill-child", "sh", "-c",
             f"mount -t proc proc {self.folder}/proc && exec chroot {self.folder} sh -c \"$0\"", command],
            env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root",
                 "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=600,
        )  # fmt: skip
        if done.returncode not in ok:
            raise Failed(
                f"{command}: exit code {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
            )
        return done.stdout

    def files(self) -> dict[str, str]:
        """Every path with what it is, but those that change with every package."""
        found = {}
        for path in sorted(self.folder.rglob("*")):
            name = str(path.relative_to(self.folder))
            if name.startswith(tuple(f"{other}/" for other in OTHERS)):
                continue
            if path.is_symlink():
                found[name] = os.readlink(path)
            elif path.is_file():
                found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
            else:
                found[name] = ""
        return found


def debian(architecture: str) -> Path:
    """A minimal Debian as an archive, made once."""
    archive = BUILD / f"clean-{SUITE}-{architecture}.tar"
    if not archive.is_file():
        print(f"making {archive} (once)", flush=True)
        BUILD.mkdir(parents=True, exist_ok=True)
        part = archive.with_suffix(".part.tar")
        subprocess.run(
            ["mmdebstrap", "--quiet", "--variant=minbase", f"--architectures={architecture}", SUITE, part],
            check=True,
        )
        part.rename(archive)
    return archive


def recording(path: Path) -> None:
    """A caller at AZIMUTH_DEG under rotors, three channels."""
    settings = from_table({"sim": {"azimuth_deg": AZIMUTH_DEG, "turn_deg_s": 0.0, "snr_db": 10.0}})
    scene = Scene(settings)
    rows = np.concatenate([scene.render(1000) for _ in range(80)], axis=1).T
    soundfile.write(path, rows, settings.audio.rate_hz, subtype="PCM_16")


def check_all(clean: Clean, package: Path) -> None:
    """Each step says in words what held."""
    name = package.name
    shutil.copy(package, clean.folder / "tmp" / name)
    recording(clean.folder / "tmp/scene.wav")
    settings = clean.folder / "etc/locagen-edge/locagen-edge.toml"

    def dependencies() -> str:
        clean.run("apt-get update -q")
        needs = subprocess.run(
            ["dpkg-deb", "-f", package, "Depends"], capture_output=True, text=True, check=True
        ).stdout.strip()
        clean.run(f"apt-get satisfy -y -q --no-install-recommends '{needs}'")
        return needs

    try_it = ""

    def install() -> str:
        nonlocal try_it
        told = clean.run(f"apt-get install -y -q --no-install-recommends /tmp/{name}")
        if "enable --now locagen-edge" not in told:
            raise Failed("does not say what to do next")
        links = [str(p) for p in (clean.folder / "etc/systemd").rglob("locagen-edge.service")]
        if links:
            raise Failed(f"enabled by itself: {links}")
        # what stands between "try it with" and "then:"; sudo is not there, and not needed by root
        try_it = told.partition("try it with\n")[2].partition("then:")[0].replace("sudo ", "")
        return "not enabled, and says what to do next; " + clean.run("locagen-edge --version").strip()

    def user() -> str:
        told = clean.run("id locagen-edge").strip()
        if "(audio)" not in told or "(dialout)" not in told:
            raise Failed(told)
        return told

    def checks() -> str:
        """By the very lines that the installation has printed."""
        if f"{AS_SERVICE} locagen-edge check" not in " ".join(try_it.replace("\\", "").split()):
            raise Failed(f"says to try it with {try_it!r}")
        told = clean.run(try_it)
        return told.strip().splitlines()[-1]

    def bearings() -> str:
        told = clean.run(f"{AS_SERVICE} locagen-edge replay /tmp/scene.wav")
        heard = [line for line in map(json.loads, told.splitlines()) if line["call"]]
        errors = [abs(line["azimuth_deg"] - AZIMUTH_DEG) for line in heard if line["azimuth_deg"] is not None]
        if len(errors) < 20 or np.median(errors) > 2.0:
            raise Failed(f"{len(errors)} bearings, median error {np.median(errors or [180]):.1f}°")
        return f"{len(errors)} bearings of a call, median error {np.median(errors):.1f}°"

    def nothing_written() -> str:
        """As root too: byte code would come first, and dpkg would not know of it."""
        clean.run("locagen-edge check --seconds 1")
        unknown = clean.run(
            "dpkg -L locagen-edge | sort > /tmp/known; find /opt/locagen-edge | sort | comm -13 /tmp/known -"
        )
        if unknown:
            raise Failed(unknown[:500])
        return "no file under /opt that dpkg does not know"

    def upgrade() -> str:
        settings.write_text(settings.read_text() + "\n# edited\n")
        clean.run(f"apt-get install -y -q --reinstall /tmp/{name}")
        if "# edited" not in settings.read_text():
            raise Failed("the edited settings are gone")
        return "installed over itself: edited settings stay"

    def remove() -> str:
        clean.run("install -d -o locagen-edge -g locagen-edge /var/lib/locagen-edge")
        clean.run("touch /var/lib/locagen-edge/kept")
        clean.run("apt-get remove -y -q locagen-edge")
        left = [name for name in clean.files() if "locagen" in name]
        expected = ["etc/locagen-edge", "etc/locagen-edge/locagen-edge.toml", "var/lib/locagen-edge",
                    "var/lib/locagen-edge/kept"]  # fmt: skip
        if left != expected:
            raise Failed(f"left: {left}")
        return "settings and state stay, nothing else"

    def purge() -> str:
        clean.run("apt-get purge -y -q locagen-edge")
        after = clean.files()
        different = sorted(
            name for name in before.keys() | after.keys()
            if before.get(name) != after.get(name) and not name.endswith("-")  # /etc/passwd-: a backup
        )  # fmt: skip
        if different:
            raise Failed(f"not as before: {different[:10]}")
        return "every file as before, user and groups too"

    step("depends", dependencies)
    before = clean.files()
    for one in (install, user, checks, bearings, nothing_written, upgrade, remove, purge):
        step(one.__name__, one)


def step(name: str, act: Callable[[], str]) -> None:
    begin = time.monotonic()
    told = act()
    print(f"pass  {name.replace('_', ' '):16} {told}  ({time.monotonic() - begin:.0f} s)", flush=True)


def lacking(architecture: str) -> str:
    """Why it cannot be done here; empty where it can."""
    if os.geteuid() != 0:
        return "chroot needs root"
    absent = [name for name in ("mmdebstrap", "unshare", "dpkg-deb") if shutil.which(name) is None]
    if absent:
        return f"{', '.join(absent)} not installed"
    native = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True)
    return "" if native.stdout.strip() == architecture else f"this machine does not run {architecture}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("package", type=Path, metavar="PACKAGE.deb")
    package = parser.parse_args().package
    architecture = subprocess.run(
        ["dpkg-deb", "-f", package, "Architecture"], capture_output=True, text=True, check=True
    ).stdout.strip()
    if why := lacking(architecture):
        print(f"skipped: {why}")
        return
    archive = debian(architecture)
    with tempfile.TemporaryDirectory(dir=BUILD) as scratch:
        folder = Path(scratch, "debian")
        folder.mkdir()
        subprocess.run(["tar", "-xf", archive, "-C", folder], check=True)
        shutil.copy("/etc/resolv.conf", folder / "etc/resolv.conf")
        clean = Clean(folder)
        try:
            check_all(clean, package)
        except Failed as failure:
            print(f"FAIL  {failure}")
            sys.exit(1)


if __name__ == "__main__":
    main()
