"""The command line: the only place that prints for people and exits.

Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import json
import logging
import math
import os
import shutil
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from locagen_edge import __version__, stopping
from locagen_edge.errors import (
    CalibrationError,
    ExportError,
    LocagenError,
    SourceError,
    SourceHungError,
    StorageError,
)
from locagen_edge.geometry import compass_deg
from locagen_edge.journald import formatter
from locagen_edge.memory import one_arena
from locagen_edge.notify import notify
from locagen_edge.restarts import forget, put_off_s
from locagen_edge.settings import DEFAULT_PATH, Settings, load
from locagen_edge.types import Estimate, Frame, Position, Track

if TYPE_CHECKING:
    from locagen_edge.daemon import Daemon
    from locagen_edge.export import Callers, Told
    from locagen_edge.framing import Losses
    from locagen_edge.jsonl import Record
    from locagen_edge.mavlink.links import Links
    from locagen_edge.store.recorder import Progress, Recorder

EXPORT_S = 5.0
"""How often `run --export` writes what is new."""
EXPORT = "write callers to a map file, their places or bearings: .geojson, .kml or .gpx says the format"
SERVICE_STATE = Path("/var/lib/locagen-edge")
TYPES = (
    *("start", "stop", "bearing", "call", "sighting", "fault", "link", "source", "losses"),
    *("listening", "parameters", "lost"),
)


def main(argv: list[str] | None = None) -> None:
    """Entry point of `locagen-edge`."""
    # started with them closed: what is opened next must not become them either
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    arguments = _parser().parse_args(argv)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(sys.stderr))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without a degree sign is no reason to stop
    if arguments.command not in (_run, _record):  # these two run until they are stopped
        stopping.with_code(128 + signal.SIGTERM)
    try:
        code = arguments.command(arguments)
    except SourceHungError as error:
        _leave(str(error))
    except LocagenError as error:
        for line in str(error).splitlines():  # one fault each
            print(f"locagen-edge: {line}", file=sys.stderr)
        code = 1
    except BrokenPipeError:  # `| head` has seen enough: not a failure, and nothing may be written any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except OSError as error:
        print(f"locagen-edge: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _leave(text: str) -> NoReturn:
    """Ends at once. An orderly exit would wait for what hangs in a driver or in the pipeline."""
    print(f"locagen-edge: {text}", file=sys.stderr, flush=True)
    os._exit(1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="locagen-edge",
        description="Hears a call for help with a small microphone array and tells where it comes from.",
        epilog="Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage.",
    )
    parser.add_argument("--version", action="version", version=f"locagen-edge {__version__}")
    with_settings = argparse.ArgumentParser(add_help=False)
    with_settings.add_argument(
        "--settings",
        type=Path,
        metavar="FILE",
        help=f"TOML settings (default: {DEFAULT_PATH} where it exists, else the built-in defaults)",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(
        name: str, function: Callable[[argparse.Namespace], int], text: str, more: str, settings: bool = True
    ) -> Any:
        sub = commands.add_parser(
            name,
            parents=[with_settings] if settings else [],
            help=text,
            description=f"{text[0].upper()}{text[1:]}. {more}",
        )
        sub.set_defaults(command=function)
        return sub

    run = command(
        "run",
        _run,
        "listen, and send bearings over MAVLink until stopped",
        "Prints one line per second: time, bearing in degrees clockwise from ahead with its 1-sigma, "
        "elevation, the true bearing where a simulation knows it, SNR, and what was sent. "
        "SIGINT or SIGTERM ends it within a second.",
    )
    run.add_argument("--seconds", type=_positive, metavar="N", help="stop after N seconds")
    run.add_argument("--quiet", action="store_true", help="no line per second (under a service manager)")
    run.add_argument("--record", type=Path, metavar="DIR", help="keep the sound too, as `record` does")
    run.add_argument("--export", type=Path, metavar="FILE", help=EXPORT)

    replay = command(
        "replay",
        _replay,
        "run a recording through the same pipeline, faster than real time",
        "One line per hop on standard output. t_s is the time of the frame's first sample; azimuth_deg is "
        "clockwise from ahead, 0 to 360; elevation_deg is positive up; sigma_deg is the azimuth's 1-sigma; "
        "null means that nothing can be said. The estimate is given whether or not `call` is true; `callers` "
        "are all that are followed. A call "
        "stands out of the background: a sound that is there from the first frame to the last is none.",
    )
    replay.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE.wav",
        help="WAV or FLAC, any rate and channel count; several, or a folder of them, are one after another",
    )
    replay.add_argument(
        "--format", choices=("jsonl", "table"), default="jsonl", help="JSON lines (default) or a table"
    )

    replay.add_argument("--export", type=Path, metavar="FILE", help=EXPORT)

    record = command(
        "record",
        _record,
        "keep all channels of the source on disk, in parts, as they come",
        "Parts are WAV with the device's rate and channels; beside each are its settings and how the sound "
        "came, so that `replay DIR` gives the bearings of the day. What a loss of power leaves behind is "
        "mended by the next start in the same folder. Bounds are in the settings under [record]. SIGINT or "
        "SIGTERM ends it.",
    )
    record.add_argument(
        "--output", type=Path, metavar="DIR", help="where the parts go (default: record.directory)"
    )
    record.add_argument("--seconds", type=_positive, metavar="N", help="stop after N seconds of sound")
    record.add_argument(
        "--poses",
        action="store_true",
        help="keep the vehicle's poses too, from mavlink.link: not while `run` has that link",
    )

    log = command(
        "log",
        _log,
        "print the black box of `run`: calls, faults, links, losses, what was set in flight, and on request "
        "every bearing",
        "A record that a loss of power has torn is passed over.",
    )
    log.add_argument(
        "directory",
        type=Path,
        nargs="?",
        metavar="DIR",
        help=f"where it is (default: log.directory, else {SERVICE_STATE})",
    )
    log.add_argument(
        "--type", action="append", default=[], choices=TYPES, help="only these; more than once for several"
    )
    log.add_argument("--since", type=_moment, metavar="TIME", help="not older: ISO 8601, in UTC")
    log.add_argument("--last", type=_count, metavar="N", help="the last N lines")
    log.add_argument(
        "--format", choices=("table", "jsonl"), default="table", help="a table (default) or the records"
    )

    fuse = command(
        "fuse",
        _fuse,
        "find callers on the map from the sightings of one or several vehicles",
        "Reads the black boxes of `run`, or JSON lines of one sighting each, and prints one line per caller: "
        "place, 1-sigma ellipse, and which vehicles saw it. With -o also a map file.",
    )
    fuse.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="sightings (.jsonl), or the folder of a black box"
    )
    fuse.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="map file: .geojson, .kml or .gpx says the format"
    )

    command(
        "devices",
        _devices,
        "list the capture devices",
        "The name is what audio.device looks for.",
        settings=False,
    )
    check = command(
        "check",
        _check,
        "check settings, models, microphones and link, and say what to do",
        "Listens to the source of the settings for some seconds, at least one. Exit code 1 where anything is "
        "wrong.",
    )
    check.add_argument(
        "--seconds", type=_positive, default=2.0, metavar="N", help="how long to listen (default 2)"
    )
    calibrate = command(
        "calibrate",
        _calibrate,
        "measure the microphones' places, channel delays and gains from a sound walked round the array",
        "Put the array level in the open, motors off, and walk once or more all the way round it, a few "
        "metres away, with a loud broad-band sound (noise from a speaker, claps, speech) at its height. "
        "Prints what was found with its 1-sigma; exit code 1, and nothing is written, where the recording "
        "could not determine it. The angle table has the columns time_s (of the recordings as one), "
        "azimuth_deg (clockwise from ahead) and maybe elevation_deg; between two lines the sound goes the "
        "shorter way.",
    )
    calibrate.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE.wav",
        help="WAV or FLAC, any rate, as recorded; several, or a folder of them, are one after another",
    )
    calibrate.add_argument("--write", type=Path, metavar="PATH", help="write settings with what was found")
    calibrate.add_argument("--angles", type=Path, metavar="CSV", help="where the sound was; default: unknown")
    calibrate.add_argument(
        "--angle-sigma-deg", type=_positive, default=3.0, metavar="N", help="1-sigma of one line (default 3)"
    )
    calibrate.add_argument(
        "--sense", choices=("clockwise", "anticlockwise"), help="which way you walked, seen from above"
    )
    calibrate.add_argument(
        "--elevation-deg", type=_number(-60, 60), default=0.0, metavar="N",
        help="of the sound seen from the array, positive up (default 0): it sets the scale",
    )  # fmt: skip
    calibrate.add_argument(
        "--elevation-sigma-deg", type=_positive, default=2.0, metavar="N", help="its 1-sigma (default 2)"
    )
    calibrate.add_argument(
        "--distance-m", type=_positive, default=math.inf, metavar="N",
        help="from the array's middle, for the wave's curvature (default: unknown, 2 m or more)",
    )  # fmt: skip
    calibrate.add_argument(
        "--margin", type=_number(1, 20), default=1.5, metavar="N",
        help="search delays of an array so much larger (default 1.5): more for channels that are very late",
    )  # fmt: skip
    return parser


def _number(least: float, most: float) -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number from {least:g} to {most:g}")
        return value

    return number


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above zero")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(text)


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time like 2026-07-01T12:00") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def _settings(arguments: argparse.Namespace) -> Settings:
    if arguments.settings is not None:
        return load(arguments.settings)
    return load(DEFAULT_PATH) if DEFAULT_PATH.exists() else Settings()


def _settings_in_service(arguments: argparse.Namespace) -> Settings:
    """The settings; the service's, by hand too, with the state that the service keeps: what was set over
    MAVLink holds, and is changed, where the service will find it."""
    settings = _settings(arguments)
    installed = arguments.settings in (None, DEFAULT_PATH) and DEFAULT_PATH.exists()
    told = settings.mavlink.state_directory or os.environ.get("STATE_DIRECTORY")
    if told or not installed or not SERVICE_STATE.is_dir():
        return settings
    return replace(settings, mavlink=replace(settings.mavlink, state_directory=str(SERVICE_STATE)))


# --- run ----------------------------------------------------------------------------------------------


def _run(arguments: argparse.Namespace) -> int:
    # where the service manager keeps it for us, from one start to the next
    notes = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if notes:
        _put_off(Path(notes))
    one_arena()
    settings = _settings_in_service(arguments)
    callers, recorder = _callers(arguments), None
    with contextlib.ExitStack() as ending:
        if callers is not None:
            ending.callback(_export_news, callers)
        if arguments.record is not None:
            from locagen_edge.store.recorder import Recorder

            recorder = Recorder(arguments.record, settings)
            ending.callback(recorder.close)
        asyncio.run(_serve(settings, arguments.seconds, recorder, callers, quiet=arguments.quiet))
    if notes:
        forget(Path(notes))
    return 0


def _put_off(notes: Path) -> None:
    """Waits where start after start has failed. SIGTERM still ends it at once."""
    wait_s = put_off_s(notes, time.monotonic())
    if wait_s:
        text = f"failed again and again: waiting for {wait_s:.0f} s"
        logging.warning("%s", text)
        notify(STATUS=text)
        time.sleep(wait_s)


async def _serve(
    settings: Settings,
    seconds: float | None,
    recorder: Recorder | None,
    callers: Callers | None,
    *,
    quiet: bool,
) -> None:
    from locagen_edge.daemon import Daemon
    from locagen_edge.poses import record_of
    from locagen_edge.sources import open_source

    loop = asyncio.get_running_loop()
    live = LiveLine()
    told: list[str] = []
    export_s = 0.0

    def each_estimate(frame: Frame, estimate: Estimate) -> None:
        if recorder is not None and estimate.pose is not None:
            recorder.note(record_of(estimate.pose))
        if callers is not None:
            callers.hear(estimate, _utc_ns(frame))

    def each_second(daemon: Daemon) -> None:
        nonlocal export_s
        if callers is not None and callers.changed and loop.time() >= export_s:
            export_s = loop.time() + EXPORT_S
            callers.changed = False
            loop.run_in_executor(None, _export_or_tell, callers, callers.events)
        if not quiet:
            live(daemon)
        if recorder is not None and recorder.failure and not told:
            told.append(recorder.failure)
            logging.error("%s; bearings go on", recorder.failure)

    def source(settings: Settings) -> AsyncGenerator[Frame, None]:
        if recorder is not None:
            recorder.gap(0)  # each time it is opened it begins anew
        return open_source(settings, recorder)

    daemon = Daemon(
        settings,
        on_second=each_second,
        on_estimate=each_estimate,
        on_settings=None if recorder is None else recorder.apply,
        sources=source,
    )
    stopping.calls(daemon.stop)
    if not quiet:
        links = ", ".join(settings.mavlink.link)
        print(
            f"locagen-edge {__version__}: {settings.audio.source} source, "
            f"{settings.bearing.estimator} estimator, MAVLink to {links}; Ctrl-C ends",
            flush=True,
        )
    await daemon.startup()
    try:
        if seconds is not None:
            loop.call_later(seconds, daemon.stop)
        await daemon.main_loop()
    finally:
        clean = await daemon.shutdown()
    if not clean:
        _leave("the source or the pipeline hangs: left without waiting for it")
    if not quiet:
        c = daemon.counters
        print(
            f"{c.estimates} frames, {c.dropped} dropped, {c.sound}, "
            f"{c.source_failures} source failures; sent {_counts(daemon.component.sent)}, "
            f"{daemon.links.dropped} of them lost"
        )


def _utc_ns(frame: Frame) -> int:
    """Of the frame's first sample: as recorded, else by the clock of today."""
    if frame.utc_ns is not None:
        return frame.utc_ns
    return time.time_ns() - time.monotonic_ns() + frame.t_ns


