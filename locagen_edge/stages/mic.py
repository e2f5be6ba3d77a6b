"""Frames from microphones (ALSA, through PortAudio) and from recordings (through libsndfile).

The card is read by one helper thread, which owns everything of PortAudio, and which never waits inside it: it
sleeps until the next frame should be whole, asks how much is there, and reads just that. So, other than with
PortAudio's callbacks,
- a card that stands still or goes away is seen within one poll: a kernel card that is pulled never calls
  back and lets PortAudio's own thread spin, but a question to it is answered with "no such device";
- the number of samples still unread makes the time stamp exact, however late the thread is;
- no code is generated at run time, so the service may forbid it (MemoryDenyWriteExecute).
"""

from __future__ import annotations

import asyncio
import collections
import logging
import math
import re
import threading
import time
from collections.abc import AsyncGenerator, Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import soundfile

from locagen_edge.alignment import Aligner
from locagen_edge.errors import SourceError, SourceHungError
from locagen_edge.framing import CLIPPED_SHARE, FULL_SCALE, Framer, Tap, in_real_time
from locagen_edge.gone import close_gone
from locagen_edge.jsonl import Record, read
from locagen_edge.poses import Poses, pose_of
from locagen_edge.resampling import Resampler
from locagen_edge.sampleclock import SampleClock
from locagen_edge.settings import Settings
from locagen_edge.types import Array, Frame, Pose

log = logging.getLogger(__name__)

POLL_S = 0.005  # between questions to a card that has nothing new: its pointer may move in steps
SOONEST_S, LATEST_S = 0.002, 0.1
"""Until the next question to a card that had something; no more than a quarter of its buffer either."""
LATENCY_S = 0.4  # the card's buffer: what may pile up while this process does not get to run; delays nothing
CARDS = Path("/proc/asound")  # where the kernel tells its cards' ids
TURN_S = 0.5  # what one turn of waiting counts at most: a process that was suspended has not waited
OPEN_S = 10.0  # PortAudio asks every card at its start: about a second on a small board
CLOSE_S = 0.5  # of the second in which the service must end

_hung: threading.Thread | None = None  # a reading thread that did not come back; PortAudio is its alone


class _Cutter:
    """Rows as a device or file gives them, into frames: channels chosen, resampled, aligned, turned, cut."""

    def __init__(self, settings: Settings, rate_in: float, tap: Tap | None = None) -> None:
        audio = settings.audio
        self._rate_in = rate_in
        self._tap = tap
        self._map = list(audio.channel_map)
        self._resampler = Resampler(rate_in, audio.rate_hz, len(self._map))
        array = settings.array
        self._aligner = Aligner(array.delays_s, array.gains_db, audio.rate_hz, len(self._map))
        self.framer = Framer(audio.frame, audio.hop, len(self._map), audio.rate_hz)
        self._rows = 0  # since the last frame, and how many of them stood at full scale
        self._full: Array = np.zeros(len(self._map), dtype=np.int64)

    def push(self, rows: Array) -> list[Frame]:
        """Frames from (n, channels), int16 or float32."""
        if self._tap is not None:
            self._tap.block(rows, self._rate_in, self.framer.origin_ns)
        chosen = rows[:, self._map].astype(np.float32)
        if rows.dtype == np.int16:
            chosen /= 32768.0  # full scale 1.0
        # here and not in the frame: filters round what the converter has cut off, gains move it
        self._full += np.count_nonzero(np.abs(chosen) >= FULL_SCALE, axis=0)
        self._rows += len(rows)
        frames = self.framer.push(self._aligner.push(self._resampler.push(chosen)).T)
        if not frames:
            return frames
        clipped = sum(1 << m for m, full in enumerate(self._full) if full > CLIPPED_SHARE * self._rows)
        self._full[:], self._rows = 0, 0
        return [replace(frame, clipped=clipped) for frame in frames] if clipped else frames

    @property
    def missing(self) -> int:
        """How many more rows make the next frame whole."""
        return self._resampler.missing(self._aligner.missing(self.framer.missing))

    def finish(self) -> list[Frame]:
        """The last frames: resampler and aligner give up all they hold."""
        rest = self._resampler.flush(np.empty((0, len(self._map)), dtype=np.float32))
        return self.framer.push(self._aligner.flush(rest).T)

    def gap(self, overruns: int = 1) -> None:
        if self._tap is not None:
            self._tap.gap(overruns)
        self._resampler.clear()
        self._aligner.clear()
        self.framer.gap(overruns)


