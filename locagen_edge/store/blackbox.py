"""The black box: what the daemon heard and what befell it, on disk, whether or not anybody was listening.

One JSON object a line (`store/journal.py`), each with `type`, `utc` (ISO 8601) and `t_ns` (monotonic; clocks
of small computers jump when they first learn the time, this one does not):

- `start`: `version`, `settings`; `stop` at an orderly end;
- `bearing`: all of an `Estimate` by the names of its fields (`store/plain.py`: angles in degrees). Every
  one while something calls, or a track lives; one a second else;
- `call`: `event` begin or end, `call` (counted from 1 since the start), `track` as it was then, `snr_db`,
  `level_dbfs`, `pose` of the vehicle and `position` of the caller (or null); at its end, `utc` being that of
  the last frame with it, also `begin_utc`, `begin_t_ns`, `best` (the track when its sigma was least) and
  `snippet` (a name in the folder `calls`, or null);
- `sighting`: a look that went into a position (`sightings.py`), which `locagen-edge fuse` reads;
- `fault`: `event` begin or end, `text`;
- `link`, `source`, `losses`, `listening` (`on`: as commanded), `parameters` (by name, those that differ from
  the settings file): a state of the daemon that has changed;
- `lost`: `records` that could not be written.

Written in a thread of its own behind a bounded queue. A disk that is full or read-only is told once and tried
again every `RETRY_S`; what was lost meanwhile is counted, and the daemon flies on.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from locagen_edge import __version__
from locagen_edge.errors import ExportError, StorageError
from locagen_edge.jsonl import Record
from locagen_edge.settings import Settings
from locagen_edge.sightings import TYPE as SIGHTING
from locagen_edge.sightings import record_of, sighting_of
from locagen_edge.store.journal import Journal, records
from locagen_edge.store.plain import plain
from locagen_edge.store.snippets import Snippets
from locagen_edge.store.worker import Worker
from locagen_edge.types import Estimate, Frame, Sighting, Track

log = logging.getLogger(__name__)

MB = 1_000_000
WAITING = 256
"""items that may wait for the disk: 12 s of frames"""
RETRY_S = 5.0
QUIET_S = 1.0
FAULT_GONE_S = 5.0
"""a fault has gone when it stayed away so long: one that flickers is one"""
CALLS = "calls"
OF_A_CALL = ("truth", "pose")
NOT_OF_A_BEARING = ("t_ns", "sightings")


def sightings(directory: Path) -> Iterator[Sighting]:
    """What a black box holds for `fusion.fuse`; damaged records are passed over. Raises `StorageError`."""
    try:
        for record in records(directory):
            if record.get("type") == SIGHTING:
                with suppress(ExportError):
                    yield sighting_of(record, str(directory))
    except OSError as error:
        raise StorageError(f"{error.filename or directory}: {error.strerror}") from error


def directory_of(settings: Settings) -> Path | None:
    """Where the log is kept: by settings, else by the service manager (systemd.exec(5)); None: nowhere."""
    given = settings.log.directory or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(given) if given else None


@dataclass(frozen=True, eq=False)
class _Heard:
    frame: Frame
    estimate: Estimate
    utc_ns: int
    """of the frame's first sample"""
    settings: Settings
    """it was heard with"""


@dataclass
class _Call:
    number: int
    begin: Record
    track: Track
    best: Track
    last: _Heard
    snippet: str = ""


