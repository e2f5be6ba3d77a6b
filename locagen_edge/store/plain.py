"""Any of the types that travel, as plain values for JSON: by the names of their fields.

A field that a type gains is kept from then on without a word here. Angles are kept in degrees, `_rad` in a
name becoming `_deg`, an azimuth from 0 to 360; what is not a finite number becomes null, as what is unknown.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable
from typing import Any, cast

import numpy as np

from locagen_edge.geometry import compass_deg

DIGITS = 6
"""significant: a microdegree of latitude is 0.1 m, so positions have more"""
LONG = ("latitude_deg", "longitude_deg")
AS_IT_IS = frozenset({type(None), bool, int, str})
"""types that JSON has too"""


def plain(value: Any) -> Any:
    """Dictionaries, lists, texts and numbers."""
    kind = type(value)
    if kind is float or isinstance(value, np.floating):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    if kind in AS_IT_IS:
        return value
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.bool_, np.integer)):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value):
        return {name: tell(getattr(value, field)) for field, name, tell in _entries(cast(Hashable, kind))}
    return value


@functools.cache
def _entries(kind: Any) -> list[tuple[str, str, Callable[[Any], Any]]]:
    """Of a dataclass: its fields, their names here, and what makes plain values of them."""
    return [(field.name, *_entry(field.name)) for field in dataclasses.fields(kind)]


def _entry(name: str) -> tuple[str, Callable[[Any], Any]]:
    if name in LONG:
        return name, _degrees_of_place
    if not name.endswith("_rad"):
        return name, plain
    name = name.removesuffix("_rad") + "_deg"
    return name, _compass if name == "azimuth_deg" else _degrees


def _degrees_of_place(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), 8)


def _compass(value: Any) -> float | None:
    return None if value is None else plain(compass_deg(value))


def _degrees(value: Any) -> float | None:
    return None if value is None else plain(math.degrees(value))