def _check_rate(what: str, rate_hz: float, settings: Settings) -> None:
    top = settings.correlation.band_hz[1]
    if rate_hz < 2 * top:
        raise SourceError(
            f"{what}: {rate_hz:g} Hz carries sound up to {rate_hz / 2:g} Hz, but correlation.band_hz "
            f"goes to {top:g} Hz: use a faster rate or lower the band"
        )


# --- microphones --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Device:
    """A capture device as PortAudio lists it."""

    index: int
    name: str
    channels: int
    default_rate_hz: float
    host_api: str

    @property
    def stable_name(self) -> str:
        """`hw:CARD=ID,DEV=N` for a card of the kernel's, whatever its number is today; else its name."""
        match = re.search(r"\(hw:(\d+),(\d+)\)", self.name)
        with suppress(OSError):
            if match:
                name = (CARDS / f"card{match[1]}" / "id").read_text(encoding="utf-8").strip()
                return f"hw:CARD={name},DEV={match[2]}"
        return self.name


def devices() -> list[Device]:
    """The devices that can record now. Not while a source is open: PortAudio is started afresh.

    Raises `SourceError` where PortAudio itself is missing.
    """
    return _devices(_portaudio())


async def alsa(settings: Settings, tap: Tap | None = None) -> AsyncGenerator[Frame, None]:
    """Frames from the device that `audio.device` names, until it fails or the reader closes.

    Raises `SourceError` when the device is missing, refuses the settings, goes away, or gives nothing for
    `daemon.stall_s`; opening it anew is the way on. Raises `SourceHungError` when the driver does not return:
    only a new process helps then.
    """
    global _hung
    if _hung is not None and _hung.is_alive():
        raise SourceHungError(f"{_label(settings)}: the driver still hangs: restart the service")
    # A process that did not get to run for a while finds the card's whole buffer waiting: no loss yet.
    at_once = math.ceil(LATENCY_S / settings.hop_s)
    box = _Mailbox(asyncio.get_running_loop(), settings.daemon.queue_frames + at_once)
    stop = threading.Event()
    # A daemon thread: one that hangs in a driver must not keep the process from ending.
    arguments = (box, settings, stop, tap)
    thread = threading.Thread(target=_capture_into, args=arguments, name="capture", daemon=True)
    thread.start()
    patience_s = OPEN_S + settings.daemon.stall_s
    try:
        while True:
            try:
                frame = await _patiently(box, patience_s)
            except TimeoutError:
                raise SourceHungError(f"{_label(settings)}: the driver hangs: restart the service") from None
            # The thread reports a stall itself, after stall_s; later than that it is stuck.
            patience_s = settings.daemon.stall_s + 1.0
            yield frame
    finally:
        stop.set()
        try:
            async with asyncio.timeout(CLOSE_S):
                await box.ended.wait()
        except TimeoutError:
            _hung = thread
            log.error("%s: the driver does not let go", _label(settings))


async def _patiently(box: _Mailbox, patience_s: float) -> Frame:
    """The next frame. Raises `TimeoutError` after so long; time in which this process stood still is none."""
    turns = max(round(patience_s / TURN_S), 1)
    for _ in range(turns):
        with suppress(TimeoutError):
            async with asyncio.timeout(patience_s / turns):
                return await box.get()
    raise TimeoutError


def _label(settings: Settings) -> str:
    return f'device "{settings.audio.device}"' if settings.audio.device else "the default device"


