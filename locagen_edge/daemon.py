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

from locagen_edge.errors import LinkError, LocagenError, SourceError, SourceHungError
from locagen_edge.framing import Losses
from locagen_edge.mavlink.component import Component, Hands, Status, is_confirmed
from locagen_edge.mavlink.computer import Computer
from locagen_edge.mavlink.identity import machine_uid
from locagen_edge.mavlink.link import parse
from locagen_edge.mavlink.links import Links
from locagen_edge.mavlink.parameters import keep, kept, kept_file
from locagen_edge.mavlink.signing import SAVE_S, guard_of, save_timestamp, state_file
from locagen_edge.mavlink.twins import Numbers
from locagen_edge.notify import notify
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings
from locagen_edge.sources import open_source
from locagen_edge.store.blackbox import BlackBox, directory_of
from locagen_edge.types import Estimate, Frame

log = logging.getLogger(__name__)

TICK_S = 0.1
"""How often what is due is sent: a tenth of the heartbeat's period."""
SAY_AGAIN_S = 10.0
"""What holds is told again to all when one more link comes up, but no more often than this."""
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
    sound: Losses = field(default_factory=Losses)
    """what the source lost"""
    source_failures: int = 0
    latency_s: list[float] = field(default_factory=list)
    """of the last second: from a frame's last sample to its estimate"""


