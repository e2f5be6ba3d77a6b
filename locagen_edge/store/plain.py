"""Any of the types that travel, as plain values for JSON: by the names of their fields.

A field that a type gains is kept from then on without a word here. Angles are kept in degrees, `_rad` in a
name becoming `_deg`, an azimuth from 0 to 360; what is not a finite number becomes null, as what is unknown.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from locagen_edge.geometry import compass_deg

DIGITS = 6
"""significant: a microdegree of latitude is 0.1 m, so positions have more"""
LONG = ("latitude_deg", "longitude_deg")


def plain(value: Any) -> Any:
    """Dictionaries, lists, texts and numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dict(_entry(f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
    if isinstance(value, (tuple, list, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    return value


def _entry(name: str, value: Any) -> tuple[str, Any]:
    if name in LONG and value is not None:
        return name, round(float(value), 8) if math.isfinite(value) else None
    if not name.endswith("_rad"):
        return name, plain(value)
    name = name.removesuffix("_rad") + "_deg"
    if value is None or not math.isfinite(value):
        return name, None
    return name, plain(compass_deg(value) if name == "azimuth_deg" else math.degrees(value))