class _Mailbox:
    """From the reading thread to the event loop: bounded, the oldest frame dropped and told to the next."""

    def __init__(self, loop: asyncio.AbstractEventLoop, most: int) -> None:
        self._loop = loop
        self._most = most
        self._lock = threading.Lock()
        self._filled = asyncio.Event()
        self._frames: collections.deque[Frame] = collections.deque()
        self._failure: SourceError | None = None
        self.ended = asyncio.Event()
        """set when the thread is through with the device"""

    def put(self, frame: Frame) -> None:
        """From any thread."""
        with self._lock:
            self._frames.append(frame)
            if len(self._frames) > self._most:
                dropped = self._frames.popleft()
                # Frames dropped one after another are one loss, told by the first that gets through.
                overruns = max(1, dropped.overruns + self._frames[0].overruns)
                self._frames[0] = replace(self._frames[0], overruns=overruns)
        self._set(self._filled)

    def end(self, error: SourceError | None) -> None:
        """From any thread, last: `get` raises the error when the frames before it are taken."""
        self._failure = error
        self._set(self._filled)
        self._set(self.ended)

    def _set(self, event: asyncio.Event) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody reads any more
            self._loop.call_soon_threadsafe(event.set)

    async def get(self) -> Frame:
        while True:
            await self._filled.wait()
            with self._lock:
                if self._frames:
                    return self._frames.popleft()
                self._filled.clear()
            if self._failure is not None:
                raise self._failure


def _capture_into(box: _Mailbox, settings: Settings, stop: threading.Event, tap: Tap | None) -> None:
    """The reading thread."""
    failure = None
    try:
        with _opened(_portaudio(), settings) as stream:
            for frame in capture(stream, settings, stop.wait, tap=tap):
                box.put(frame)
    except SourceError as error:
        failure = error
    except Exception as error:  # a fault of ours must not end the thread in silence
        log.exception("capture failed")
        failure = SourceError(f"{_label(settings)}: {error!r}")
    box.end(failure)


class InputStream(Protocol):
    """What `capture` needs of a sounddevice.InputStream without a callback."""

    @property
    def latency(self) -> float:
        """Seconds that its buffer holds."""

    @property
    def read_available(self) -> int: ...

    def read(self, frames: int) -> tuple[Array, bool]: ...


def capture(
    stream: InputStream,
    settings: Settings,
    wait: Callable[[float], bool],
    now_ns: Callable[[], int] = time.monotonic_ns,
    tap: Tap | None = None,
) -> Iterator[Frame]:
    """Frames from an open stream until `wait` (seconds) returns True: stop.

    Raises `SourceError` when no sample comes for `daemon.stall_s`.
    """
    rate_hz = settings.audio.device_rate_hz
    cutter = _Cutter(settings, rate_hz, tap)
    clock = SampleClock(rate_hz)
    samples = 0
    quiet_ns = 0
    asked_ns = now_ns()
    latest_s = max(min(LATEST_S, stream.latency / 4), POLL_S)
    wait_s = POLL_S
    while not wait(wait_s):
        before_ns, asked_ns = asked_ns, now_ns()
        waiting = stream.read_available
        if not waiting:
            wait_s = POLL_S
            quiet_ns += min(asked_ns - before_ns, round(TURN_S * 1e9))
            if quiet_ns > settings.daemon.stall_s * 1e9:
                raise SourceError(f"{_label(settings)}: no sound for {settings.daemon.stall_s:g} s")
            continue
        quiet_ns = 0
        rows, overflowed = stream.read(waiting)
        if rows.dtype == np.int32:  # exact for 24 bits, and below a 32-bit converter's noise
            rows = rows.astype(np.float32) * np.float32(2.0**-31)
        if overflowed or not clock.update(samples + waiting, asked_ns):
            cutter.gap()
            clock = SampleClock(rate_hz, clock.drift)
            samples = 0
            if overflowed:
                continue  # the card may have overrun within this very read: both sides of the gap are in it
            clock.update(waiting, asked_ns)
        samples += waiting
        cutter.framer.origin_ns = clock.origin_ns
        for frame in cutter.push(rows):
            yield frame if clock.drift is None else replace(frame, drift=clock.drift)
        wait_s = min(max(cutter.missing / rate_hz, SOONEST_S), latest_s)


def _portaudio() -> ModuleType:
    """sounddevice with PortAudio started afresh, so that a device plugged in since then is found."""
    try:
        import sounddevice as sd
    except OSError as error:  # what sounddevice raises when it does not find the C library
        raise SourceError("PortAudio is missing: install the package libportaudio2") from error
    except ImportError as error:
        raise SourceError("the Python package sounddevice is missing: install it") from error
    try:
        sd._terminate()
        sd._initialize()
    except sd.PortAudioError as error:
        raise SourceError(f"PortAudio does not start: {_reason(error)}") from error
    module: ModuleType = sd
    return module