def _callers(arguments: argparse.Namespace) -> Callers | None:
    if arguments.export is None:
        return None
    from locagen_edge.export import Callers

    return Callers(arguments.export)


def _export_news(callers: Callers) -> None:
    """Where nobody has been placed, what an earlier run has written stays."""
    if callers.changed:
        _export(callers)


def _export(callers: Callers) -> None:
    from locagen_edge.export import export

    export(callers.events, callers.path)
    print(f"locagen-edge: {len(callers.events)} callers in {callers.path}", file=sys.stderr)


def _export_or_tell(callers: Callers, events: list[Told]) -> None:
    """From a thread: a disk may take its time, and one that is full is no reason to stop."""
    from locagen_edge.export import export

    try:
        export(events, callers.path)
    except ExportError as error:
        callers.changed = True  # so it is tried again
        logging.error("%s", error)


class LiveLine:
    """One line per second for a person who watches."""

    def __init__(self) -> None:
        self._second = 0
        self._sent: Counter[str] = Counter()
        self._dropped = self._refused = 0

    def __call__(self, daemon: Daemon) -> None:
        self._second += 1
        sent = Counter(daemon.component.sent)
        news, self._sent = sent - self._sent, sent
        latency = daemon.counters.latency_s
        parts = [f"{self._second:4d} s"]
        if not daemon.hearing or daemon.estimate is None:
            parts.append(f"no sound: {daemon.source_fault or 'waiting'}")
        else:
            parts.append(describe(daemon.estimate))
            if latency:
                parts.append(f"{1e3 * sorted(latency)[len(latency) // 2]:.1f} ms")
        parts.append(self._links(daemon.links, news))
        print("  ".join(parts), flush=True)

    def _links(self, links: Links, news: Counter[str]) -> str:
        """What was sent in the last second, and what became of it."""
        dropped, self._dropped = links.dropped - self._dropped, links.dropped
        refused, self._refused = links.refused - self._refused, links.refused
        if not links.up:
            return f"link down: {links.last_error or 'nobody heard yet'}"
        lost = f", {dropped} lost" if dropped else ""
        down = f"; down: {links.last_error}" if links.last_error else ""
        return f"sent {_counts(news)}{lost}{' (nobody listens)' if refused else ''}{down}"


