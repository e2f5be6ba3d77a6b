"""The daemon: asyncio around the pipeline.

    source -> bounded queue (oldest dropped, drops counted) -> pipeline in one worker thread -> MAVLink

Startup, main loop and shutdown are methods that a test can call. A source that fails is reopened with
bounded back-off while the link goes on, and the link (which reopens itself) never holds up the sound. What
is told (heartbeat, values, watchdog) follows from when the last frame came out of the pipeline.

The watchdog is fed while frames flow, and while a source that has said why it failed is being reopened: then
another process would hear no more. It bites where frames stop without a word, the pipeline is stuck, or the
event loop hangs.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from locagen_edge.errors import SourceError, SourceHungError
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.link import Link, parse
from locagen_edge.notify import notify
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings
from locagen_edge.sources import open_source
from locagen_edge.types import Estimate, Frame

log = logging.getLogger(__name__)

TICK_S = 0.1
"""How often what is due is sent: a tenth of the heartbeat's period."""
FIRST_WAIT_S = 0.5
STOP_S = 0.9
"""All of shutdown has to end within a second: source, then queue, then the rest, with what is left of it."""
CLOSE_S = 0.5
DRAIN_S = 0.75
"""of STOP_S: by when the source should be closed, and what was in the queue estimated"""


@dataclass
class Counters:
    """What happened since the start; every loss is in here."""

    frames: int = 0
    estimates: int = 0
    dropped: int = 0
    """frames that the queue had no room for"""
    overruns: int = 0
    """times that the source lost sound"""
    source_failures: int = 0
    latency_s: list[float] = field(default_factory=list)
    """of the last second: from a frame's last sample to its estimate"""


