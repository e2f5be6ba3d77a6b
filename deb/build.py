"""The Debian package: program, models, unit, user and sample settings, for amd64 or arm64 on either.

    python deb/build.py [--architecture arm64] [--output build/deb]

What Debian does not have as we need it lies in a virtual environment of its own, /opt/locagen-edge, and
nothing else on the machine is touched: /opt is where the Filesystem Hierarchy Standard (3.0, 3.13) puts
software from elsewhere, and where `make install` puts it too, so that there is one unit. Python and PortAudio
are Debian's. The package is for the Python it is made with: 3.11 for Debian 12.

No udev rule is needed: cards belong to `audio` and serial ports to `dialout`, and the user is in both.

No part of it is run while it is made, so a package for the Raspberry Pi is made on any PC: wheels of others
come from PyPI for that architecture, in the versions of constraints.txt; our own is cross-compiled. Times are
SOURCE_DATE_EPOCH's, or else the last commit's: the same sources give the same bytes.
"""

import argparse
import compileall
import hashlib
import os
import py_compile
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from installer import install
from installer.destinations import SchemeDictionaryDestination
from installer.sources import WheelFile

ROOT = Path(__file__).resolve().parent.parent
SOURCES = (
    "csrc",
    "locagen_edge",
    "models",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
)
HOME = Path("/opt/locagen-edge")
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
GLIBC = (17, 26, 27, 28, 36)
"""minor versions of glibc 2 that wheels are tagged with; the last is Debian 12's, and our own wheel's"""
USELESS = ("tests", "testing/tests", "_pyinstaller")
"""folders of others' wheels that nothing imports in flight: a third of numpy"""


def run(*command: object, **environment: str) -> str:
    done = subprocess.run(
        [str(part) for part in command],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command[:4]))} ... failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def epoch() -> str:
    """Seconds since 1970 that every file is said to be of."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    return given or run("git", "-C", ROOT, "log", "-1", "--format=%ct").strip()


def version() -> str:
    """Of locagen_edge/__init__.py, in Debian's order: 1.0rc1 comes before 1.0."""
    text = (ROOT / "locagen_edge" / "__init__.py").read_text(encoding="utf-8")
    (found,) = re.findall(r'^__version__ = "(.+)"', text, re.MULTILINE)
    return re.sub(r"\.?(a|b|rc|dev)(?=\d)", r"~\1", found)


def compiler(machine: str) -> str:
    """The compiler for a machine. Debian's names are the same for the native one."""
    name = f"{machine}-linux-gnu-gcc"
    if shutil.which(name) is None:
        raise SystemExit(f"{name} is missing: sudo apt install gcc-{machine.replace('_', '-')}-linux-gnu")
    return name


def own_wheel(machine: str, folder: Path) -> None:
    """Our wheel, from a copy of the sources: nothing is left behind in the checkout.

    The headers of the Python that builds serve for the other machine too: both have 64 bit pointers and
    longs, and the kernel sees only the limited API.
    """
    with tempfile.TemporaryDirectory() as copy:
        for name in SOURCES:
            if (ROOT / name).is_dir():
                ignored = shutil.ignore_patterns("*.so", "_messages.py", "__pycache__")
                shutil.copytree(ROOT / name, Path(copy, name), ignore=ignored)
            else:
                shutil.copy(ROOT / name, copy)
        command = compiler(machine)
        run(
            sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder,
            f"--config-settings=--build-option=--plat-name=manylinux_2_{GLIBC[-1]}_{machine}", copy,
            CC=command, LDSHARED=f"{command} -shared -s", SOURCE_DATE_EPOCH=epoch(),
        )  # fmt: skip


def wheels(machine: str, folder: Path) -> list[Path]:
    """Our own wheel and all it needs, for a machine."""
    own_wheel(machine, folder)
    (own,) = folder.glob("*.whl")
    platforms = [f"--platform=manylinux_2_{minor}_{machine}" for minor in GLIBC]
    run(
        sys.executable, "-m", "pip", "download", "-q", "--only-binary=:all:", "-d", folder, *platforms,
        "-c", ROOT / "deb" / "constraints.txt", own,
    )  # fmt: skip
    return sorted(folder.glob("*.whl"))