def describe(estimate: Estimate) -> str:
    """One frame's estimate in words: the track's bearing, and the truth beside it where it is known."""
    track, truth = estimate.track, estimate.truth
    if track is None:
        parts = ["bearing  ---         "]
    else:
        azimuth, sigma = compass_deg(track.azimuth_rad), math.degrees(track.azimuth_sigma_rad)
        parts = [f"bearing {azimuth:5.1f}° ±{sigma:4.1f}°"]
    if truth is not None:
        parts.append(f"true {compass_deg(truth.azimuth_rad):5.1f}°")
    if track is not None and track.earth is not None:
        parts.append(f"from north {compass_deg(track.earth.azimuth_rad):5.1f}°")
    if track is not None and track.elevation_rad is not None:
        parts.append(f"el {math.degrees(track.elevation_rad):3.0f}°")
    place = estimate.position(track)
    if place is not None and place.latitude_deg is not None:
        parts.append(f"at {place.latitude_deg:.6f}, {place.longitude_deg:.6f} ±{place.semi_major_m:.0f} m")
    if len(estimate.tracks) > 1:
        parts.append(f"{len(estimate.tracks)} callers")
    parts.append(f"snr {estimate.detection.snr_db:5.1f} dB {'CALL' if estimate.detection.call else '    '}")
    parts += [f"! {fault}" for fault in estimate.faults]
    return "  ".join(parts)