class Daemon:
    """One source, one pipeline, one link.

    `on_second(daemon)` is called once per second of the main loop. `sources` opens the source that the
    settings name; a test passes its own.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        on_second: Callable[[Daemon], None] | None = None,
        sources: Callable[[Settings], AsyncGenerator[Frame, None]] = open_source,
    ):
        self.settings = settings
        self.counters = Counters()
        self.estimate: Estimate | None = None
        self.source_fault = ""
        self._on_second = on_second
        self._sources = sources
        self._stopping = asyncio.Event()
        self._queue: asyncio.Queue[Frame | None] = asyncio.Queue()
        self._heard_s = -math.inf
        self._tasks: list[asyncio.Task[None]] = []
        self._ready = False
        self._working = False
        self._told: BaseException | None = None
        self._link_was_up = False

    async def startup(self) -> None:
        """Makes pipeline and link. Raises `LocagenError` where the settings cannot be flown with."""
        self.component = Component(self.settings.mavlink, pose=self.settings.pose)
        self.link = Link(
            parse(self.settings.mavlink.link),
            backoff_s=self.settings.daemon.backoff_s,
            on_bytes=lambda data: self.component.receive(data, time.monotonic()),
        )
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="pipeline")
        # models load in the worker: the event loop stays free, and they belong to the thread that calls
        loop = asyncio.get_running_loop()
        self.pipeline = await loop.run_in_executor(self._executor, Pipeline, self.settings)
        self._tasks = [
            asyncio.create_task(self.link.run(), name="link"),
            asyncio.create_task(self._capture(), name="capture"),
            asyncio.create_task(self._work(), name="work"),
            asyncio.create_task(self._tick(), name="tick"),
        ]
        notify(STATUS="waiting for the first sound")

    async def main_loop(self) -> None:
        """Runs until `stop` is called or the source ends. Raises what a task of the daemon raised."""
        stopping = asyncio.create_task(self._stopping.wait(), name="stopping")
        try:
            done, _ = await asyncio.wait([stopping, *self._tasks], return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                self._told = task.exception()
                task.result()
        finally:
            stopping.cancel()

    def stop(self) -> None:
        """Asks the main loop to end: safe to call from a signal handler of the loop."""
        self._stopping.set()

    async def shutdown(self) -> bool:
        """Stops the source, drains the queue, closes the link, within a second.

        False: something still hangs in a driver or in the pipeline, and only the end of the process ends it.
        """
        notify(STOPPING="1", STATUS="stopping")
        start = time.monotonic()
        tasks = {task.get_name(): task for task in self._tasks}
        tasks["capture"].cancel()
        await asyncio.wait([tasks["capture"]], timeout=CLOSE_S)
        self._queue.put_nowait(None)
        await asyncio.wait([tasks["work"]], timeout=start + DRAIN_S - time.monotonic())
        self._send()
        for task in self._tasks:
            task.cancel()
        _, hanging = await asyncio.wait(self._tasks, timeout=start + STOP_S - time.monotonic())
        for task in self._tasks:
            if task.done() and not task.cancelled() and (error := task.exception()) is not self._told:
                log.error("while stopping, %s: %s", task.get_name(), error)
        self._executor.shutdown(wait=False, cancel_futures=True)
        return not hanging and not self._working

    # --- source -> queue

    async def _capture(self) -> None:
        wait_s = FIRST_WAIT_S
        while True:
            heard = self.counters.frames
            try:
                await self._read_source()
            except SourceHungError:
                raise
            except SourceError as error:
                self.counters.source_failures += 1
                if str(error) != self.source_fault:
                    log.error("%s", error)
                self.source_fault = str(error)
                self._tell_ready()
            else:  # a recording's end
                self._queue.put_nowait(None)
                await asyncio.Event().wait()
            wait_s = FIRST_WAIT_S if self.counters.frames > heard else wait_s * 2.0
            wait_s = min(wait_s, self.settings.daemon.backoff_s)
            log.info("the source is opened again in %.1f s", wait_s)
            await asyncio.sleep(wait_s)

    async def _read_source(self) -> None:
        """Frames into the queue until the source ends. Raises `SourceError` where it fails or stalls."""
        async with contextlib.aclosing(self._sources(self.settings)) as source:
            async for frame in source:
                self.counters.frames += 1
                self.counters.overruns += frame.overruns
                if self.source_fault:
                    log.warning("sound again")
                    self.source_fault = ""
                if self._queue.qsize() >= self.settings.daemon.queue_frames:
                    self._queue.get_nowait()
                    self.counters.dropped += 1
                self._queue.put_nowait(frame)

    # --- queue -> pipeline -> link

    async def _work(self) -> None:
        loop = asyncio.get_running_loop()
        frame_ns = round(self.settings.audio.frame / self.settings.audio.rate_hz * 1e9)
        while (frame := await self._queue.get()) is not None:
            self._working = True
            pose = self.component.poses.at(frame.t_ns + frame_ns // 2)
            self.estimate = await loop.run_in_executor(self._executor, self.pipeline.process, frame, pose)
            self._working = False
            self._heard_s = time.monotonic()
            self.counters.estimates += 1
            self.counters.latency_s.append((time.monotonic_ns() - frame.t_ns - frame_ns) * 1e-9)
            self._send()
            self._tell_ready()

    def _tell_ready(self) -> None:
        """Ready is who hears, or knows why not and will go on trying."""
        if not self._ready:
            self._ready = True
            notify(READY="1", STATUS=self._in_words())

    @property
    def hearing(self) -> bool:
        """Whether sound flows through the pipeline now: heartbeat and bearings depend on it."""
        return time.monotonic() - self._heard_s < self.settings.daemon.stall_s

    def _send(self) -> None:
        """Sends what is due. While the link is down nothing is: it would be said to nobody."""
        if not self.link.up:
            self._link_was_up = False
            return
        if not self._link_was_up:
            self._link_was_up = True
            self.component.say_again()
        for message in self.component.due(time.monotonic(), self._status()):
            self.link.send(message)

    def _status(self) -> Status:
        if not self.hearing:
            faults = (f"no sound: {self.source_fault}",) if self.source_fault else ()
            return Status(hearing=False, track=None, snr_db=0.0, faults=faults)
        estimate = self.estimate
        if estimate is None:
            return Status(hearing=True, track=None, snr_db=0.0, faults=())
        return Status(
            True, estimate.track, estimate.detection.snr_db, estimate.faults, others=estimate.tracks[1:]
        )

    async def _tick(self) -> None:
        """What is due without a new estimate; once a second the status and the watchdog."""
        next_s = time.monotonic() + 1.0
        while True:
            await asyncio.sleep(TICK_S)
            self._send()
            if time.monotonic() < next_s:
                continue
            next_s = max(next_s, time.monotonic() - 1.0) + 1.0  # after a suspension no second is made up for
            if self._on_second is not None:
                self._on_second(self)
            if self.hearing or self.source_fault:
                notify(WATCHDOG="1", STATUS=self._in_words())
            else:
                notify(STATUS=self._in_words())
            self.counters.latency_s.clear()

    def _in_words(self) -> str:
        """The service manager's status line: state, and every loss since the start."""
        c = self.counters
        state = "listening" if self.hearing else f"no sound: {self.source_fault or 'waiting'}"
        losses = f"{c.dropped} dropped, {c.overruns} overruns, {self.link.dropped} messages lost"
        return f"{state}; {c.estimates} frames, {losses}"