def _devices(sd: ModuleType) -> list[Device]:
    hosts = [host["name"] for host in sd.query_hostapis()]
    return [
        Device(i, d["name"], d["max_input_channels"], d["default_samplerate"], hosts[d["hostapi"]])
        for i, d in enumerate(sd.query_devices())
        if d["max_input_channels"] > 0
    ]


def _choose(found: list[Device], settings: Settings) -> Device:
    """The device that `audio.device` means: by its card's id, its whole name, or a part that only one has."""
    wanted = settings.audio.device
    names = ", ".join(f'"{d.name}"' for d in found)
    if not found:
        raise SourceError("audio.device: no device that can record is there")
    if not wanted:
        # ALSA's own name for the default, or the first card where that is not set up
        return next((d for d in found if d.name == "default"), found[0])
    by_card = f"{wanted},DEV=0" if re.fullmatch(r"hw:CARD=[^,]+", wanted) else wanted
    fitting = [d for d in found if by_card == d.stable_name or d.name == wanted]
    fitting = fitting or [d for d in found if wanted.lower() in d.name.lower()]
    if not fitting:
        raise SourceError(f'audio.device: "{wanted}" is not there; there are {names}')
    if len(fitting) > 1:
        raise SourceError(f'audio.device: "{wanted}" fits more than one; there are {names}')
    return fitting[0]


@contextmanager
def _opened(sd: ModuleType, settings: Settings) -> Iterator[InputStream]:
    """The running stream. Any fault of PortAudio, inside too, becomes a `SourceError`."""
    audio = settings.audio
    device = _choose(_devices(sd), settings)
    _check_rate("audio.device_rate_hz", audio.device_rate_hz, settings)
    if audio.device_channels > device.channels:
        raise SourceError(
            f'audio.device_channels: {audio.device_channels} in settings, device "{device.name}" '
            f"offers {device.channels}"
        )
    if audio.device_channels > len(audio.channel_map):
        log.info(
            'device "%s": channels %s of %d are used',
            device.name, list(audio.channel_map), audio.device_channels,
        )  # fmt: skip
    try:
        with sd.InputStream(
            device=device.index,
            samplerate=audio.device_rate_hz,
            channels=audio.device_channels,
            dtype=DTYPES[audio.sample_format],
            latency=LATENCY_S,
        ) as stream:
            yield stream
    except sd.PortAudioError as error:
        if _code(error) == INVALID_SAMPLE_RATE:
            message = (
                f"audio.device_rate_hz: {audio.device_rate_hz} in settings, "
                f'device "{device.name}" refuses it (its own is {device.default_rate_hz:g})'
            )
            raise SourceError(message) from error
        raise SourceError(f"{_label(settings)}: {_reason(error)}") from error
    finally:
        close_gone()


# PortAudio's packed 24 bits have no dtype: it shifts them up into 32, where numpy reads them
DTYPES = {"int16": "int16", "int24": "int32", "float32": "float32"}
INVALID_SAMPLE_RATE = -9997  # PaErrorCode, portaudio.h


def _code(error: Exception) -> int:
    return error.args[1] if len(error.args) > 1 else 0


def _reason(error: Exception) -> str:
    """PortAudio's words, or the driver's below where it gives them: (text, code, (api, code, text))."""
    host = error.args[2] if len(error.args) > 2 else None
    return str(host[2] if host else error.args[0] if error.args else error)


# --- recordings ---------------------------------------------------------------------------------------

BLOCK_ROWS = 8192  # a quarter of a megabyte for 8 channels; a few ms of work


def wav_frames(paths: Path | str | Sequence[Path], settings: Settings) -> Iterator[Frame]:
    """Frames of a recording, or of several as if they were one, as fast as taken; time counts from 0.

    Parts of `locagen-edge record` give the frames of the day, bit for bit: the records beside them tell how
    the sound was cut, what was lost, and what the card's clock said. What does not follow on what comes
    before begins anew: no frame holds sound from both. Where the vehicle's poses were recorded too, frames
    have them.

    Raises `SourceError`, naming the file, for one that is missing, empty, damaged, no audio, too slow for the
    band, too short for a frame, or without the channels that `audio.channel_map` names.
    """
    return _wav_frames(_several(paths), settings, loop=False)


