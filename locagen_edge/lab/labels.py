"""Where the caller of a field recording really was: labels beside WAV files, as CSV or JSON lines.

A folder holds recordings and one of `labels.csv` (first line: names of columns) and `labels.jsonl` (an object
a line). A label is one moment of one recording:

    file            recording, relative to the folder
    time_s          since its beginning, to be met by the middle of a frame
    azimuth_deg     of the caller, clockwise from ahead of the array
      or lat, lon, array_lat, array_lon, heading_deg: WGS-84 degrees of caller and array, and where the
      array's x axis points, clockwise from true north; alt_m and array_alt_m beside them, if they are known
    range_m         if known: metres from the array's middle; from GPS where that is given
    snr_db          if known: in-band, call over noise; else what the detector measures
    note            for people

Every fault of every line is told at once, by file, line and column.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import DatasetError
from locagen_edge.geodesy import north_east_down_m

NAMES = ("labels.csv", "labels.jsonl")

LIMITS: dict[str, tuple[float, float]] = {
    "time_s": (0.0, 1e7),
    "azimuth_deg": (-360.0, 360.0),
    "range_m": (0.01, 1e5),
    "snr_db": (-60.0, 120.0),
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "alt_m": (-1000.0, 100_000.0),
    "array_lat": (-90.0, 90.0),
    "array_lon": (-180.0, 180.0),
    "array_alt_m": (-1000.0, 100_000.0),
    "heading_deg": (-360.0, 360.0),
}
"""Columns that hold numbers, with the least and the largest."""

COLUMNS = ("file", *LIMITS, "note")
GPS = ("lat", "lon", "array_lat", "array_lon", "heading_deg")

Row = tuple[int, dict[str, Any]]
"""number of the line, values by column"""


@dataclass(frozen=True, slots=True)
class Label:
    """What is true at one moment of one recording."""

    place: str
    """file and line of the label, for messages"""
    file: str
    """as it is written there"""
    time_s: float
    azimuth_rad: float
    range_m: float | None
    snr_db: float | None


def read_labels(folder: Path) -> list[Label]:
    """All labels of a folder, in their order. Raises `DatasetError` with one fault per line."""
    there = [folder / name for name in NAMES if (folder / name).is_file()]
    if len(there) != 1:
        what = "both" if there else "neither"
        raise DatasetError(f"{folder}: holds {what} of {' and '.join(NAMES)}; one is needed")
    (path,) = there
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin a file with a mark
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: is not UTF-8 text") from error
    faults: list[str] = []
    rows = list((_rows_of_csv if path.suffix == ".csv" else _rows_of_json)(path, text, faults))
    labels = [label for row in rows if (label := _label(folder, path, row, faults)) is not None]
    if not rows and not faults:
        faults.append(f"{path}: holds no label")
    if faults:
        raise DatasetError("\n".join(faults))
    return labels


def _rows_of_csv(path: Path, text: str, faults: list[str]) -> Iterator[Row]:
    reader = csv.reader(io.StringIO(text), skipinitialspace=True)
    names = [name.strip() for name in next(reader, [])]
    unknown = [name for name in names if name not in COLUMNS]
    if unknown:
        faults += [f"{path}:1: {name}: unknown column; known are {', '.join(COLUMNS)}" for name in unknown]
        return
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            faults.append(f"{path}:{reader.line_num}: {len(cells)} values for {len(names)} columns")
            continue
        filled = {name: cell.strip() for name, cell in zip(names, cells, strict=True) if cell.strip()}
        yield reader.line_num, filled


def _rows_of_json(path: Path, text: str, faults: list[str]) -> Iterator[Row]:
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except ValueError as error:
            faults.append(f"{path}:{number}: is not JSON: {error}")
            continue
        if not isinstance(row, dict):
            faults.append(f"{path}:{number}: is not an object of columns")
            continue
        unknown = [name for name in row if name not in COLUMNS]
        faults += [f"{path}:{number}: {n}: unknown column; known are {', '.join(COLUMNS)}" for n in unknown]
        yield number, {name: value for name, value in row.items() if value is not None}


def _label(folder: Path, path: Path, row: Row, faults: list[str]) -> Label | None:
    number, values = row
    place = f"{path}:{number}"
    before = len(faults)
    file = values.get("file")
    if not isinstance(file, str) or not file:
        faults.append(f"{place}: file: is missing")
    elif not (folder / file).is_file():
        faults.append(f"{place}: file: there is no {folder / file}")
    found: dict[str, float] = {}
    for name in LIMITS:
        if name in values:
            fault = _number(name, values[name], found)
            if fault:
                faults.append(f"{place}: {name}: {fault}")
    if "time_s" not in values:
        faults.append(f"{place}: time_s: is missing")
    missing = [name for name in GPS if name not in values]
    if "azimuth_deg" not in values and missing:
        faults.append(f"{place}: azimuth_deg: is missing, and for a place by GPS {', '.join(missing)}")
    if len(faults) > before:
        return None
    azimuth, range_m = _direction(found)
    return Label(place, str(file), found["time_s"], azimuth, range_m, found.get("snr_db"))


def _number(name: str, value: Any, found: dict[str, float]) -> str:
    """Puts the number into `found`, or tells what is wrong with it."""
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError):
        return f"{value!r} is not a number"
    least, most = LIMITS[name]
    if not math.isfinite(number):
        return f"{value!r} is not a finite number"
    if not least <= number <= most:
        return f"{number:g} is outside {least:g} to {most:g}"
    found[name] = number
    return ""


def _direction(found: dict[str, float]) -> tuple[float, float | None]:
    """Azimuth and range; what is stated goes before what GPS gives."""
    azimuth, range_m = math.radians(found.get("azimuth_deg", 0.0)), found.get("range_m")
    if all(name in found for name in GPS):
        to = (found["lat"], found["lon"], found.get("alt_m", 0.0))
        away = north_east_down_m(*to, found["array_lat"], found["array_lon"], found.get("array_alt_m", 0.0))
        range_m = float(np.linalg.norm(away)) if range_m is None else range_m
        if "azimuth_deg" not in found:
            azimuth = math.atan2(away[1], away[0]) - math.radians(found["heading_deg"])
    return math.remainder(azimuth, 2.0 * math.pi), range_m