def _counts(sent: Counter[str]) -> str:
    """The values of one bearing are messages of one kind, each with its own name: counted as that."""
    kinds: Counter[str] = Counter()
    for name, number in sent.items():
        kinds["NAMED_VALUE_FLOAT" if name.startswith("LG_") else name] += number
    return ", ".join(f"{number} {name}" for name, number in sorted(kinds.items())) or "nothing"


# --- replay -------------------------------------------------------------------------------------------

COLUMNS: dict[str, str] = {
    "t_s": "9.3f",
    "azimuth_deg": "11.2f",
    "sigma_deg": "9.2f",
    "elevation_deg": "13.2f",
    "elevation_sigma_deg": "19.2f",
    "snr_db": "7.1f",
    "call": "6",
    "track_deg": "9.2f",
    "track_sigma_deg": "15.2f",
    "misfit": "8.2f",
    "range_m": "8.2f",
    "estimator": "12",
    "callers": "40",
    "faults": "",
}
"""What one line of `replay` holds, and how the table prints it."""
NOT_HEARD = {"mavlink", "flight", "daemon", "record", "log"}
"""sections of the settings that are nothing to a replay"""


def record(estimate: Estimate, t_s: float) -> dict[str, Any]:
    """One hop as plain values, keys as in COLUMNS; None where nothing can be said."""
    b, track, fix = estimate.bearing, estimate.track, estimate.bearing.fix
    return {
        "t_s": round(t_s, 6),
        "azimuth_deg": None if b.azimuth_rad is None else round(compass_deg(b.azimuth_rad), 4),
        "sigma_deg": round(math.degrees(b.azimuth_sigma_rad), 4),
        "elevation_deg": None if b.elevation_rad is None else round(math.degrees(b.elevation_rad), 4),
        "elevation_sigma_deg": round(math.degrees(b.elevation_sigma_rad), 4),
        "snr_db": round(estimate.detection.snr_db, 2),
        "call": estimate.detection.call,
        "track_deg": None if track is None else round(compass_deg(track.azimuth_rad), 4),
        "track_sigma_deg": None if track is None else round(math.degrees(track.azimuth_sigma_rad), 4),
        "misfit": round(b.misfit, 3) if math.isfinite(b.misfit) else None,
        "range_m": round(fix.range_m, 3) if fix is not None and fix.range_observable else None,
        "estimator": b.estimator,
        "callers": [caller(track, estimate.position(track)) for track in estimate.tracks],
        "faults": list(estimate.faults),
    }


