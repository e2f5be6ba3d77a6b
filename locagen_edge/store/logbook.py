"""The black box for a person: a record as one line of a table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime

from locagen_edge.jsonl import Record

OF_ALL = {"type", "utc", "t_ns"}
OF_A_FRAME = {"bearing", "sighting"}
HEADER = f"{'utc':23}  {'type':10}  what"


def row(record: Record) -> str:
    """One line; a record of a type or form that is not known here is shown as it is."""
    kind = str(record.get("type", ""))
    try:
        text = IN_WORDS[kind](record)
    except (KeyError, TypeError, ValueError, AttributeError):
        text = json.dumps({k: v for k, v in record.items() if k not in OF_ALL})
    utc = str(record.get("utc", "")).removesuffix("+00:00").replace("T", " ")
    return f"{utc:23}  {kind:10}  {text}".replace("\n", " ")


def chosen(records: Iterable[Record], kinds: set[str], since: datetime | None) -> Iterator[Record]:
    """Records of these types (none given: all but those of each frame), not older than `since`."""
    for record in records:
        kind = record.get("type")
        if (kind in kinds if kinds else kind not in OF_A_FRAME) and (since is None or _utc(record) >= since):
            yield record


def _utc(record: Record) -> datetime:
    """A record without a time is of no time: old."""
    try:
        utc = datetime.fromisoformat(record["utc"])
    except (KeyError, TypeError, ValueError):
        return datetime.min.replace(tzinfo=UTC)
    return utc if utc.tzinfo else utc.replace(tzinfo=UTC)


def _direction(track: Record) -> str:
    azimuth, sigma = track["azimuth_deg"], track["azimuth_sigma_deg"]
    parts = [_number(azimuth, "5.1f", "°"), "±" + _number(sigma, ".1f", "°")]
    if track.get("elevation_deg") is not None:
        parts.append(f"el {track['elevation_deg']:.0f}°")
    if track.get("confidence") is not None:
        parts.append(f"confidence {track['confidence']:.2f}")
    return " ".join(parts)


def _snr(value: float | None) -> str:
    return f"snr {_number(value, '.1f', ' dB')}"


def _number(value: float | None, form: str, unit: str) -> str:
    return "---" if value is None else f"{value:{form}}{unit}"


def _bearing(r: Record) -> str:
    detection = r["detection"]
    call = "CALL" if detection["call"] else "    "
    parts = [f"{_number(r['bearing']['azimuth_deg'], '5.1f', '°'):>6}", call, _snr(detection["snr_db"])]
    parts += [f"track {_direction(track)}" for track in r["tracks"]]
    return "  ".join(parts + [f"! {fault}" for fault in r["faults"]])


def _call(r: Record) -> str:
    place = r.get("position") or {}
    where = ""
    if place.get("latitude_deg") is not None:
        sigma = _number(place.get("semi_major_m"), ".0f", " m")
        where = f"  at {place['latitude_deg']:.6f}, {place['longitude_deg']:.6f} ±{sigma}"
    if r["event"] == "begin":
        return f"{r['call']} begins  {_direction(r['track'])}  {_snr(r['snr_db'])}{where}"
    seconds = (r["t_ns"] - r["begin_t_ns"]) * 1e-9
    snippet = f"  calls/{r['snippet']}.flac" if r.get("snippet") else ""
    return f"{r['call']} ends after {seconds:.1f} s, best {_direction(r['best'])}{where}{snippet}"


def _values(r: Record) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in r.items() if name not in OF_ALL)


def _start(r: Record) -> str:
    audio, bearing = r["settings"]["audio"], r["settings"]["bearing"]
    return f"locagen-edge {r['version']}: {audio['source']} source, {bearing['estimator']} estimator"


IN_WORDS: dict[str, Callable[[Record], str]] = {
    "start": _start,
    "stop": lambda _: "",
    "bearing": _bearing,
    "call": _call,
    "sighting": lambda r: f"{r['caller']} at {_direction(r)} from north",
    "fault": lambda r: f"{'! ' if r['event'] == 'begin' else 'cleared: '}{r['text']}",
    "link": lambda r: "up" if r["up"] else f"down: {r['error'] or 'nobody heard yet'}",
    "source": lambda r: f"no sound: {r['fault']}" if r["fault"] else "sound",
    "losses": lambda r: ", ".join(f"{v} {k}" for k, v in r.items() if k not in OF_ALL),
    "listening": lambda r: "listening" if r["on"] else "told to stop listening",
    "parameters": lambda r: _values(r) or "as in the settings file",
    "lost": lambda r: f"{r['records']} records could not be written",
}