def environment(root: Path, found: list[Path]) -> None:
    """A virtual environment on Debian's Python, with those wheels installed and compiled."""
    home = root / HOME.relative_to("/")
    packages = home / "lib" / PYTHON / "site-packages"
    scripts = home / "bin"
    scripts.mkdir(parents=True)
    (scripts / "python").symlink_to(f"/usr/bin/{PYTHON}")
    (home / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\n", "utf-8")
    paths = {"purelib": packages, "platlib": packages, "scripts": scripts, "data": home, "headers": home}
    for path in found:
        with WheelFile.open(path) as wheel:
            destination = SchemeDictionaryDestination(
                {name: str(place) for name, place in paths.items()},
                interpreter=str(HOME / "bin" / "python"),
                script_kind="posix",
            )
            install(source=wheel, destination=destination, additional_metadata={"INSTALLER": b"dpkg\n"})
    for script in scripts.iterdir():
        if not script.name.startswith(("python", "locagen-edge")):
            script.unlink()  # tools of others, and the workshop, which needs what is not here
    for name in USELESS:
        for folder in packages.glob(f"*/**/{name}"):
            shutil.rmtree(folder)
    # The service cannot write its byte code, and without it starts late and takes twice the memory. By hash,
    # not time: the same bytes from the same sources.
    compileall.compile_dir(
        packages, quiet=2, stripdir=str(root), prependdir="/", workers=1,
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    )  # fmt: skip


def place(source: Path, target: Path, mode: int = 0o644) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    target.chmod(mode)


def package(architecture: str, output: Path) -> Path:
    """Makes the package and returns its path."""
    with tempfile.TemporaryDirectory() as scratch:
        root, wheelhouse = Path(scratch, "root"), Path(scratch, "wheels")
        root.mkdir(mode=0o755)
        wheelhouse.mkdir()
        environment(root, wheels(MACHINES[architecture], wheelhouse))
        systemd = ROOT / "systemd"
        place(systemd / "locagen-edge.service", root / "lib/systemd/system/locagen-edge.service")
        place(systemd / "locagen-edge.sysusers", root / "usr/lib/sysusers.d/locagen-edge.conf")
        place(systemd / "locagen-edge.toml", root / "etc/locagen-edge/locagen-edge.toml")
        place(ROOT / "deb" / "copyright", root / "usr/share/doc/locagen-edge/copyright")
        place(ROOT / "CHANGELOG.md", root / "usr/share/doc/locagen-edge/CHANGELOG.md")
        (root / "usr/bin").mkdir()
        (root / "usr/bin/locagen-edge").symlink_to(HOME / "bin" / "locagen-edge")
        _control(root, architecture)
        for path in [root, *root.rglob("*")]:
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
        output.mkdir(parents=True, exist_ok=True)
        made = output / f"locagen-edge_{version()}_{architecture}.deb"
        part = made.with_suffix(".part")
        run("dpkg-deb", "--root-owner-group", "-Zxz", "--build", root, part, SOURCE_DATE_EPOCH=epoch())
        return part.rename(made)


def _control(root: Path, architecture: str) -> None:
    control = root / "DEBIAN"
    control.mkdir()
    files = sorted(p for p in root.rglob("*") if p.is_file() and not p.is_symlink())
    sums = [f"{hashlib.md5(p.read_bytes()).hexdigest()}  {p.relative_to(root)}\n" for p in files]
    (control / "md5sums").write_text("".join(sums), "utf-8")
    (control / "conffiles").write_text("/etc/locagen-edge/locagen-edge.toml\n", "utf-8")
    for name in ("postinst", "prerm", "postrm"):
        place(ROOT / "deb" / name, control / name, 0o755)
    major, minor = sys.version_info[:2]
    (control / "control").write_text(
        (ROOT / "deb" / "control").read_text(encoding="utf-8").format(
            version=version(),
            architecture=architecture,
            size=sum(p.stat().st_size for p in files) // 1024,
            python=f"python3 (>= {major}.{minor}), python3 (<< {major}.{minor + 1})",
        ),
        "utf-8",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    native = run("dpkg", "--print-architecture").strip()
    parser.add_argument("--architecture", choices=MACHINES, default=native)
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "deb", metavar="DIR")
    arguments = parser.parse_args()
    print(package(arguments.architecture, arguments.output))


if __name__ == "__main__":
    main()