def caller(track: Track, position: Position | None) -> dict[str, Any]:
    """A track as plain values; the best is the first."""
    earth = track.earth
    shown: dict[str, Any] = {
        "id": track.id,
        "confirmed": track.confirmed,
        "azimuth_deg": round(compass_deg(track.azimuth_rad), 4),
        "sigma_deg": round(math.degrees(track.azimuth_sigma_rad), 4),
        "from_north_deg": None if earth is None else round(compass_deg(earth.azimuth_rad), 4),
        "latitude_deg": None,
        "longitude_deg": None,
        "semi_major_m": None,
    }
    if position is not None and position.latitude_deg is not None and position.longitude_deg is not None:
        shown["latitude_deg"] = round(position.latitude_deg, 7)
        shown["longitude_deg"] = round(position.longitude_deg, 7)
        shown["semi_major_m"] = round(position.semi_major_m, 2)
    return shown


def _caller_in_words(c: dict[str, Any]) -> str:
    words = f"{c['id']}: {c['azimuth_deg']:.1f}° ±{c['sigma_deg']:.1f}°"
    if c["latitude_deg"] is not None:
        words += f" at {c['latitude_deg']:.6f}, {c['longitude_deg']:.6f} ±{c['semi_major_m']:.0f} m"
    return words if c["confirmed"] else f"({words})"


