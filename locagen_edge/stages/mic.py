"""Frames from microphones (ALSA, through PortAudio) and from recordings (through libsndfile).

The card is read by one helper thread, which owns everything of PortAudio, and which never waits inside it: it
asks how much is there, and reads just that. So, other than with PortAudio's callbacks,
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
from collections.abc import AsyncGenerator, Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np
import soundfile

from locagen_edge.alignment import Aligner
from locagen_edge.errors import SourceError, SourceHungError
from locagen_edge.framing import Framer, in_real_time
from locagen_edge.resampling import Resampler
from locagen_edge.settings import Settings
from locagen_edge.types import Array, Frame

log = logging.getLogger(__name__)

POLL_S = 0.02  # 50 wake-ups a second; less than half the default hop
LATENCY_S = 0.4  # the card's buffer: what may pile up while this process does not get to run; delays nothing
LOSS_S = 0.05  # more than the coarsest pointer of a USB card moves at once (a few ms to 20 ms)
LOSS_POLLS = 10  # a late pointer recovers within a poll or two; sound that is lost stays lost
DRIFT_POLLS = 500  # 10 s: jitter averages out, and 100 ppm of clock error lag by 1 ms
OPEN_S = 10.0  # PortAudio asks every card at its start: about a second on a small board
CLOSE_S = 0.5  # of the second in which the service must end

_hung: threading.Thread | None = None  # a reading thread that did not come back; PortAudio is its alone


class _Cutter:
    """Rows as a device or file gives them, into frames: channels chosen, resampled, aligned, turned, cut."""

    def __init__(self, settings: Settings, rate_in: float) -> None:
        audio = settings.audio
        self._map = list(audio.channel_map)
        self._resampler = Resampler(rate_in, audio.rate_hz, len(self._map))
        array = settings.array
        self._aligner = Aligner(array.delays_s, array.gains_db, audio.rate_hz, len(self._map))
        self.framer = Framer(audio.frame, audio.hop, len(self._map), audio.rate_hz)

    def push(self, rows: Array, *, last: bool = False) -> list[Frame]:
        """Frames from (n, channels), int16 or float32. `last`: the resampler gives up all it holds."""
        chosen = rows[:, self._map].astype(np.float32)
        if rows.dtype == np.int16:
            chosen /= 32768.0  # full scale 1.0
        if last:
            ready = self._aligner.flush(self._resampler.flush(chosen))
        else:
            ready = self._aligner.push(self._resampler.push(chosen))
        return self.framer.push(ready.T)

    def gap(self, overruns: int = 1) -> None:
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


def devices() -> list[Device]:
    """The devices that can record now. Not while a source is open: PortAudio is started afresh.

    Raises `SourceError` where PortAudio itself is missing.
    """
    return _devices(_portaudio())


async def alsa(settings: Settings) -> AsyncGenerator[Frame, None]:
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
    thread = threading.Thread(target=_capture_into, args=(box, settings, stop), name="capture", daemon=True)
    thread.start()
    patience_s = OPEN_S + settings.daemon.stall_s
    try:
        while True:
            try:
                async with asyncio.timeout(patience_s):
                    frame = await box.get()
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


def _capture_into(box: _Mailbox, settings: Settings, stop: threading.Event) -> None:
    """The reading thread."""
    failure = None
    try:
        with _opened(_portaudio(), settings) as stream:
            for frame in capture(stream, settings, stop.wait):
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
    def read_available(self) -> int: ...

    def read(self, frames: int) -> tuple[Array, bool]: ...


def capture(
    stream: InputStream,
    settings: Settings,
    wait: Callable[[float], bool],
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> Iterator[Frame]:
    """Frames from an open stream until `wait` (seconds) returns True: stop.

    Raises `SourceError` when no sample comes for `daemon.stall_s`.
    """
    rate_hz = settings.audio.device_rate_hz
    cutter = _Cutter(settings, rate_hz)
    clock = SampleClock(rate_hz)
    samples = 0
    heard_ns = now_ns()
    while not wait(POLL_S):
        asked_ns = now_ns()
        waiting = stream.read_available
        if not waiting:
            if asked_ns - heard_ns > settings.daemon.stall_s * 1e9:
                raise SourceError(f"{_label(settings)}: no sound for {settings.daemon.stall_s:g} s")
            continue
        heard_ns = asked_ns
        rows, overflowed = stream.read(waiting)
        if overflowed or not clock.update(samples + waiting, asked_ns):
            cutter.gap()
            clock = SampleClock(rate_hz)
            samples = 0
            if overflowed:
                continue  # the card may have overrun within this very read: both sides of the gap are in it
            clock.update(waiting, asked_ns)
        samples += waiting
        cutter.framer.origin_ns = clock.origin_ns
        yield from cutter.push(rows)


class SampleClock:
    """Monotonic time of a card's samples, from how many there were when.

    The card's crystal is off by up to 100 ppm and the pointer into its buffer moves in steps, so time follows
    the count, slowly corrected.
    """

    def __init__(self, rate_hz: float) -> None:
        self.origin_ns = 0
        """monotonic time of the first sample, as the card's clock stands now"""
        self._rate_hz = rate_hz
        self._polls = 0
        self._late_ns: collections.deque[int] = collections.deque(maxlen=LOSS_POLLS)

    def update(self, samples: int, now_ns: int) -> bool:
        """`samples` had come by `now_ns`. False: count and clock have parted: sound was lost in silence."""
        origin_ns = now_ns - round(samples * 1e9 / self._rate_hz)
        if self._polls == 0:
            self.origin_ns = origin_ns
        late_ns = origin_ns - self.origin_ns
        self._late_ns.append(late_ns)
        self._polls += 1
        self.origin_ns += round(late_ns / min(self._polls, DRIFT_POLLS))
        lasting = len(self._late_ns) == LOSS_POLLS
        limit_ns = LOSS_S * 1e9
        return not (lasting and (min(self._late_ns) > limit_ns or max(self._late_ns) < -limit_ns))


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
    """The device that `audio.device` means: by its whole name, or else by a part that only one has."""
    wanted = settings.audio.device
    names = ", ".join(f'"{d.name}"' for d in found)
    if not found:
        raise SourceError("audio.device: no device that can record is there")
    if not wanted:
        # ALSA's own name for the default, or the first card where that is not set up
        return next((d for d in found if d.name == "default"), found[0])
    fitting = [d for d in found if d.name == wanted] or [d for d in found if wanted.lower() in d.name.lower()]
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
            dtype=audio.sample_format,
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


