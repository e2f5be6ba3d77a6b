"""The command line: the only place that prints for people and exits.

Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import logging
import math
import os
import signal
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from locagen_edge import __version__
from locagen_edge.errors import CalibrationError, LocagenError, SourceHungError
from locagen_edge.geometry import compass_deg
from locagen_edge.settings import DEFAULT_PATH, Settings, load
from locagen_edge.types import Estimate

if TYPE_CHECKING:
    from locagen_edge.daemon import Daemon
    from locagen_edge.mavlink.link import Link


def main(argv: list[str] | None = None) -> None:
    """Entry point of `locagen-edge`."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(levelname).1s %(message)s", stream=sys.stderr)
    if sys.stdout is None:  # started with it closed
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without a degree sign is no reason to stop
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

    replay = command(
        "replay",
        _replay,
        "run a recording through the same pipeline, faster than real time",
        "One line per hop on standard output. t_s is the time of the frame's first sample; azimuth_deg is "
        "clockwise from ahead, 0 to 360; elevation_deg is positive up; sigma_deg is the azimuth's 1-sigma; "
        "null means that nothing can be said. The estimate is given whether or not `call` is true. A call "
        "stands out of the background: a sound that is there from the first frame to the last is none.",
    )
    replay.add_argument("file", type=Path, metavar="FILE.wav", help="WAV or FLAC, any rate and channel count")
    replay.add_argument(
        "--format", choices=("jsonl", "table"), default="jsonl", help="JSON lines (default) or a table"
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
        "could not determine it. The angle table has the columns time_s (of the recording), azimuth_deg "
        "(clockwise from ahead) and maybe elevation_deg; between two lines the sound goes the shorter way.",
    )
    calibrate.add_argument("file", type=Path, metavar="FILE.wav", help="WAV or FLAC, any rate, as recorded")
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


def _settings(arguments: argparse.Namespace) -> Settings:
    if arguments.settings is not None:
        return load(arguments.settings)
    return load(DEFAULT_PATH) if DEFAULT_PATH.exists() else Settings()


# --- run ----------------------------------------------------------------------------------------------


def _run(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    asyncio.run(_serve(settings, arguments.seconds, quiet=arguments.quiet))
    return 0


async def _serve(settings: Settings, seconds: float | None, *, quiet: bool) -> None:
    from locagen_edge.daemon import Daemon

    live = LiveLine()
    daemon = Daemon(settings, on_second=None if quiet else live)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, daemon.stop)
    if not quiet:
        print(
            f"locagen-edge {__version__}: {settings.audio.source} source, "
            f"{settings.bearing.estimator} estimator, MAVLink to {settings.mavlink.link}; Ctrl-C ends",
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
            f"{c.estimates} frames, {c.dropped} dropped, {c.overruns} overruns, "
            f"{c.source_failures} source failures; sent {_counts(daemon.component.sent)}, "
            f"{daemon.link.dropped} of them lost"
        )


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
                parts.append(f"{1e3 * statistics.median(latency):.1f} ms")
        parts.append(self._link(daemon.link, news))
        print("  ".join(parts), flush=True)

    def _link(self, link: Link, news: Counter[str]) -> str:
        """What was sent in the last second, and what became of it."""
        dropped, self._dropped = link.dropped - self._dropped, link.dropped
        refused, self._refused = link.refused - self._refused, link.refused
        if not link.up:
            return f"link down: {link.last_error or 'nobody heard yet'}"
        lost = f", {dropped} lost" if dropped else ""
        return f"sent {_counts(news)}{lost}{' (nobody listens)' if refused else ''}"


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
    "faults": "",
}
"""What one line of `replay` holds, and how the table prints it."""


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
        "faults": list(estimate.faults),
    }


def _replay(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    if arguments.format == "table":
        print("  ".join(f"{name:>{_width(name)}}" for name in COLUMNS))
    for line in replay(arguments.file, settings):
        print(json.dumps(line) if arguments.format == "jsonl" else _row(line))
    sys.stdout.flush()
    return 0


def replay(path: Path, settings: Settings) -> Iterator[dict[str, Any]]:
    """The records of a recording, hop by hop, with a progress bar where the error stream is a terminal
    and the records go elsewhere."""
    from tqdm import tqdm

    from locagen_edge.pipeline import Pipeline
    from locagen_edge.stages.mic import wav_duration_s, wav_frames

    pipeline = Pipeline(settings)
    rate_hz, frame_s = settings.audio.rate_hz, settings.audio.frame / settings.audio.rate_hz
    bar = tqdm(
        total=round(wav_duration_s(path, settings), 1),
        unit="s",
        desc=path.name,
        disable=not sys.stderr.isatty() or sys.stdout.isatty(),
        bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s of sound, {elapsed} so far",
    )
    with bar:
        for frame in wav_frames(path, settings):
            t_s = frame.start / rate_hz
            bar.update(t_s + frame_s - bar.n)
            yield record(pipeline.process(frame), t_s)
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
            text = "; ".join(value) if isinstance(value, list) else "-" if value is None else str(value)
            cells.append(f"{text:>{_width(name)}}")
    return "  ".join(cells)


# --- devices ------------------------------------------------------------------------------------------


def _devices(_: argparse.Namespace) -> int:
    from locagen_edge.stages.mic import devices

    found = devices()
    if not found:
        print("no capture device: plug one in, and see `arecord -l` for what the kernel knows")
    for device in found:
        rate = f"default {device.default_rate_hz:g} Hz"
        print(f"{device.name!r}: {device.channels} channels, {rate} ({device.host_api})")
    return 0


# --- check --------------------------------------------------------------------------------------------


def _check(arguments: argparse.Namespace) -> int:
    from locagen_edge.check import check

    wrong = 0
    for good, what, text in check(_settings(arguments), arguments.seconds):
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
    heard = door.hear(arguments.file, settings, arguments.margin)
    if table is not None:
        heard, walk = door.at_angles(heard, table, walk, arguments.angles)
    found = door.fitted(heard, settings, walk)
    for line in door.report(heard, found, settings, walk):
        print(line)
    if found.doubts:
        written = ["nothing is written"] if arguments.write is not None else []
        raise CalibrationError("\n".join([*found.doubts, *written]))
    if arguments.write is not None:
        door.write_settings(arguments.write, door.calibrated(settings, heard, found), arguments.file)
        print(f"written     {arguments.write}")
    return 0