def _replay(arguments: argparse.Namespace) -> int:
    files = _recordings(arguments.files)
    callers = _callers(arguments)
    settings = _settings_beside(files) if arguments.settings is None else None
    if settings is None:
        settings = _settings(arguments)
    if arguments.format == "table":
        print("  ".join(f"{name:>{_width(name)}}" for name in COLUMNS))
    for line in replay(files, settings, callers):
        print(json.dumps(line) if arguments.format == "jsonl" else _row(line))
    sys.stdout.flush()
    if callers is not None:
        _export(callers)
    return 0


def _recordings(paths: list[Path]) -> list[Path]:
    """Files as given, folders as the recordings in them, by name: the order in which `record` made them."""
    found: list[Path] = []
    for path in paths:
        inside = [path]
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in (".wav", ".flac"))
        if not inside:
            raise SourceError(f"{path}: there is no WAV or FLAC in this folder")
        found += inside
    return found


def _settings_beside(files: list[Path]) -> Settings | None:
    """What all were recorded with; None where nothing tells. Raises `SourceError` where they differ."""
    beside = [path for file in files if (path := file.with_suffix(".toml")).is_file()]
    if not beside:
        return None
    settings: Settings = load(beside[0])
    for path in beside[1:]:
        if differ := list(_differ(settings, load(path))):
            raise SourceError(
                f"{path}: {', '.join(differ)} other than in {beside[0]}: replay them one by one, or give "
                "--settings for all"
            )
    logging.info("settings: %s", beside[0])
    return settings


def _differ(a: Settings, b: Settings) -> Iterator[str]:
    """Names of the settings that differ, of those that bearings depend on."""
    for section in fields(Settings):
        one, other = getattr(a, section.name), getattr(b, section.name)
        for key in fields(one) if section.name not in NOT_HEARD else ():
            if getattr(one, key.name) != getattr(other, key.name):
                yield f"{section.name}.{key.name}"


def replay(files: list[Path], settings: Settings, callers: Callers | None = None) -> Iterator[dict[str, Any]]:
    """The records of recordings as if they were one, hop by hop, with a progress bar where the error stream
    is a terminal and the records go elsewhere. `callers` hears them too."""
    from tqdm import tqdm

    from locagen_edge.pipeline import Pipeline
    from locagen_edge.stages.mic import wav_duration_s, wav_frames

    pipeline = Pipeline(settings)
    rate_hz, frame_s = settings.audio.rate_hz, settings.audio.frame / settings.audio.rate_hz
    bar = tqdm(
        total=round(wav_duration_s(files, settings), 1),
        unit="s",
        desc=files[0].name if len(files) == 1 else f"{len(files)} files",
        disable=not sys.stderr.isatty() or sys.stdout.isatty(),
        bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s of sound, {elapsed} so far",
    )
    with bar:
        for frame in wav_frames(files, settings):
            t_s = frame.start / rate_hz
            bar.update(t_s + frame_s - bar.n)
            estimate = pipeline.process(frame)
            if callers is not None:
                callers.hear(estimate, _utc_ns(frame))
            yield record(estimate, t_s)
        bar.update(bar.total - bar.n)  # what is left is shorter than a hop


def _width(name: str) -> int:
    return int(COLUMNS[name].partition(".")[0] or 0)


