"""Sightings as JSON lines: what vehicles write and the ground fuses. Angles in degrees, times in UTC.

{"time_utc": "2025-06-01T10:00:00.250Z", "observer": "A", "caller": 1, "latitude_deg": 47.1, ...}

The black box holds them too, among records of other types.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from locagen_edge.errors import ExportError
from locagen_edge.jsonl import Record
from locagen_edge.types import Sighting

TYPE = "sighting"
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
FIELDS = {field.name: field for field in dataclasses.fields(Sighting) if field.name != "t_ns"}
NEEDED = {name for name, field in FIELDS.items() if field.default is dataclasses.MISSING}
LIMITS = {"latitude_deg": 90.0, "longitude_deg": 360.0, "elevation_deg": 90.0}


def _key(name: str) -> str:
    """The name in the file."""
    return name.removesuffix("_rad") + "_deg" if name.endswith("_rad") else name


def line(sighting: Sighting) -> str:
    """One line without its end."""
    return json.dumps(record_of(sighting), allow_nan=False)


def record_of(sighting: Sighting) -> Record:
    """As plain values. `t_ns` has to be UTC since 1970: a vehicle adds the offset of its clock."""
    time = EPOCH + timedelta(microseconds=sighting.t_ns // 1000)
    record: Record = {"time_utc": time.isoformat(timespec="microseconds").replace("+00:00", "Z")}
    for name in FIELDS:
        value = getattr(sighting, name)
        if name.endswith("_rad") and value is not None:
            value = math.degrees(value)
        record[_key(name)] = value
    return record


def read(path: Path) -> Iterator[Sighting]:
    """The sightings of a file; empty lines and records of other types are passed over.

    Raises `ExportError` with file, line and what is wrong.
    """
    try:
        with path.open(encoding="utf-8") as file:
            for number, text in enumerate(file, start=1):
                if text.strip() and (found := _parsed(text, f"{path}:{number}")) is not None:
                    yield found
    except OSError as error:
        raise ExportError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ExportError(f"{path}: is not a text file of JSON lines") from error


def _parsed(text: str, where: str) -> Sighting | None:
    try:
        record = json.loads(text)
    except json.JSONDecodeError as error:
        raise ExportError(f"{where}: is not JSON: {error.msg}") from error
    if not isinstance(record, dict):
        raise ExportError(f"{where}: is not a JSON object: one sighting a line")
    return sighting_of(record, where) if record.get("type", TYPE) == TYPE else None


def sighting_of(record: Record, where: str) -> Sighting:
    """The sighting of a record. Raises `ExportError` that tells where, and what is wrong."""
    missing = [_key(name) for name in FIELDS if name in NEEDED and record.get(_key(name)) is None]
    if "time_utc" not in record:
        missing.insert(0, "time_utc")
    if missing:
        raise ExportError(f"{where}: lacks {', '.join(missing)}")
    values: dict[str, Any] = {}
    for name in FIELDS:
        value = record.get(_key(name))
        if value is None:
            continue
        values[name] = _value(_key(name), value, where)
        if name.endswith("_rad"):
            values[name] = math.radians(values[name])
    return Sighting(t_ns=_time_ns(record["time_utc"], where), **values)


def _value(key: str, value: Any, where: str) -> Any:
    if key == "observer":
        return str(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ExportError(f"{where}: {key}: {value!r} is not a number")
    if abs(value) > LIMITS.get(key, math.inf):
        raise ExportError(f"{where}: {key}: {value!r} is beyond {LIMITS[key]:g}")
    if "sigma" in key and value < 0:
        raise ExportError(f"{where}: {key}: {value!r} is below zero")
    return int(value) if key == "caller" else float(value)


def _time_ns(text: Any, where: str) -> int:
    try:
        time = datetime.fromisoformat(text)
    except (TypeError, ValueError):
        raise ExportError(f"{where}: time_utc: {text!r} is no time like 2025-06-01T10:00:00.250Z") from None
    time = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    return (time - EPOCH) // timedelta(microseconds=1) * 1000