def wav(settings: Settings, tap: Tap | None = None) -> AsyncGenerator[Frame, None]:
    """The recording `audio.file` in real time, again and again if `audio.loop`. Raises like `wav_frames`."""
    paths, loop = [Path(settings.audio.file)], settings.audio.loop
    return in_real_time(lambda now_ns: _wav_frames(paths, settings, loop=loop, tap=tap, origin_ns=now_ns))


def wav_duration_s(paths: Path | str | Sequence[Path], settings: Settings) -> float:
    """Length of the recordings together in seconds. Raises like `wav_frames`."""
    paths = _several(paths)
    seconds = 0.0
    for path in paths:
        with _opened_wav(path, settings, tell=False) as file:
            seconds += file.frames / file.samplerate
    frame_s = settings.audio.frame / settings.audio.rate_hz
    if seconds < frame_s:  # together: a recording's last part may be as short as it is
        name = str(paths[0]) if len(paths) == 1 else f"{len(paths)} files"
        raise SourceError(f"{name}: holds {seconds:.3g} s, less than one frame ({frame_s:.3g} s)")
    return seconds


def _several(paths: Path | str | Sequence[Path]) -> list[Path]:
    return [Path(paths)] if isinstance(paths, (str, Path)) else list(paths)


@dataclass(frozen=True, eq=False)
class _Piece:
    """Rows of a recording, and what is known of them."""

    path: Path
    rate_hz: int
    rows: Array
    origin_ns: int | None
    """as recorded, by the clock of that day"""
    gap: int | None
    """overruns before these rows; 0: nothing was lost, but they do not follow on those before"""
    new_clock: bool
    """whether its clock has nothing to do with the one before"""
    part: Record
    """of the file it is from; empty: nothing was recorded beside it"""


def _wav_frames(
    paths: list[Path], settings: Settings, *, loop: bool, tap: Tap | None = None, origin_ns: int = 0
) -> Generator[Frame, None, None]:
    wav_duration_s(paths, settings)
    with _opened_wav(paths[0], settings, tell=False) as file:
        rate_hz = file.samplerate
    cutter = _Cutter(settings, rate_hz, tap)
    cutter.framer.origin_ns = origin_ns
    day = _Day(cutter.framer, paths)
    while True:
        for piece in _pieces(paths, settings):
            if piece.rate_hz != rate_hz:
                raise SourceError(
                    f"{piece.path}: {piece.rate_hz} Hz, but what comes before it has {rate_hz} Hz: "
                    "replay them one by one"
                )
            if piece.gap is not None:
                if piece.gap == 0:
                    yield from map(day.told, cutter.finish())
                cutter.gap(piece.gap)
            day.follow(piece)
            yield from map(day.told, cutter.push(piece.rows))
        yield from map(day.told, cutter.finish())
        if not loop:
            return
        cutter.gap(overruns=0)  # end and beginning do not belong together, but nothing is lost


class _Day:
    """Recorded times, moved so that they go on from what the framer's clock says, and what else was recorded
    of these times."""

    def __init__(self, framer: Framer, paths: list[Path]) -> None:
        self._framer = framer
        self._offset_ns: int | None = None
        self._utc_ns: int | None = None  # when the recorded clock was 0
        self._poses = Poses(())
        # all at once: a pose comes after its sound, maybe in the next part
        self._of_session: dict[Any, list[Pose]] = {}
        for path in paths:
            part, *records = _beside(path)
            poses = self._of_session.setdefault(part.get("session"), [])
            poses += [pose for record in records if (pose := pose_of(record)) is not None]

    def told(self, frame: Frame) -> Frame:
        """The frame with what was recorded of its time."""
        if self._offset_ns is None:
            return frame
        then_ns = frame.t_ns - self._offset_ns
        pose = self._poses.at(frame.middle_ns - self._offset_ns)
        return replace(
            frame,
            pose=None if pose is None else replace(pose, t_ns=frame.middle_ns),
            utc_ns=None if self._utc_ns is None else then_ns + self._utc_ns,
        )

    def follow(self, piece: _Piece) -> None:
        if piece.new_clock:
            self._offset_ns = None
            self._utc_ns = _utc_of_0_ns(piece.part)
            self._poses = Poses(self._of_session[piece.part.get("session")])
        if piece.origin_ns is not None:
            if self._offset_ns is None:
                self._offset_ns = self._framer.origin_ns - piece.origin_ns
            self._framer.origin_ns = piece.origin_ns + self._offset_ns