class Daemon:
    """One source, one pipeline, one component on all its links.

    `on_second(daemon)` is called once per second of the main loop, `on_estimate(frame, estimate)` for each
    frame, `on_settings(settings)` with those that are flown: before the source is opened, and whenever others
    are applied; none may wait. `sources` opens the source that the settings name; a test passes its own.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        on_second: Callable[[Daemon], None] | None = None,
        on_estimate: Callable[[Frame, Estimate], None] | None = None,
        on_settings: Callable[[Settings], None] | None = None,
        sources: Callable[[Settings], AsyncGenerator[Frame, None]] = open_source,
    ):
        self.settings = settings
        self.counters = Counters()
        self.estimate: Estimate | None = None
        self._middle_ns = 0  # of its frame
        self.source_fault = ""
        self.black_box: BlackBox | None = None
        self._on_second = on_second
        self._on_estimate = on_estimate
        self._on_settings = on_settings
        self._sources = sources
        self._stopping = asyncio.Event()
        self._queue: asyncio.Queue[Frame | None] = asyncio.Queue()
        self._heard_s = -math.inf
        self._tasks: list[asyncio.Task[None]] = []
        self._ready = False
        self._working = False
        self._told: BaseException | None = None
        self._links_up = 0
        self._said_s = -math.inf
        self._sent_s = -math.inf
        self._save_s = math.inf
        self._told_losses = 0, 0
        self._tell_losses_s = -math.inf
        self._complaints: tuple[str, ...] = ()
        self._applied = settings
        self._applying: asyncio.Future[None] | None = None
        self._keeping: asyncio.Future[None] | None = None
        self._kept: dict[str, float] = {}

    async def startup(self) -> None:
        """Makes pipeline and links. Raises `LocagenError` where the settings cannot be flown with."""
        guard, numbers = guard_of(self.settings), Numbers()
        self._save_s = time.monotonic() + SAVE_S if guard.signs else math.inf
        base = self.settings
        self.settings, told, faults = kept(base)
        for text in (*told, *faults):
            log.warning("%s", text)
        self._applied = self.settings
        if self._on_settings is not None:
            self._on_settings(self.settings)
        self.component = Component(
            self.settings.mavlink,
            pose=self.settings.pose,
            guard=guard,
            numbers=numbers,
            whole=self.settings,
            base=base,
            hands=Hands(
                apply=self._apply,
                listen=self._listen,
                forget_noise=self._forget_noise,
                computer=Computer(disk=kept_file(base).parent).status,
                uid=machine_uid(),
            ),
        )
        self._kept = self.component.parameters.changed
        self.links = Links(
            [parse(link) for link in self.settings.mavlink.link],
            backoff_s=self.settings.daemon.backoff_s,
            on_bytes=self._receive,
            guard=guard,
            numbers=numbers,
        )
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="pipeline")
        # models load in the worker: the event loop stays free, and they belong to the thread that calls
        loop = asyncio.get_running_loop()
        self.pipeline = await loop.run_in_executor(self._executor, Pipeline, self.settings)
        self._tasks = [
            asyncio.create_task(self.links.run(), name="links"),
            asyncio.create_task(self._capture(), name="capture"),
            asyncio.create_task(self._work(), name="work"),
            asyncio.create_task(self._tick(), name="tick"),
        ]
        log_directory = directory_of(self.settings)
        if log_directory is not None:
            self.black_box = BlackBox(log_directory, self.settings, is_confirmed)
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
        if self._applying is not None:
            self._applying.cancel()
        self._executor.shutdown(wait=False, cancel_futures=True)
        if self.component.parameters.changed != self._kept:
            with contextlib.suppress(OSError):
                keep(kept_file(self.settings), self.component.parameters.changed)
        if self.component.guard.signs:
            self._remember_timestamp()
        if self.black_box is not None:
            # it has written all along: only a disk that hangs takes so long
            self.black_box.close(max(start + STOP_S - time.monotonic(), 0.05))
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
        self.counters.sound.reopened()
        async with contextlib.aclosing(self._sources(self.settings)) as source:
            async for frame in source:
                self.counters.frames += 1
                self.counters.sound.count(frame)
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
        while (frame := await self._queue.get()) is not None:
            if not self.component.listening:  # told to stop: not looked at, not kept
                self.estimate, self._heard_s = None, time.monotonic()
                self._tell_ready()
                continue
            self._working = True
            pose = frame.pose or self.component.poses.at(frame.middle_ns)
            estimate = await loop.run_in_executor(self._executor, self.pipeline.process, frame, pose)
            self.estimate, self._middle_ns = estimate, frame.middle_ns
            self._working = False
            self._heard_s = time.monotonic()
            self.counters.estimates += 1
            self.counters.latency_s.append((time.monotonic_ns() - frame.end_ns) * 1e-9)
            self._send()  # first: all else can wait
            if self.black_box is not None:
                self.black_box.hear(frame, estimate)
            if self._on_estimate is not None:
                self._on_estimate(frame, estimate)
            self._tell_ready()

    # --- what is asked over MAVLink: none of it waits

    def _apply(self, settings: Settings) -> None:
        """New settings for the pipeline, between two frames: its one thread does one thing after the other.

        What comes while others are being applied waits, and only the last of it counts.
        """
        self.settings = settings
        if self._applying is None:
            self._applying = asyncio.ensure_future(self._apply_all())

    async def _apply_all(self) -> None:
        loop = asyncio.get_running_loop()
        while (wanted := self.settings) is not self._applied:
            try:
                await loop.run_in_executor(self._executor, self.pipeline.apply, wanted)
            except Exception as error:  # whatever it is, the old settings go on listening
                log.error("parameters are not applied: %s", error, exc_info=_unexpected(error))
                self.settings = self._applied
                self.component.put_back(self._applied, f"Not applied: {error}")
            else:
                self._applied = wanted
                if self.black_box is not None:
                    self.black_box.apply(wanted)
                if self._on_settings is not None:
                    self._on_settings(wanted)
                log.info("settings by parameters: %s", self.component.parameters.changed or "none")
        self._applying = None

    def _listen(self, on: bool) -> None:
        log.warning("%s, as commanded over MAVLink", "listening again" if on else "stopped listening")

    def _forget_noise(self) -> None:
        log.warning("the noise is learnt anew, as commanded over MAVLink")
        forgetting = asyncio.get_running_loop().run_in_executor(self._executor, self.pipeline.forget_noise)
        forgetting.add_done_callback(self._have_forgotten)

    def _have_forgotten(self, done: asyncio.Future[None]) -> None:
        if not done.cancelled() and (error := done.exception()):
            log.error("the noise is not learnt anew: %s", error, exc_info=_unexpected(error))
            self.component.tell_fault(f"Noise is not learnt anew: {error}")

    def _keep_parameters(self) -> None:
        """What was changed, on disk: a second later at most, and never on the loop that carries sound."""
        changed = self.component.parameters.changed
        if self._applying or self._keeping or changed == self._kept:
            return
        self._kept = changed
        loop = asyncio.get_running_loop()
        self._keeping = loop.run_in_executor(None, keep, kept_file(self.settings), changed)
        self._keeping.add_done_callback(self._have_kept)

    def _have_kept(self, done: asyncio.Future[None]) -> None:
        self._keeping = None
        if not done.cancelled() and (error := done.exception()):
            why = error.strerror if isinstance(error, OSError) else str(error)
            text = f"Parameters are not kept over a restart: {kept_file(self.settings).parent}: {why}"
            log.error("%s", text)
            self.component.tell_fault(text)

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
        up, now_s = self.links.up, time.monotonic()
        self._sent_s = now_s
        # Who has just come up has heard nothing; but one that flaps must not make all others hear it again.
        if up > self._links_up and (not self._links_up or now_s - self._said_s > SAY_AGAIN_S):
            self.component.say_again()
            self._said_s = now_s
        self._links_up = up
        if not up:
            return
        for message in self.component.due(now_s, self._status()):
            self.links.send(message, but=self.component.apart(message))
        for number, messages in self.component.own.items():
            for message in messages:
                self.links.send_to(number, message)

    def _receive(self, number: int, data: bytes) -> None:
        """Bytes from a link. What is asked there is answered there."""
        self.component.receive(data, time.monotonic(), number)
        self._answer(number)

    def _answer(self, number: int) -> None:
        for message in self.component.answers(number):
            self.links.answer(number, message)

    def _status(self) -> Status:
        if not self.hearing:
            faults = (f"no sound: {self.source_fault}",) if self.source_fault else ()
            return Status(hearing=False, track=None, snr_db=0.0, faults=faults)
        estimate = self.estimate
        if estimate is None:
            return Status(hearing=True, track=None, snr_db=0.0, faults=())
        detection = estimate.detection
        return Status(
            hearing=True,
            track=estimate.track,
            snr_db=detection.snr_db,
            faults=estimate.faults,
            others=estimate.tracks[1:],
            positions=estimate.positions,
            t_ns=self._middle_ns,
            noise_dbfs=detection.level_dbfs - detection.snr_db,
            pose=estimate.pose,
            simulated=self.settings.audio.source != "alsa",
            ambiguous=self.settings.bearing.estimator == "two-mic",
        )

    async def _tick(self) -> None:
        """What is due without a new estimate; once a second the status and the watchdog."""
        next_s = time.monotonic() + 1.0
        while True:
            await asyncio.sleep(TICK_S)
            if time.monotonic() - self._sent_s > TICK_S / 2.0:  # each frame sends what is due, too
                self._send()
            for number in range(len(self.links.links)):
                self._answer(number)
            if time.monotonic() < next_s:
                continue
            next_s = max(next_s, time.monotonic() - 1.0) + 1.0  # after a suspension no second is made up for
            if self._on_second is not None:
                self._on_second(self)
            self._tell_losses()
            self._watch_network()
            self._keep_parameters()
            if self.hearing or self.source_fault:
                notify(WATCHDOG="1", STATUS=self._in_words())
            else:
                notify(STATUS=self._in_words())
            self.counters.latency_s.clear()
            if self.black_box is not None:
                self.black_box.watch(**self._states())

    def _states(self) -> dict[str, dict[str, object]]:
        """What the black box keeps the changes of."""
        c = self.counters
        return {
            "link": {"up": self.links.up == len(self.links.links), "error": self.links.last_error},
            "source": {"fault": self.source_fault},
            "losses": {
                "frames": c.dropped,
                "overruns": c.sound.overruns,
                "messages": self.links.dropped,
                "flooded_bytes": self.links.flooded_bytes,
                "held_back": self.component.changes.held_back,
                "sound_s": round(c.sound.lost_s, 1),
            },
            "listening": {"on": self.component.listening},
            "parameters": dict(self.component.parameters.changed),
        }

    def _tell_losses(self) -> None:
        """To the log, when there are more; not every second of a bad hour."""
        c = self.counters
        losses = c.dropped, c.sound.overruns
        if losses == self._told_losses or time.monotonic() < self._tell_losses_s:
            return
        self._told_losses, self._tell_losses_s = losses, time.monotonic() + SAY_AGAIN_S
        log.warning("since the start: %d frames dropped, %s", c.dropped, c.sound)

    def _watch_network(self) -> None:
        """Tells the log what the others do not: that they ignore us, or that one of them goes by our ids.
        Keeps signing's timestamp."""
        complaints = self.component.complaints(time.monotonic())
        for complaint in complaints:
            if complaint not in self._complaints:
                log.warning("%s (docs/mavlink.md, What goes wrong)", complaint)
        self._complaints = complaints
        if time.monotonic() >= self._save_s:
            self._save_s = time.monotonic() + SAVE_S
            # a disk may take its time: not on the loop that carries sound
            asyncio.get_running_loop().run_in_executor(None, self._remember_timestamp)

    def _remember_timestamp(self) -> None:
        try:
            save_timestamp(state_file(self.settings), self.component.guard.timestamp)
        except LinkError as error:
            log.error("%s", error)

    def _in_words(self) -> str:
        """The service manager's status line: state, and every loss since the start."""
        c = self.counters
        state = "listening" if self.component.listening else "told to stop listening"
        if not self.hearing:
            state = f"no sound: {self.source_fault or 'waiting'}"
        losses = f"{c.dropped} dropped, {c.sound}, {self.links.dropped} messages lost"
        if self.links.flooded_bytes:
            losses += f", {self.links.flooded_bytes} bytes of a flood not read"
        if self.component.changes.held_back:
            losses += f", {self.component.changes.held_back} commands or parameters held back"
        if self.black_box is not None and self.black_box.lost:
            losses += f", {self.black_box.lost} log records lost"
        faults = list(self.estimate.faults) if self.hearing and self.estimate is not None else []
        down = [f"link down: {self.links.last_error}"] if self.links.last_error else []
        return "; ".join([state, *faults, f"{c.estimates} frames, {losses}", *down, *self._complaints])


def _unexpected(error: BaseException) -> BaseException | None:
    """What the log has to tell the way of, not only in words."""
    return None if isinstance(error, LocagenError) else error
