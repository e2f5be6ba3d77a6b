"""Makes the tables of parameters, commands and switches in docs/mavlink.md, from the code that they describe.

    python -m locagen_edge.mavlink.build_docs docs/mavlink.md

A build tool: nothing that flies imports it. The tables of our own messages are `build_dialect.py`'s.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

from locagen_edge.files import write
from locagen_edge.mavlink import commands, dialect
from locagen_edge.mavlink.parameters import NAMES, TABLE, field_of, value_of
from locagen_edge.settings import FlightSettings, MavlinkSettings, Settings


def parameters() -> list[str]:
    """A line for each parameter, in the order of the protocol's index."""
    lines = ["| parameter | setting | default | limits | |", "| --- | --- | --- | --- | --- |"]
    for name in NAMES:
        meta = field_of(name).metadata
        least, most = (0, 1) if TABLE[name].startswith("mavlink.send") else (meta["least"], meta["most"])
        limits = f"{least:g} to {most:g} {meta['unit']}".strip()
        text = meta["text"].partition(". ")[0].rstrip(".") + "."
        lines.append(f"| `{name}` | `{TABLE[name]}` | {value_of(Settings(), name):g} | {limits} | {text} |")
    return lines


def obeyed() -> list[str]:
    """A line for each command that is ours to obey."""
    lines = ["| command | | |", "| --- | --- | --- |"]
    return lines + [f"| {id} | `{one.name}` | {one.text} |" for id, one in commands.TABLE.items()]


def switches() -> list[str]:
    """A line for each switch, of messages and of commands."""
    texts = {f.name: f.metadata["text"] for f in dataclasses.fields(MavlinkSettings)}
    flight = {f.name: f.metadata["text"] for f in dataclasses.fields(FlightSettings)}
    named = {id: kind.msgname for id, kind in dialect.messages.mavlink_map.items()}

    def names(ids: frozenset[int]) -> str:
        return ", ".join(f"{named[id]} ({id})" for id in sorted(ids))

    lines = ["| switch | default | lets out | |", "| --- | --- | --- | --- |"]
    lines.append(f"| none | | {names(dialect.ALWAYS_SENT)} | |")
    for name, ids in dialect.SWITCHED.items():
        on = "on" if getattr(MavlinkSettings(), name) else "off"
        lines.append(f"| `mavlink.{name}` | {on} | {names(ids)} | {texts[name]} |")
    for name, id in dialect.FLIGHT_COMMANDS.items():
        lines.append(f"| `flight.{name}`, settings file alone | off | command {id} | {flight[name]} |")
    return lines


TABLES: dict[str, Callable[[], list[str]]] = {
    "parameters": parameters,
    "commands": obeyed,
    "switches": switches,
}


def with_tables(text: str) -> str:
    """The document with its tables made anew. Raises `SystemExit` where the marks of one are missing."""
    for name, table in TABLES.items():
        begin, end = f"<!-- {name}: made by `make format` -->", f"<!-- {name}: end -->"
        before, found, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not (found and ended):
            raise SystemExit(f"the document has no {begin} and {end}")
        text = f"{before}{begin}\n\n" + "\n".join(table()) + f"\n\n{end}{after}"
    return text


def main(path: str) -> None:
    """Renews the tables in a Markdown file."""
    write(Path(path), with_tables(Path(path).read_text(encoding="utf-8")))


if __name__ == "__main__":
    main(sys.argv[1])
