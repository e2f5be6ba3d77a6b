"""A Debian for aarch64 on this machine: unpacked, not installed, and none of it is run here.

mmdebstrap fetches and unpacks the packages; no root rights and no emulator are needed for that. What their
scripts would have set up is little: users and groups, and a machine's id.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "arm64"
SUITE = "bookworm"
PACKAGES = (
    "linux-image-arm64,systemd-sysv,udev,kmod,mount,passwd,alsa-utils,"
    "python3,libportaudio2,libstdc++6,zlib1g,libfftw3-dev,libc6-dev"
)
MODULES = ("soundcore", "core/snd", "core/snd-timer", "core/snd-pcm", "drivers/snd-aloop")
"""of the kernel's sound folder, in the order in which they are loaded; no other module is needed"""
LEFT_OUT = ("./dev/*", "./usr/share/doc/*", "./usr/share/man/*", "./usr/share/locale/*", "./var/cache/*")


def missing(*programs: str) -> str:
    """What is not installed, in words; empty where all is there."""
    absent = [name for name in programs if shutil.which(name) is None]
    return f"{', '.join(absent)} not installed" if absent else ""


def root() -> Path:
    """The folder of the unpacked system, made at the first call and kept under build/."""
    recipe = hashlib.sha256(f"{SUITE} {PACKAGES} {LEFT_OUT}".encode()).hexdigest()[:12]
    made = BUILD / f"root-{recipe}"
    if made.is_dir():
        return made
    print(f"unpacking a Debian for aarch64 into {made} (once)", flush=True)
    BUILD.mkdir(parents=True, exist_ok=True)
    archive = BUILD / "root.tar"
    subprocess.run(
        ["mmdebstrap", "--quiet", "--variant=extract", "--architectures=arm64", "--include=?essential",
         f"--include={PACKAGES}", "--aptopt=APT::Install-Recommends false",
         "--hook-dir=/usr/share/mmdebstrap/hooks/merged-usr", SUITE, archive],
        check=True,
    )  # fmt: skip
    part = made.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    excluded = [f"--exclude={pattern}" for pattern in LEFT_OUT]
    subprocess.run(["tar", "-xf", archive, "-C", part, "--no-same-owner", *excluded], check=True)
    archive.unlink()
    for name in ("passwd", "group"):
        shutil.copy(part / "usr/share/base-passwd" / f"{name}.master", part / "etc" / name)
    return part.rename(made)


def kernel(system: Path) -> Path:
    (found,) = (system / "boot").glob("vmlinuz-*")
    return found


def pack(folder: Path, archive: Path, names: list[str] | None = None) -> Path:
    """A folder as an initial RAM disk of the kernel's, everything root's own; `names`: only these."""
    if names is None:
        names = [str(path.relative_to(folder)) for path in sorted(folder.rglob("*"))]
    with archive.open("wb") as out:
        subprocess.run(
            ["cpio", "--quiet", "-o", "-H", "newc", "--owner=+0:+0", "--null"],
            cwd=folder, input="\0".join(names).encode(), stdout=out, check=True,
        )  # fmt: skip
    return archive


def base_archive(system: Path) -> Path:
    """The system as a RAM disk, with only those modules of the kernel that are used; made once."""
    archive = system.with_suffix(".cpio")
    if not archive.is_file():
        used = {f"kernel/sound/{name}.ko" for name in MODULES}
        names = []
        for path in sorted(system.rglob("*")):
            name = str(path.relative_to(system))
            module = name.partition("/modules/")[2].partition("/")[2]
            in_use = not module or any(module == one or one.startswith(f"{module}/") for one in used)
            if in_use and not name.startswith(("boot/", "usr/include/")):
                names.append(name)
        pack(system, archive.with_suffix(".part"), names).rename(archive)
    return archive