class BlackBox:
    """Its methods are quick, and never raise for what the disk does. `confirmed`: is this track a call?"""

    def __init__(self, directory: Path, settings: Settings, confirmed: Callable[[Track], bool]) -> None:
        log_settings = settings.log
        self._confirmed = confirmed
        self._sync_s = log_settings.sync_s
        self._journal = Journal(
            directory, round(log_settings.total_mb * MB), round(log_settings.part_mb * MB)
        )
        self._snippets = Snippets(directory / CALLS, settings) if log_settings.snippets else None
        self._directory = directory
        self._settings = settings
        # numbers of callers begin anew with each start, and another start is another observer
        self._observer = f"{settings.position.vehicle or socket.gethostname()} {_iso(time.time_ns())[:19]}Z"
        self._states: dict[str, Any] = {}
        self._lost = 0
        self._unsaid = 0  # of these, not yet told by a record
        self._retry_s: float | None = None  # while the disk does not take anything
        self._snippets_told = False
        self._synced_s = 0.0
        self._quiet_ns: int | None = None
        self._calls: dict[int, _Call] = {}  # by track
        self._called = 0
        self._faults: dict[str, int] = {}  # and when each was last there
        self._worker: Worker[_Heard | Record] = Worker(
            "black box", WAITING, self._write, self._sync_if_due, self._end, self._sync_s / 4
        )
        self._worker.put(
            _now("start", version=__version__, settings=dataclasses.asdict(settings)),
        )

    @property
    def lost(self) -> int:
        """Records that the disk was too slow for, or did not take."""
        return self._lost + self._worker.dropped

    def hear(self, frame: Frame, estimate: Estimate) -> None:
        """What the pipeline made of a frame."""
        utc_ns = time.time_ns() - time.monotonic_ns() + frame.t_ns
        self._worker.put(_Heard(frame, estimate, utc_ns, self._settings))

    def apply(self, settings: Settings) -> None:
        """What the pipeline hears with from here on. Bounds stay those of the beginning."""
        self._settings = settings

    def watch(self, **states: dict[str, Any]) -> None:
        """The daemon's states by name: a change makes a record of this type."""
        for name, state in states.items():
            if self._states.get(name) != state and self._worker.put(_now(name, **state), urgent=True):
                self._states[name] = state

    def close(self, timeout_s: float) -> bool:
        """Writes what waits, and ends. False: the disk hangs."""
        return self._worker.close(timeout_s)

    # --- in the writing thread

    def _write(self, item: _Heard | Record) -> None:
        if isinstance(item, dict):
            self._append(item, urgent=True)
        else:
            self._hear(item)

    def _hear(self, heard: _Heard) -> None:
        estimate = heard.estimate
        tracks = {track.id: track for track in estimate.tracks}
        before = self._called
        self._follow_calls(heard, tracks)
        self._record_sound(heard, begins=self._called > before)
        self._follow_faults(heard)
        if estimate.detection.call or tracks or self._is_due(heard.frame.t_ns):
            self._quiet_ns = heard.frame.t_ns
            told = {k: v for k, v in plain(estimate).items() if k not in NOT_OF_A_BEARING}
            self._append(_at(heard, "bearing", **told))
        for look in estimate.sightings:
            t_ns = look.t_ns - heard.frame.t_ns + heard.utc_ns
            told = record_of(dataclasses.replace(look, t_ns=t_ns, observer=self._observer))
            self._append(_at(heard, SIGHTING, **told))

    def _is_due(self, t_ns: int) -> bool:
        return self._quiet_ns is None or not 0 <= t_ns - self._quiet_ns < QUIET_S * 1e9

    def _follow_calls(self, heard: _Heard, tracks: dict[int, Track]) -> None:
        for id in self._calls.keys() - tracks.keys():
            self._end_call(self._calls.pop(id))
        for id, track in tracks.items():
            known = self._calls.get(id)
            if known is not None:
                known.track, known.last = track, heard
                if track.azimuth_sigma_rad < known.best.azimuth_sigma_rad:
                    known.best = track
            elif self._confirmed(track):
                self._called += 1
                begin = _call_record(heard, "begin", self._called, track)
                self._calls[id] = _Call(self._called, begin, track, track, heard)
                self._append(begin, urgent=True)

    def _end_call(self, call: _Call) -> None:
        record = _call_record(call.last, "end", call.number, call.track)
        record["begin_utc"], record["begin_t_ns"] = call.begin["utc"], call.begin["t_ns"]
        record["best"] = plain(call.best)
        record["snippet"] = call.snippet or None
        self._append(record, urgent=True)

    def _record_sound(self, heard: _Heard, *, begins: bool) -> None:
        if self._snippets is None:
            return
        self._snippets.apply(heard.settings)
        try:
            utc = datetime.fromtimestamp(heard.utc_ns * 1e-9, UTC)
            name = self._snippets.hear(heard.frame, utc, begins=begins, calling=bool(self._calls))
        except (OSError, StorageError) as error:
            if not self._snippets_told:
                log.warning("the sound of calls is not kept: %s", _words(error))
            self._snippets_told = True
            return
        for call in self._calls.values():
            call.snippet = call.snippet or name

    def _follow_faults(self, heard: _Heard) -> None:
        t_ns = heard.frame.t_ns
        for text in heard.estimate.faults:
            if text not in self._faults:
                self._append(_at(heard, "fault", event="begin", text=text), urgent=True)
            self._faults[text] = t_ns
        for text, last_ns in list(self._faults.items()):
            if t_ns - last_ns > FAULT_GONE_S * 1e9:
                del self._faults[text]
                self._append(_at(heard, "fault", event="end", text=text), urgent=True)

    def _append(self, record: Record, *, urgent: bool = False) -> None:
        if self._retry_s is not None and time.monotonic() < self._retry_s:
            self._lose()
            return
        try:
            if self._unsaid and self._journal.append(_now("lost", records=self._unsaid)):
                self._unsaid = 0
            if not self._journal.append(record):
                self._lose()
            if urgent:
                self._journal.sync()
        except OSError as error:
            self._lose()
            self._fail(error)
            return
        if self._retry_s is not None:
            self._retry_s = None
            log.info("the log is written again")

    def _lose(self) -> None:
        self._lost += 1
        self._unsaid += 1

    def _fail(self, error: OSError) -> None:
        if self._retry_s is None:
            log.warning("%s: the log is not written: %s", self._directory, _words(error))
        self._retry_s = time.monotonic() + RETRY_S

    def _sync_if_due(self) -> None:
        if time.monotonic() - self._synced_s < self._sync_s:
            return
        self._synced_s = time.monotonic()
        try:
            self._journal.sync()
        except OSError as error:
            self._fail(error)

    def _end(self) -> None:
        for call in self._calls.values():
            self._end_call(call)
        self._append(_now("stop"))
        try:
            if self._snippets is not None:
                self._snippets.end()
            self._journal.close()
        except (OSError, StorageError) as error:
            log.warning("%s: %s", self._directory, _words(error))


def _call_record(heard: _Heard, event: str, number: int, track: Track) -> Record:
    estimate = heard.estimate
    return _at(
        heard,
        "call",
        event=event,
        call=number,
        track=plain(track),
        snr_db=plain(estimate.detection.snr_db),
        level_dbfs=plain(estimate.detection.level_dbfs),
        **{name: plain(getattr(estimate, name)) for name in OF_A_CALL},
        position=plain(estimate.position(track)),
    )


def _at(heard: _Heard, kind: str, **values: Any) -> Record:
    return {"type": kind, "utc": _iso(heard.utc_ns), **values, "t_ns": heard.frame.t_ns}


def _now(kind: str, **values: Any) -> Record:
    return {"type": kind, "utc": _iso(time.time_ns()), "t_ns": time.monotonic_ns(), **values}


def _iso(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns * 1e-9, UTC).isoformat(timespec="milliseconds")


def _words(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