def _row(line: dict[str, Any]) -> str:
    cells = []
    for name, form in COLUMNS.items():
        value = line[name]
        if isinstance(value, float):
            cells.append(f"{value:{form}}")
        else:
            if name == "callers":
                value = [_caller_in_words(c) for c in value]
            text = "; ".join(value) if isinstance(value, list) else "-" if value is None else str(value)
            cells.append(f"{text:>{_width(name)}}")
    return "  ".join(cells)


# --- record -------------------------------------------------------------------------------------------


def _record(arguments: argparse.Namespace) -> int:
    from locagen_edge.store.recorder import Recorder

    settings = _settings(arguments)
    directory = arguments.output or Path(settings.record.directory)
    recorder = Recorder(directory, settings)
    try:
        losses = asyncio.run(_keep(settings, recorder, arguments.seconds, poses=arguments.poses))
    finally:
        if sys.stderr.isatty():
            print(file=sys.stderr)
        recorder.close()
    if recorder.failure:
        raise StorageError(recorder.failure)
    done = recorder.progress()
    print(
        f"{done.seconds:.1f} s in {directory}, {losses}, {done.lost} blocks not written; "
        f"hear it with: locagen-edge replay {directory}"
    )
    return 0


async def _keep(settings: Settings, recorder: Recorder, seconds: float | None, *, poses: bool) -> Losses:
    """Reads the source, which fills the recorder, until the time is over or a signal comes."""
    from locagen_edge.framing import Losses
    from locagen_edge.mavlink.posefeed import posefeed
    from locagen_edge.poses import record_of
    from locagen_edge.sources import open_source

    enough = asyncio.Event()
    stopping.calls(enough.set)
    stop = asyncio.create_task(enough.wait())
    losses, second = Losses(), 0
    async with contextlib.AsyncExitStack() as ending:
        known = await ending.enter_async_context(posefeed(settings)) if poses else None
        source = await ending.enter_async_context(contextlib.aclosing(open_source(settings, recorder)))
        while not recorder.failure:
            coming = asyncio.ensure_future(anext(source, None))
            await asyncio.wait([coming, stop], return_when=asyncio.FIRST_COMPLETED)
            if stop.done():
                coming.cancel()
                await asyncio.gather(coming, return_exceptions=True)
                break
            frame = coming.result()
            if frame is None:  # a recording's end
                break
            losses.count(frame)
            pose = known.at(frame.middle_ns) if known is not None else None
            if pose is not None:
                recorder.note(record_of(pose))
            heard_s = (frame.start + frame.samples.shape[1]) / frame.rate_hz
            if seconds is not None and heard_s >= seconds:
                break
            if int(heard_s) > second:
                second = int(heard_s)
                _show(recorder.progress(), losses)
    stop.cancel()
    return losses


def _show(progress: Progress, losses: Losses) -> None:
    """One line that is written over, on a terminal: what there is, and the level of each channel."""
    if not sys.stderr.isatty():
        return
    levels = " ".join(f"{_dbfs(rms):4.0f}" for rms in progress.rms)
    peak = _dbfs(max(progress.peak, default=0.0))
    text = (
        f"{progress.seconds:7.0f} s  {progress.name}  {progress.kept_bytes / 1e6:.1f} MB  "
        f"rms {levels} dBFS, peak {peak:.0f}  {losses}, {progress.lost} blocks not written"
    )
    print(f"\r{text[: shutil.get_terminal_size().columns - 1]}\033[K", end="", file=sys.stderr, flush=True)


def _dbfs(amplitude: float) -> float:
    return 20.0 * math.log10(max(amplitude, 1e-6))


# --- log ----------------------------------------------------------------------------------------------


def _log(arguments: argparse.Namespace) -> int:
    from locagen_edge.store.blackbox import directory_of
    from locagen_edge.store.journal import records
    from locagen_edge.store.logbook import HEADER, chosen, row

    directory = arguments.directory or directory_of(_settings(arguments)) or SERVICE_STATE
    try:
        found: Iterable[Record] = chosen(records(directory), set(arguments.type), arguments.since)
        if arguments.last is not None:
            found = deque(found, arguments.last)
        for number, record in enumerate(found):
            if arguments.format == "table" and number == 0:
                print(HEADER)
            print(row(record) if arguments.format == "table" else json.dumps(record))
    except (FileNotFoundError, NotADirectoryError):
        raise StorageError(f"{directory}: there is no such folder; is log.directory set?") from None
    except PermissionError:
        raise StorageError(f"{directory}: may not be read: as root, or the user locagen-edge") from None
    sys.stdout.flush()
    return 0


