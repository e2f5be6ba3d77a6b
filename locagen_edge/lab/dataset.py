"""Data sets of the twin in shards: made by one process, by several, or by a cluster, to the same bytes.

What a shard holds follows from the settings and its number alone (see `shards`), so work is handed out shard
by shard and nothing depends on who does what when. A run that was cut off goes on: shards that are there are
kept, after their metadata have been found to agree; a folder of other settings is refused.

On a cluster the workers write, so the folder has to be on a file system that all of them share.

    locagen-lab dataset FOLDER --level waveforms --samples 100000 --workers 4
"""

from __future__ import annotations

import fcntl
import logging
import os
import sys
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from tqdm import tqdm

from locagen_edge import __version__
from locagen_edge.errors import DatasetError
from locagen_edge.lab.columns import Columns
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.shards import (
    LAYOUT,
    TEMPORARY,
    differences,
    metadata,
    plain_toml,
    read_metadata,
    read_shard,
    shard_count,
    shard_path,
    shard_samples,
    write_shard,
)

NO_WORKER_S = 30.0
"""how long a scheduler may be without a worker before we say so"""

# --- making -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Made:
    """What a run did."""

    shards: int
    """in the data set"""
    kept: int
    """of them, were there before"""


def make(folder: Path, settings: LabSettings, workers: int = 1, scheduler: str = "") -> Made:
    """Makes all shards that are not there yet, with a progress bar where a person looks on.

    `workers` processes here, or those of the Dask scheduler at this address. Raises `DatasetError` where the
    folder holds something else, the disk is full, or workers are lost.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be made: {error.strerror}") from error
    with _alone(folder):
        _sweep(folder)
        kept = complete(folder, settings)
        todo = [number for number in range(shard_count(settings)) if number not in kept]
        run = _on_cluster(scheduler) if scheduler else _here(workers)
        done = set(kept)
        with _bar(settings, kept) as bar, closing(run((str(folder), settings, n) for n in todo)) as numbers:
            for number in numbers:
                if number not in done:
                    bar.update(shard_samples(settings, number))
                done.add(number)
        _sweep(folder)  # of workers that were lost on the way
        missing = set(todo) - complete(folder, settings)
        if missing:
            raise DatasetError(
                f"{folder}: {len(missing)} shards that workers have written are not to be seen here; "
                "the folder has to be on a file system that all workers share"
            )
    return Made(shard_count(settings), len(kept))


def _sweep(folder: Path) -> None:
    """Removes what was never finished."""
    for leftover in folder.glob(f".*{TEMPORARY}"):
        leftover.unlink(missing_ok=True)


def complete(folder: Path, settings: LabSettings) -> set[int]:
    """Numbers of the shards that are there. Raises `DatasetError` where one is not of these settings."""
    asked, recordings = plain_toml(settings), metadata(settings, 0)["recordings"]
    numbers = set()
    for path in sorted(folder.glob("shard-*.parquet")):
        told = read_metadata(path)
        different = differences(told["settings"], asked)
        if told["version"] != __version__:
            different.append(f"version: {told['version']} there, {__version__} asked for")
        if not different:
            number = int(told["shard"])
            if told["recordings"] != recordings:
                different.append("scene.recordings: other files than those there now")
            if path != shard_path(folder, number):
                different.append(f"{path.name}: is shard {number} by what it says of itself")
        if different:
            raise DatasetError(_refusal(folder, different))
        numbers.add(number)
    return numbers


def _refusal(folder: Path, different: list[str]) -> str:
    return "\n".join([f"{folder}: holds a data set made with other settings:", *different])


def _bar(settings: LabSettings, kept: Iterable[int]) -> tqdm:
    return tqdm(
        total=settings.data.samples,
        initial=sum(shard_samples(settings, number) for number in kept),
        unit=" samples",
        unit_scale=True,
        disable=None,  # only on a terminal
        file=sys.stderr,
    )


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two runs in one folder would take each other's unfinished files for leftovers."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DatasetError(f"{folder}: another run is writing there") from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(descriptor)


Jobs = Iterable[tuple[str, LabSettings, int]]


class _Runner(Protocol):
    def __call__(self, jobs: Jobs) -> Generator[int, None, None]: ...


def _here(workers: int) -> _Runner:
    def run(jobs: Jobs) -> Generator[int, None, None]:
        if workers == 1:
            for job in jobs:
                yield write_shard(*job)
            return
        from joblib import Parallel, delayed  # only where it is used: it starts a resource tracker

        parallel = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
        try:
            yield from parallel(delayed(write_shard)(*job) for job in jobs)
        except BrokenProcessPool as error:
            raise DatasetError(
                "a worker process was ended from outside, perhaps for want of memory; "
                "the same command goes on, with fewer --workers or a smaller dataset.shard"
            ) from error

    return run


def _on_cluster(address: str) -> _Runner:
    def run(jobs: Jobs) -> Generator[int, None, None]:
        try:
            from distributed import Client, KilledWorker, as_completed
            from distributed.comm.core import CommClosedError
        except ModuleNotFoundError as error:
            raise DatasetError("--scheduler needs Dask: pip install 'locagen-edge[lab]'") from error
        try:
            client = Client(  # type: ignore[no-untyped-call]
                address, set_as_default=False
            )
            client.wait_for_workers(1, timeout=NO_WORKER_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise DatasetError(f"--scheduler {address}: no scheduler with a worker there: {error}") from error
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # its tracebacks; what matters is raised
        with client:
            # not pure: a key of its own for every run, lest an earlier run's result is taken for done
            futures = [client.submit(write_shard, *job, pure=False) for job in jobs]
            try:
                for future in as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
                    yield future.result()
            except KilledWorker as error:
                raise DatasetError(f"the cluster lost several workers over one shard: {error}") from error
            except (CancelledError, CommClosedError) as error:
                raise DatasetError(
                    f"--scheduler {address}: was lost; the same command goes on with another"
                ) from error

    return run


# --- reading ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Dataset:
    """A complete data set."""

    paths: tuple[Path, ...]
    samples: int

    def columns(self, *names: str) -> Columns:
        """All samples at once; no name: all columns."""
        shards = [read_shard(path, names) for path in self.paths]
        return {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0]}

    def batches(self, size: int, *names: str, seed: int | None = None) -> Iterator[Columns]:
        """Batches of `size` samples, the last one of what is left; one shard lies in memory at a time.

        With a seed, shards come in random order and samples in random order within their shard.
        """
        rng = None if seed is None else np.random.default_rng(seed)
        order = np.arange(len(self.paths)) if rng is None else rng.permutation(len(self.paths))
        rest: Columns = {}
        for k in order:
            shard = read_shard(self.paths[k], names)
            count = len(next(iter(shard.values())))
            if rng is not None:
                rows = rng.permutation(count)
                shard = {name: column[rows] for name, column in shard.items()}
            if rest:
                shard = {name: np.concatenate([rest[name], shard[name]]) for name in shard}
                count = len(next(iter(shard.values())))
            whole = count - count % size
            for start in range(0, whole, size):
                yield {name: column[start : start + size] for name, column in shard.items()}
            rest = {name: column[whole:] for name, column in shard.items()} if whole < count else {}
        if rest:
            yield rest


def open_dataset(folder: Path, settings: LabSettings) -> Dataset:
    """A complete data set that was made with these settings, in all that a model could learn from it.

    Number of samples, seed and size of shards may differ. Raises `DatasetError` by `section.key` where
    something else does, or where shards are missing.
    """
    paths = tuple(sorted(folder.glob("shard-*.parquet")))
    if not paths:
        raise DatasetError(f"{folder}: holds no data set; make one with: locagen-lab dataset {folder}")
    told = [read_metadata(path) for path in paths]
    for one in told:
        different = differences(one["settings"], plain_toml(settings), LAYOUT)
        if different:
            raise DatasetError(_refusal(folder, different))
        strange = differences(one["settings"], told[0]["settings"])
        if strange or one["recordings"] != told[0]["recordings"]:
            raise DatasetError(f"{folder}: holds shards of two data sets: {', '.join(strange)}")
    count = int(told[0]["shards"])
    missing = sorted(set(range(count)) - {int(one["shard"]) for one in told})
    if missing:
        raise DatasetError(
            f"{folder}: {len(missing)} of {count} shards are missing, {missing[0]} the first; "
            "the command that made the others goes on from there"
        )
    return Dataset(paths, sum(int(one["samples"]) for one in told))
