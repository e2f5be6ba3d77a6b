"""One file of a data set: Parquet, complete or not there, and telling all that it was made from.

A shard holds the samples `number * shard` and following of a seed's endless row, so it can be made anywhere
and in any order. Its metadata hold the settings as TOML, version, seed, level, its place in the set, and a
hash of every column. It gets its name only after every byte is on the disk: whatever happens in between (a
full disk, a kill, a power cut) leaves no broken file under a final name.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tomllib
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from locagen_edge import __version__
from locagen_edge.errors import DatasetError
from locagen_edge.lab.columns import MEANING, Columns, columns
from locagen_edge.lab.recordings import fingerprint
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import sample
from locagen_edge.sim.waveforms import RECORDED
from locagen_edge.types import Array

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
TEMPORARY = ".part"

Metadata = dict[str, str]

MATTERS: dict[str, tuple[str, ...]] = {
    "array": ("positions_m", "mount_deg"),
    "environment": (),
    "audio": ("rate_hz", "frame", "hop"),
    "correlation": (),
    "twin": (),
    "scene": (),
    "data": ("samples", "seed"),
    "dataset": (),
}
"""Sections and keys (none named: all) on which the samples depend; models and links are not among them."""

LAYOUT = ("data.samples", "data.seed", "dataset.shard", "dataset.keep")
"""Of these, what makes no difference to a model that learns from the samples."""


def shard_count(settings: LabSettings) -> int:
    return -(-settings.data.samples // settings.dataset.shard)


def shard_path(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.parquet"


def shard_samples(settings: LabSettings, number: int) -> int:
    """Samples in a shard; the last one may hold fewer."""
    return min(settings.dataset.shard, settings.data.samples - number * settings.dataset.shard)


# --- metadata -----------------------------------------------------------------------------------------


def plain_toml(settings: LabSettings) -> str:
    """All settings without the manual's sentences."""
    lines = sample(settings).splitlines()
    return "\n".join(line for line in lines if line and not line.startswith("#")) + "\n"


def metadata(settings: LabSettings, number: int) -> Metadata:
    """What a shard of these settings says of itself, less the hashes of its columns."""
    recorded = RECORDED in settings.scene.sounds and settings.dataset.level == "waveforms"
    return {
        "settings": plain_toml(settings),
        "version": __version__,
        "level": settings.dataset.level,
        "seed": str(settings.data.seed),
        "shard": str(number),
        "shards": str(shard_count(settings)),
        "first": str(number * settings.dataset.shard),
        "samples": str(shard_samples(settings, number)),
        "recordings": fingerprint(settings.scene.recordings, settings.audio.rate_hz) if recorded else "",
    }


def differences(there: str, asked: str, ignored: tuple[str, ...] = ()) -> list[str]:
    """`section.key: this there, that asked for`, for all keys that matter and differ in two TOML texts."""
    if there == asked:
        return []
    found, wanted = _keys(there), _keys(asked)
    return [
        f"{key}: {found.get(key, 'nothing')} there, {wanted.get(key, 'nothing')} asked for"
        for key in {**wanted, **found}
        if key not in ignored and found.get(key) != wanted.get(key)
    ]


def _keys(text: str) -> dict[str, Any]:
    table = tomllib.loads(text)
    arrivals = table["dataset"]["level"] == "arrivals"
    return {
        f"{section}.{key}": value
        for section, keys in MATTERS.items()
        if not (arrivals and section == "scene")
        for key, value in table.get(section, {}).items()
        if not keys or key in keys
    }


def read_metadata(path: Path) -> Metadata:
    """Raises `DatasetError` where the file is not a shard."""
    try:
        found = pq.read_schema(path).metadata or {}
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path}: is not a readable shard: {error}") from error
    told = {key.decode(): value.decode() for key, value in found.items() if key.startswith(PREFIX)}
    told = {key.removeprefix(PREFIX.decode()): value for key, value in told.items()}
    if "settings" not in told:
        raise DatasetError(f"{path}: is not a shard of a data set of locagen-edge")
    return told