# --- fuse ---------------------------------------------------------------------------------------------


def _fuse(arguments: argparse.Namespace) -> int:
    from locagen_edge.export import event, export, seen_from
    from locagen_edge.fusion import fuse
    from locagen_edge.sightings import read
    from locagen_edge.store.blackbox import sightings

    looks = (look for p in arguments.files for look in (sightings(p) if p.is_dir() else read(p)))
    found = fuse(looks, _settings(arguments).position)
    events: list[Told] = []
    for number, fused in enumerate(found, start=1):
        p = fused.position
        if p.latitude_deg is None or p.longitude_deg is None:
            azimuth, sigma = compass_deg(p.azimuth_rad), math.degrees(p.azimuth_sigma_rad)
            place = f"range not observable; {azimuth:.1f}° ±{sigma:.1f}° from the last look"
        else:
            place = (
                f"{p.latitude_deg:.6f}, {p.longitude_deg:.6f}  1-sigma {p.semi_major_m:.1f} m x "
                f"{p.semi_minor_m:.1f} m at {math.degrees(p.orientation_rad):.0f}°"
            )
        name = f"caller {number}"
        events.append(event(p, p.t_ns, name=name) or seen_from(fused.last, name=name))
        seen = ", ".join(f"{observer}/{caller}" for observer, caller in fused.streams)
        print(f"caller {number}: {place}  ({fused.used} looks of {seen}; {fused.unused} not used)")
    if not found:
        print("no caller: no sighting could be used")
    if arguments.output is not None:
        export(events, arguments.output)
    return 0


# --- devices ------------------------------------------------------------------------------------------


def _devices(_: argparse.Namespace) -> int:
    from locagen_edge.stages.mic import devices

    found = devices()
    if not found:
        print("no capture device: plug one in, and see `arecord -l` for what the kernel knows")
    for device in found:
        rate = f"default {device.default_rate_hz:g} Hz"
        stable = f", audio.device = {device.stable_name!r}" if device.stable_name != device.name else ""
        print(f"{device.name!r}: {device.channels} channels, {rate} ({device.host_api}){stable}")
    return 0


# --- check --------------------------------------------------------------------------------------------


def _check(arguments: argparse.Namespace) -> int:
    from locagen_edge.check import check

    wrong = 0
    for good, what, text in check(_settings_in_service(arguments), arguments.seconds):
        print(f"{'ok   ' if good else 'WRONG'}  {what}: {text}", flush=True)
        wrong += not good
    if wrong:
        print(f"{wrong} of these need you")
    return 1 if wrong else 0


# --- calibrate ----------------------------------------------------------------------------------------


def _calibrate(arguments: argparse.Namespace) -> int:
    from locagen_edge import calibrate as door
    from locagen_edge.calibration import Walk

    settings = _settings(arguments)
    walk = Walk(
        elevation_rad=math.radians(arguments.elevation_deg),
        elevation_sigma_rad=math.radians(arguments.elevation_sigma_deg),
        distance_m=arguments.distance_m,
        clockwise=None if arguments.sense is None else arguments.sense == "clockwise",
        angle_sigma_rad=math.radians(arguments.angle_sigma_deg),
    )
    table = None if arguments.angles is None else door.read_angles(arguments.angles)
    files = _recordings(arguments.files)
    heard = door.hear(files, settings, arguments.margin)
    if table is not None:
        heard, walk = door.at_angles(heard, table, walk, arguments.angles)
    found = door.fitted(heard, settings, walk)
    for line in door.report(heard, found, settings, walk):
        print(line)
    if found.doubts:
        written = ["nothing is written"] if arguments.write is not None else []
        raise CalibrationError("\n".join([*found.doubts, *written]))
    if arguments.write is not None:
        door.write_settings(arguments.write, door.calibrated(settings, heard, found), files)
        print(f"written     {arguments.write}")
    return 0