def _pieces(paths: list[Path], settings: Settings) -> Iterator[_Piece]:
    """The files one after another, cut as they were captured where the records beside them tell."""
    ended: tuple[Any, Any] | None = None  # session and row after the last of the file before
    for path in paths:
        part, *records = _beside(path)
        marks = [r for r in records if _is_block(r) or _is_gap(r)]
        follows = ended is not None and ended == (part.get("session"), part.get("row"))
        gap = None if ended is None or follows else 0
        new_clock = not follows
        done = 0
        with _opened_wav(path, settings) as file:
            rate_hz = file.samplerate
            for mark in [*marks, {}]:
                if mark.get("type") == "gap":
                    gap = int(mark["overruns"])
                    continue
                rest = not mark  # after the last record: what has none
                while rows := _rows(file, path, BLOCK_ROWS if rest else int(mark["rows"]), done):
                    done += len(rows[0])
                    yield _Piece(path, rate_hz, rows[0], mark.get("origin_ns"), gap, new_clock, part)
                    gap, new_clock = None, False
                    if not rest:
                        break
        ended = (part.get("session", path), part.get("row", 0) + done)


def _beside(path: Path) -> list[Record]:
    """What the recorder wrote beside a part: its record, then the others. One empty record: nothing."""
    try:
        records = list(read(path.with_suffix(".blocks.jsonl")))
    except OSError:
        return [{}]
    if not records or records[0].get("type") != "part":
        return [{}]
    return records


def _utc_of_0_ns(part: Record) -> int | None:
    """UTC since 1970 when the clock of a part was 0."""
    try:
        utc = datetime.fromisoformat(part["utc"])
        return round(utc.timestamp() * 1e9) - int(part["t_ns"])
    except (KeyError, TypeError, ValueError):
        return None


def _is_block(record: Record) -> bool:
    return record.get("type") == "block" and all(type(record.get(k)) is int for k in ("rows", "origin_ns"))


def _is_gap(record: Record) -> bool:
    return record.get("type") == "gap" and type(record.get("overruns")) is int


def _rows(file: soundfile.SoundFile, path: Path, most: int, done: int) -> list[Array]:
    """One array (n, channels) of the next rows; an empty list at the end."""
    try:
        rows = file.read(max(most, 1), dtype="float32", always_2d=True)
    except soundfile.LibsndfileError as error:
        raise SourceError(f"{path}: damaged after {done / file.samplerate:.1f} s") from error
    return [rows] if len(rows) else []


@contextmanager
def _opened_wav(path: Path, settings: Settings, *, tell: bool = True) -> Iterator[soundfile.SoundFile]:
    audio = settings.audio
    try:
        if not path.is_file():
            raise SourceError(f"{path}: {'is not a file' if path.exists() else 'there is no such file'}")
        if path.stat().st_size == 0:
            raise SourceError(f"{path}: is empty (0 bytes)")
        path.open("rb").close()
        file = soundfile.SoundFile(path)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from error
    except soundfile.LibsndfileError as error:
        raise SourceError(f"{path}: is not audio that can be read: {error.error_string}") from error
    with file:
        _check_rate(str(path), file.samplerate, settings)
        if max(audio.channel_map) >= file.channels:
            raise SourceError(
                f"{path}: has {file.channels} channel{'s' * (file.channels > 1)}, but audio.channel_map "
                f"names channel {max(audio.channel_map)} (counted from 0)"
            )
        if tell:
            _tell_of_the_header(file, path)
            if file.channels > len(audio.channel_map):
                log.info("%s: channels %s of %d are used", path, list(audio.channel_map), file.channels)
        yield file


def _tell_of_the_header(file: soundfile.SoundFile, path: Path | str) -> None:
    """A recorder that lost power leaves a header that promises more than there is: use what is there."""
    promised = re.search(r"^data : (\d+) \(should be (\d+)\)", file.extra_info, re.MULTILINE)
    if promised and int(promised[1]) > int(promised[2]):
        share = int(promised[2]) / int(promised[1])
        log.warning("%s: cut short: %.0f %% of what its header promises is there", path, 100 * share)