PREFIX = b"locagen."

# --- writing ------------------------------------------------------------------------------------------


def write_shard(folder: str, settings: LabSettings, number: int) -> int:
    """Makes a shard where it is not there yet; returns its number.

    Raises `DatasetError` where the disk is full or refuses.
    """
    path = shard_path(Path(folder), number)
    if not path.exists():  # a second attempt after a lost worker may find the first one's work
        first = number * settings.dataset.shard
        drawn = columns(settings, shard_samples(settings, number), settings.data.seed, first)
        _publish(path, encode(drawn, metadata(settings, number)))
    return number


def encode(drawn: Columns, told: Metadata) -> bytes:
    """A Parquet file; the same bytes for the same columns, with the same pyarrow."""
    hashes = json.dumps({name: _hash(column) for name, column in drawn.items()})
    schema = pa.schema(
        [_field(name, column) for name, column in drawn.items()],
        metadata={PREFIX + key.encode(): value for key, value in {**told, "sha256": hashes}.items()},
    )
    table = pa.Table.from_arrays([_to_arrow(column) for column in drawn.values()], schema=schema)
    sink = pa.BufferOutputStream()
    pq.write_table(
        table, sink, version="2.6", compression="zstd", use_dictionary=[n for n in drawn if n == "kind"]
    )
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _field(name: str, column: Array) -> Any:
    unit, text = MEANING[name]
    told = {"unit": unit, "text": text, "shape": json.dumps(column.shape[1:])}
    return pa.field(name, _to_arrow(column[:0]).type, nullable=False, metadata=told)


def _to_arrow(column: Array) -> Any:
    if column.dtype.kind == "U":
        return pa.array(column.tolist(), pa.string())
    flat = pa.array(np.ascontiguousarray(column).reshape(-1))
    if column.ndim == 1:
        return flat
    return pa.FixedSizeListArray.from_arrays(flat, int(np.prod(column.shape[1:])))


def _hash(column: Array) -> str:
    content = (
        "\0".join(column.tolist()).encode()
        if column.dtype.kind == "U"
        else np.ascontiguousarray(column).tobytes()
    )
    return hashlib.sha256(content).hexdigest()


def _publish(path: Path, content: bytes) -> None:
    """The content under its name, all of it or none."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")
    try:
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync(path.parent)
    except OSError as error:
        why = "the disk is full" if error.errno in FULL else error.strerror
        raise DatasetError(
            f"{path}: not written: {why}; what is complete stays, and the same command goes on from there"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _sync(folder: Path) -> None:
    """The folder's list of names to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# --- reading ------------------------------------------------------------------------------------------


def read_shard(path: Path, names: tuple[str, ...] = ()) -> Columns:
    """Columns of a shard by name (none: all), each (samples, ...).

    Raises `DatasetError` where a column is missing or not what was written.
    """
    hashes = json.loads(read_metadata(path)["sha256"])
    missing = [name for name in names if name not in hashes]
    if missing:
        raise DatasetError(f"{path}: has no column {', '.join(missing)}; it has {', '.join(hashes)}")
    try:
        table = pq.ParquetFile(path).read(columns=list(names) or None)
        read = {name: _from_arrow(table.column(name), table.schema.field(name)) for name in names or hashes}
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{path}: is damaged: {error}; delete it and make it again") from error
    for name, column in read.items():
        if _hash(column) != hashes[name]:
            raise DatasetError(f"{path}: column {name} is damaged; delete the file and make it again")
    return read


def _from_arrow(column: Any, field: Any) -> Array:
    whole = column.combine_chunks()
    if pa.types.is_string(field.type):
        return np.array(whole.to_pylist(), dtype=np.str_)
    shape = json.loads(field.metadata[b"shape"])
    if shape:
        whole = whole.flatten()
    values: Array = whole.to_numpy(zero_copy_only=False).reshape(-1, *shape)
    return values
