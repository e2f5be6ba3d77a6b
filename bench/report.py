"""What every benchmark reports beside its numbers: machine, flags, commit; and the form of the numbers.

A benchmark writes one JSON file into `bench/results/`; plots and tables read only that. Machines are noisy:
a benchmark lets its peers take turns, round by round, and compares the medians of ratios within a round.
"""

import json
import platform
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"


def default(name: str) -> Path:
    """Where a benchmark's report goes unless it is told otherwise: one file per kind of machine."""
    return RESULTS / f"{name}-{platform.machine()}.json"


def _output(*command: str) -> str:
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def cpu() -> str:
    """Model name of the CPU, as the kernel tells it; on a Pi, of the board."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    return named.get("model name") or named.get("Model") or platform.processor() or "unknown"


def machine() -> dict[str, Any]:
    return {
        "cpu": cpu(),
        "architecture": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def commit() -> str:
    """Short hash of the checkout, with `+` where tracked files differ from it; empty outside git."""
    found = _output("git", "rev-parse", "--short=12", "HEAD")
    changed = _output("git", "status", "--porcelain", "--untracked-files=no") if found else ""
    return found + ("+" if changed else "")


def compiler(command: str = "cc") -> str:
    return _output(command, "--version").partition("\n")[0]


def version(package: str) -> str:
    """Installed version of a package, empty where there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def summary(values: Sequence[float]) -> dict[str, float]:
    """Median, minimum and 99th percentile."""
    return {
        "median": float(np.median(values)),
        "min": float(np.min(values)),
        "p99": float(np.percentile(values, 99)),
    }


def write(path: Path, **content: Any) -> None:
    """Writes `content` with machine, commit, date and command line beside it."""
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "arguments": sys.argv[1:],
        "machine": machine(),
        **content,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
