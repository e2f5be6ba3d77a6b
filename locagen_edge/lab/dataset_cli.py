"""`locagen-lab dataset`: makes a data set of the twin, or goes on with one that was cut off."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from locagen_edge.lab.settings import read

INTERRUPTED = 130  # 128 + SIGINT, as shells count


def add_command(subparsers: Any) -> None:
    """Adds `dataset` to what `argparse.ArgumentParser.add_subparsers` gave; `run` is its `command`."""
    parser = subparsers.add_parser(
        "dataset",
        help="simulate a data set in shards",
        description="Make a data set of the twin in Parquet shards, or go on with one that was cut off. Same "
        "settings, same bytes, however many workers there are.",
    )
    parser.add_argument(
        "folder", type=Path, help="where the shards go; an unfinished set there is gone on with"
    )
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML file (default: built in)")
    parser.add_argument("--level", help="arrivals or waveforms (default: dataset.level)")
    parser.add_argument("--samples", type=int, help="how many (default: data.samples)")
    parser.add_argument("--seed", type=int, help="same seed, same bytes (default: data.seed)")
    parser.add_argument("--shard-size", type=int, help="samples in a shard (default: dataset.shard)")
    parser.add_argument("--workers", type=int, default=1, help="processes on this machine (default 1)")
    parser.add_argument("--scheduler", default="", help="address of a Dask scheduler, whose workers do it")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Returns the exit status. Raises `LocagenError` with one fault per line."""
    settings = read(arguments.settings)
    data = _given(samples=arguments.samples, seed=arguments.seed)
    layout = _given(level=arguments.level, shard=arguments.shard_size)
    settings = dataclasses.replace(
        settings,
        data=dataclasses.replace(settings.data, **data),
        dataset=dataclasses.replace(settings.dataset, **layout),
    )
    from locagen_edge.lab.dataset import make

    try:
        made = make(arguments.folder, settings, max(arguments.workers, 1), arguments.scheduler)
    except KeyboardInterrupt:
        print("interrupted; what is complete stays, and the same command goes on from there", file=sys.stderr)
        return INTERRUPTED
    there = f", {made.kept} of them were there before" if made.kept else ""
    print(f"{arguments.folder}: {settings.data.samples} samples in {made.shards} shards{there}")
    return 0


def _given(**keys: Any) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if value is not None}
