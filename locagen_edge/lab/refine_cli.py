"""`locagen-lab refine`: whether a network improves on the steered estimator, disturbance by disturbance."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from locagen_edge.errors import SettingsError
from locagen_edge.files import write
from locagen_edge.lab.settings import read

FEWEST = 50


def add_command(subparsers: Any) -> None:
    """Adds `refine` to what `argparse.ArgumentParser.add_subparsers` gave; `run` is its `command`."""
    parser = subparsers.add_parser(
        "refine",
        help="a network that corrects the steered estimator, judged beside it",
        description="Train a network on the score maps of the estimator `steered` under the twin's "
        "disturbances, and judge it beside the estimator on calls of other seeds and on disturbances that it "
        "has not met. Writes report.md, report.json. Takes some ten minutes.",
    )
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML file (default: built in)")
    parser.add_argument("--out", type=Path, default=Path("refine-report"), metavar="DIR",
                        help="where to write (default: refine-report)")  # fmt: skip
    parser.add_argument(
        "--calls", type=int, default=1000, help="calls of each kind to learn from (default 1000)"
    )
    parser.add_argument(
        "--judged", type=int, default=300, help="calls of each kind to judge by (default 300)"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes that make calls (default 1)")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Returns the exit status. Raises `LocagenError`."""
    settings = read(arguments.settings)
    for name in ("calls", "judged"):
        if getattr(arguments, name) < FEWEST:
            raise SettingsError(
                f"--{name} {getattr(arguments, name)}: at least {FEWEST} of each kind are needed"
            )

    from locagen_edge.lab import refine

    arguments.out.mkdir(parents=True, exist_ok=True)
    result = refine.compare(settings, arguments.calls, arguments.judged, max(arguments.workers, 1))
    write(arguments.out / "report.json", json.dumps(result, indent=1) + "\n")
    write(arguments.out / "report.md", refine.markdown(result))
    print(refine.line(result))
    print(f"wrote {arguments.out / 'report.md'}")
    return 0