INVALID_SAMPLE_RATE = -9997  # PaErrorCode, portaudio.h


def _code(error: Exception) -> int:
    return error.args[1] if len(error.args) > 1 else 0


def _reason(error: Exception) -> str:
    """PortAudio's words, or the driver's below where it gives them: (text, code, (api, code, text))."""
    host = error.args[2] if len(error.args) > 2 else None
    return str(host[2] if host else error.args[0] if error.args else error)


# --- recordings ---------------------------------------------------------------------------------------

BLOCK_ROWS = 8192  # a quarter of a megabyte for 8 channels; a few ms of work


def wav_frames(path: Path | str, settings: Settings) -> Iterator[Frame]:
    """Frames of a recording as fast as they are taken; time counts from 0.

    Raises `SourceError`, naming the file, for one that is missing, empty, damaged, no audio, too slow for the
    band, too short for a frame, or without the channels that `audio.channel_map` names.
    """
    return _wav_frames(path, settings, loop=False)


def wav(settings: Settings) -> AsyncGenerator[Frame, None]:
    """The recording `audio.file` in real time, again and again if `audio.loop`. Raises like `wav_frames`."""
    return in_real_time(_wav_frames(settings.audio.file, settings, loop=settings.audio.loop))


def wav_duration_s(path: Path | str, settings: Settings) -> float:
    """Length of the recording in seconds. Raises like `wav_frames`."""
    with _opened_wav(path, settings) as file:
        return float(file.frames / file.samplerate)


def _wav_frames(path: Path | str, settings: Settings, *, loop: bool) -> Generator[Frame, None, None]:
    with _opened_wav(path, settings) as file:
        cutter = _Cutter(settings, file.samplerate)
        while True:
            yield from _one_pass(file, path, cutter)
            if not loop:
                return
            cutter.gap(overruns=0)  # end and beginning do not belong together, but nothing is lost
            file.seek(0)


def _one_pass(file: soundfile.SoundFile, path: Path | str, cutter: _Cutter) -> Iterator[Frame]:
    done = 0
    last = False
    while not last:
        try:
            rows = file.read(BLOCK_ROWS, dtype="float32", always_2d=True)
        except soundfile.LibsndfileError as error:
            raise SourceError(f"{path}: damaged after {done / file.samplerate:.1f} s") from error
        done += len(rows)
        last = len(rows) < BLOCK_ROWS
        yield from cutter.push(rows, last=last)


@contextmanager
def _opened_wav(path: Path | str, settings: Settings) -> Iterator[soundfile.SoundFile]:
    audio = settings.audio
    try:
        if not Path(path).is_file():
            raise SourceError(
                f"{path}: {'is not a file' if Path(path).exists() else 'there is no such file'}"
            )
        if Path(path).stat().st_size == 0:
            raise SourceError(f"{path}: is empty (0 bytes)")
        Path(path).open("rb").close()
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
        _tell_of_the_header(file, path)
        seconds = file.frames / file.samplerate
        if seconds < audio.frame / audio.rate_hz:
            raise SourceError(
                f"{path}: holds {seconds:.3g} s, less than one frame ({audio.frame / audio.rate_hz:.3g} s)"
            )
        if file.channels > len(audio.channel_map):
            log.info("%s: channels %s of %d are used", path, list(audio.channel_map), file.channels)
        yield file


def _tell_of_the_header(file: soundfile.SoundFile, path: Path | str) -> None:
    """A recorder that lost power leaves a header that promises more than there is: use what is there."""
    promised = re.search(r"^data : (\d+) \(should be (\d+)\)", file.extra_info, re.MULTILINE)
    if promised and int(promised[1]) > int(promised[2]):
        share = int(promised[2]) / int(promised[1])
        log.warning("%s: cut short: %.0f %% of what its header promises is there", path, 100 * share)
