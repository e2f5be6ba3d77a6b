"""What we say, and when: a MAVLink component's voice, without I/O or clock.

The profile, for any ground station and autopilot as they are:

- HEARTBEAT at 1 Hz, type ONBOARD_CONTROLLER, autopilot INVALID, under the vehicle's own system id (ground
  stations drop other ids), and only while sound is heard: whoever watches the heartbeat sees a deaf
  companion as a lost one. `system_status` is ACTIVE, or CRITICAL with a microphone fault: "not normal, but
  can still work" is what MAV_STATE_CRITICAL means, and bearings go on with what is left.
  Never system id 255: a ground station's failsafe hangs on that one.
- NAMED_VALUE_FLOAT while a track lives, all of one moment with one time, for the best track: LG_AZB (degrees
  clockwise from the nose, 0 to 360), LG_AZ (from true north, where the attitude is known), LG_EL (degrees
  above the horizon, or that of the body where the attitude is not known; left out where the array cannot
  tell), LG_SIG (1-sigma of the azimuth, degrees: of LG_AZ where it is sent, compass and all), LG_CONF (0 to
  1), LG_SNR (dB, in-band).
- LOCAGEN_BEARING at the same rate for the best track and every other confirmed one, LOCAGEN_POSITION for
  those whose place is known; once a second that nothing is heard. As messages and inside TUNNEL.
- STATUSTEXT once per confirmed call, once when its place is known, once per fault and once when a fault has
  gone, in chunks where it is long; and how many had to be left out, where they came too fast.
- COMMAND_LONG to the autopilot, to have its attitude and position sent: never any other command, unless the
  settings file switches on what acts on flight (`flight.py`).
- TIMESYNC, asked of the autopilot and answered (`timesync.py`).
- Answers to parameters (`parameters.py`) and commands (`commands.py`), to the link that asked.
- What the switches `mavlink.send_...` let out; nothing that is not in `dialect.SENT` ever leaves.

ArduPilot forwards HEARTBEAT, NAMED_VALUE_FLOAT, TUNNEL and STATUSTEXT between its links, and writes values
and texts into its log. Times are monotonic
seconds. Call `due` only while the link is up, and `say_again` when it has come up: then nothing that
holds is said to nobody.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from locagen_edge.geodesy import north_east_down_m
from locagen_edge.geometry import compass_deg
from locagen_edge.mavlink import dialect, parameters, timesync
from locagen_edge.mavlink.commands import Commands
from locagen_edge.mavlink.flight import Interlock
from locagen_edge.mavlink.framer import Framer, Packet
from locagen_edge.mavlink.identity import version_message
from locagen_edge.mavlink.pace import AtMost, Every
from locagen_edge.mavlink.parameters import Parameters
from locagen_edge.mavlink.pose import READ, PoseHistory
from locagen_edge.mavlink.rates import Rates
from locagen_edge.mavlink.records import BearingRecord, PositionRecord, bearing_message, position_message
from locagen_edge.mavlink.signing import Guard
from locagen_edge.mavlink.streams import GAP_S, Streams
from locagen_edge.mavlink.targets import Place, adsb_vehicle, camera_target
from locagen_edge.mavlink.timesync import SyncedClock
from locagen_edge.mavlink.twins import Numbers, Twins
from locagen_edge.settings import MavlinkSettings, PoseSettings, Settings
from locagen_edge.types import Pose, Position, Track

HEARTBEAT_S = 1.0
"""what MAVLink's heartbeat protocol asks of every component"""
AUTOPILOT_SILENT_S = 10.0
"""after this long without the autopilot another one may give its system id: ids change at its reboot"""
CONFIRM_CONFIDENCE = 0.5
CONFIRM_AGE_S = 0.3
"""a call counts as confirmed from here on: six frames, and most of them agreed"""
FAULT_GONE_S = 5.0
"""a fault has gone when it stayed away this long: one that flickers is told once, not each time"""
TEXT_S = 0.5
"""least mean distance of two texts: a radio link at 57600 baud and a reader's eye both bear it"""
NOTHING_S = 1.0
"""how often it is told at most that nothing is heard"""
CALLS_REMEMBERED = 16
"""tracks of which the operator was told; more than can be followed at a time"""
TEXTS_WAITING = 8
"""texts that may wait, 4 s of them; beyond that the newest is dropped, counted, and the number told after"""
REFUSED_S = 5.0
"""the same refusal of a parameter is told once in this time"""
PLACES_S = 1.0
COMPUTER_S = 2.0
"""how often callers' places are told as traffic and as a target, and how the computer does"""
CHANGES_PER_S, CHANGES_AT_ONCE = 20.0, 64
"""values and commands that are obeyed in a second, and at once (a ground station sends a whole file of
parameters): each costs a check of all settings. What comes beyond goes unanswered, and comes again."""
ANSWERS_AT_ONCE = 10
"""answers to a link at a time, 100 a second: a radio link carries no more"""
ANSWERS_WAITING = 64
"""answers that may wait for a link; beyond that the oldest goes, whoever asked will ask again"""

_FIRST_SYSTEM_ID = 1  # until the autopilot is heard; every autopilot's default
_GROUND_STATION_ID = 255


Moment = tuple[int, bool]
"""microseconds, and whether they are on the autopilot's clock"""
Made = Iterator[tuple[str, Any]]
"""names among the counters, and messages"""


@dataclass(frozen=True, slots=True)
class Status:
    """What the daemon knows at this moment."""

    hearing: bool
    """frames of sound arrive"""
    track: Track | None
    snr_db: float
    faults: tuple[str, ...]
    """what is wrong now, in words for the operator; the same fault always in the same words"""
    others: tuple[Track, ...] = ()
    """callers beside `track`; the operator is told of each, values are sent of `track` alone"""
    positions: tuple[Position, ...] = ()
    """of any of them, by the track's id"""
    t_ns: int = 0
    """monotonic time of the middle of the sound that all this follows from"""
    noise_dbfs: float | None = None
    """tracked background"""
    pose: Pose | None = None
    """of the vehicle at that time"""
    simulated: bool = False
    """the sound is synthetic or recorded"""
    ambiguous: bool = False
    """a bearing and its mirror image at the axis of the microphones are as likely: there are two of them"""

    def place(self, track: Track) -> Position | None:
        """Where the caller of this track is; None too where no range is observable."""
        return next((p for p in self._on_earth if p.caller == track.id), None)

    @property
    def _on_earth(self) -> Iterator[Position]:
        for p in self.positions:
            known = p.latitude_deg is not None and p.longitude_deg is not None
            if known and abs(p.latitude_deg or 0.0) <= 90.0 and abs(p.longitude_deg or 0.0) <= 180.0:
                yield p

    @property
    def places(self) -> tuple[Place, ...]:
        """Of all callers whose place is known."""
        return tuple(
            Place(
                p.caller, p.latitude_deg or 0.0, p.longitude_deg or 0.0, p.altitude_m, p.semi_major_m, p.age_s
            )
            for p in self._on_earth
        )


def _nothing(*_: Any) -> None:
    """What a component without a daemon around it does."""


@dataclass(frozen=True, slots=True)
class Hands:
    """What others may ask of the daemon through the component. None of it may wait or raise."""

    apply: Callable[[Settings], None] = _nothing
    """these settings hold from now on"""
    listen: Callable[[bool], None] = _nothing
    forget_noise: Callable[[], None] = _nothing
    computer: Callable[[int], Any] = _nothing
    """ONBOARD_COMPUTER_STATUS at a monotonic time (ns)"""
    uid: int = 0
    """of this computer"""


class Component:
    """Collects what is heard on the link, and says what is due.

    `start_s` is the moment from which `time_boot_ms` counts; with 0 and Linux's monotonic clock that is
    the computer's boot, which is what the field is called. `whole`: all settings, for what can be changed by
    parameters, and `base`: as the file has them, without what was changed before.
    """

    def __init__(
        self,
        settings: MavlinkSettings,
        start_s: float = 0.0,
        pose: PoseSettings | None = None,
        guard: Guard | None = None,
        numbers: Numbers | None = None,
        *,
        whole: Settings | None = None,
        base: Settings | None = None,
        hands: Hands | None = None,
    ) -> None:
        whole = whole or Settings(mavlink=settings, pose=pose or PoseSettings())
        self.parameters = Parameters(whole, base)
        self.listening = True
        """False: told to stop"""
        self._hands = hands or Hands()
        self._commands = Commands(self)
        self._interlock = Interlock(whole.flight)
        self._allowed = _allowed(settings)
        self._last: dict[int, Any] = {}
        self.guard = guard or Guard()
        """who may speak to us"""
        self._fixed_id = settings.system_id
        self._start_s = start_s
        self.received: defaultdict[int, Framer] = defaultdict(Framer)
        """the framers by link, for their counters"""
        self.own: dict[int, list[bytes]] = {}
        """beside what `due` returned last: frames for one link alone, which has asked for another interval"""
        self._answers: defaultdict[int, deque[bytes]] = defaultdict(lambda: deque(maxlen=ANSWERS_WAITING))
        self._sender = dialect.Sender(
            self._fixed_id or _FIRST_SYSTEM_ID,
            settings.component_id,
            dialect.COMMANDS | self._interlock.commands,
        )
        self._heartbeat = Every(HEARTBEAT_S)
        self._rates = Rates(_periods(settings), NOTHING_S)
        self._twins = Twins(numbers or Numbers())
        self.changes = AtMost(CHANGES_PER_S, CHANGES_AT_ONCE)
        """of settings and state, by others"""
        self._text = Every(TEXT_S)
        self._texts: deque[tuple[int, str]] = deque()
        self._faults: dict[str, float] = {}  # told, and when each was last there
        self._told: deque[int] = deque(maxlen=CALLS_REMEMBERED)
        self._placed: deque[int] = deque(maxlen=CALLS_REMEMBERED)
        pose = pose or PoseSettings()
        self._streams = Streams(pose.rate_hz)
        self.clock = SyncedClock()
        """the autopilot's"""
        self.poses = PoseHistory(pose, self.clock)
        """where the vehicle was, as its autopilot tells"""
        self.autopilot_heard_s: float | None = None
        """when the autopilot's last heartbeat came"""
        self.sent: Counter[str] = Counter()
        """frames made, by name: HEARTBEAT, STATUSTEXT, LG_AZB, ..."""
        self.texts_dropped = 0
        """texts for which the queue had no room"""
        self._dropped_told = 0
        self._refused = "", -math.inf
        self._text_number = 0

    @property
    def settings(self) -> Settings:
        """With all parameters as they are now."""
        return self.parameters.settings

    @property
    def system_id(self) -> int:
        """The id under which we send."""
        return self._sender.system_id

    # --- in -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float, link: int = 0) -> None:
        """Takes bytes from a link, by its number. Never raises on what they hold."""
        for packet in self.received[link].feed(data):
            if not self.guard.admit(packet, now_s):
                continue
            if (packet.system_id, packet.component_id) == (self.system_id, self._sender.component_id):
                self._twins.hear(packet, now_s)  # and nothing is obeyed or answered: two could go on for ever
                continue
            if packet.message_id == dialect.HEARTBEAT and _is_autopilot(packet):
                self._hear_autopilot(packet, now_s)
            elif packet.message_id == dialect.COMMAND_ACK:
                self._hear_answer(packet, now_s)
            elif packet.message_id in _REQUESTS:
                _REQUESTS[packet.message_id](self, packet, dialect.decode(packet.raw), link, now_s)
            elif packet.message_id in READ:
                self._hear_pose(packet, now_s)

    def _hear_autopilot(self, packet: Packet, now_s: float) -> None:
        if packet.system_id != (self._fixed_id or self.system_id):
            silent = self.autopilot_heard_s is None or now_s - self.autopilot_heard_s > AUTOPILOT_SILENT_S
            if self._fixed_id or not silent:
                return  # another vehicle on the same network
            self._sender.system_id = packet.system_id
            self.clock.forget()
        self.autopilot_heard_s = now_s
        self._streams.hear_heartbeat(now_s)
        self._interlock.hear_heartbeat(dialect.decode(packet.raw), now_s)

    def _hear_pose(self, packet: Packet, now_s: float) -> None:
        """A message about the vehicle, from the autopilot whose heartbeat we follow."""
        if packet.component_id != dialect.COMPONENT_AUTOPILOT or packet.system_id != self.system_id:
            return
        reboots = self.poses.reboots
        self.poses.take(dialect.decode(packet.raw), round(now_s * 1e9))
        self._streams.hear_message(packet.message_id, now_s)
        if self.poses.reboots > reboots:
            self._streams.ask_all()

    def _hear_answer(self, packet: Packet, now_s: float) -> None:
        """The autopilot answers; older firmware names no target."""
        message = dialect.decode(packet.raw)
        if packet.system_id == self.system_id and message.target_component in (0, self._sender.component_id):
            self.guard.answered()
            if packet.component_id == dialect.COMPONENT_AUTOPILOT and (
                text := self._interlock.hear_answer(message, now_s)
            ):
                self._say(dialect.SEVERITY_WARNING, text)

    def _hear_ping(self, packet: Packet, message: Any, link: int, _: float) -> None:
        """A ping at nobody in particular asks all to answer it to its sender."""
        if message.target_system == 0 and message.target_component == 0:
            self._answer(link, dialect.ping(message, packet.system_id, packet.component_id))

    def _hear_timesync(self, packet: Packet, message: Any, link: int, now_s: float) -> None:
        now_ns = round(now_s * 1e9)
        if answer := timesync.answer(message, now_ns):
            self._answer(link, answer)
        elif (packet.system_id, packet.component_id) == (self.system_id, dialect.COMPONENT_AUTOPILOT):
            self.clock.answered(message, now_ns)

    def _hear_list(self, _: Packet, message: Any, link: int, __: float) -> None:
        if self._is_ours(message) or self._is_to_all(message):
            self.parameters.list_to(link)

    def _hear_read(self, _: Packet, message: Any, link: int, __: float) -> None:
        if self._is_ours(message):
            self._answer(link, *self.parameters.read(message))

    def _hear_set(self, _: Packet, message: Any, link: int, now_s: float) -> None:
        if not self._is_ours(message) or not self.changes.admits(now_s):
            return
        before = self.settings
        answers, fault = self.parameters.set(message)
        self._answer(link, *answers)
        if fault and (fault != self._refused[0] or now_s - self._refused[1] > REFUSED_S):
            self._say(dialect.SEVERITY_WARNING, fault)
            self._refused = fault, now_s  # who is refused asks again, five times over
        if self.settings != before:
            self._follow_settings(before)
            self._hands.apply(self.settings)

    def _hear_file(self, packet: Packet, message: Any, link: int, _: float) -> None:
        if self._is_ours(message):
            answer = parameters.no_files(message, packet.system_id, packet.component_id)
            self._answer(link, *([answer] if answer else []))

    def _hear_command(self, packet: Packet, message: Any, link: int, now_s: float) -> None:
        sender = (packet.system_id, packet.component_id)
        ours = self._is_ours(message)
        if ours or self._is_to_all(message):
            self._answer(link, *self._commands.obey(message, sender, link, now_s, to_all=not ours))

    def _is_ours(self, message: Any) -> bool:
        target = (message.target_system, message.target_component)
        return target == (self.system_id, self._sender.component_id)

    def _is_to_all(self, message: Any) -> bool:
        return (message.target_system, message.target_component) == (self.system_id, 0)

    # --- what commands act on (commands.Desk) ---------------------------------------------------------

    def listen(self, on: bool, /) -> None:
        """Starts or stops listening."""
        if on != self.listening:
            self.listening = on
            text = "Listening again" if on else "Stopped listening, as commanded"
            self._say(dialect.SEVERITY_NOTICE, text)
            self._hands.listen(on)

    def forget_noise(self) -> None:
        """Starts learning the noise from nothing."""
        self._say(dialect.SEVERITY_NOTICE, "Learning the noise anew, as commanded")
        self._hands.forget_noise()

    def requested(self, message_id: int, /) -> Any | None:
        """A message of ours that may be asked for once."""
        if message_id == dialect.AUTOPILOT_VERSION:
            return version_message(self._hands.uid)
        return self._last.get(message_id) if message_id in self._allowed else None

    def interval_s(self, message_id: int, link: int, /) -> float | None:
        """How often a message of ours is sent there; infinite: it is switched off; None: none of ours."""
        if message_id == dialect.HEARTBEAT:
            return HEARTBEAT_S
        if message_id not in _KINDS:
            return None
        return self._rates.period_s(link, message_id) if message_id in self._allowed else math.inf

    def set_interval(self, message_id: int, period_s: float | None, link: int, /) -> bool:
        """On that link; None: as the settings say. False: it is none that can be set."""
        if message_id not in _KINDS:
            return False  # nor the heartbeat: its second is what others judge us by
        self._rates.ask(link, message_id, period_s)
        return True

    def may_change(self, now_s: float, /) -> bool:
        """Whether one more command is obeyed now."""
        return self.changes.admits(now_s)

    def put_back(self, settings: Settings, why: str) -> None:
        """The pipeline could not be made for what a parameter asked: these settings hold."""
        before = self.settings
        for message in self.parameters.put_back(settings):
            for link in self.received:
                self._answer(link, message)
        self._follow_settings(before)
        self._say(dialect.SEVERITY_WARNING, why)

    def tell_fault(self, text: str) -> None:
        """Something that the daemon could not do."""
        self._say(dialect.SEVERITY_WARNING, text)

    def _follow_settings(self, before: Settings) -> None:
        """What of them is the component's own."""
        now = self.settings
        self._allowed = _allowed(now.mavlink)
        self._rates.follow(_periods(now.mavlink))
        if now.pose.rate_hz != before.pose.rate_hz:
            self._streams.rate_hz = now.pose.rate_hz
            self._streams.ask_all()

    # --- out ------------------------------------------------------------------------------------------

    def due(self, now_s: float, status: Status) -> list[bytes]:
        """The frames for all links to send now, but for those that are `apart`; beside them, those in `own`.
        Call it several times as often as `rate_hz`, at least 10 times a second."""
        self._follow_faults(now_s, (*status.faults, *self.complaints(now_s)))
        if status.hearing and self.listening:
            self._follow_call(status)
        for of, value in self.parameters.due(now_s):
            self._answer(of, value)
        frames = []
        self.own = {}
        for link, name, message in self._messages(now_s, status):
            if message.get_msgId() not in self._allowed and message.get_msgId() != dialect.COMMAND_INT:
                continue
            if link is None:
                frames.append(self._pack(name, message))
            else:
                self.own.setdefault(link, []).append(self._pack(name, message))
            if name == "COMMAND_LONG":
                self.guard.asked(now_s)
        return frames

    def apart(self, frame: bytes) -> frozenset[int]:
        """Links to which this frame, one for all, does not go: they have asked for it at other times."""
        id = int.from_bytes(frame[7:10], "little")
        return self._rates.apart(_GOES_WITH.get(id, id))

    def complaints(self, now_s: float) -> tuple[str, ...]:
        """What is wrong on the network, in words for the operator."""
        ours = self.system_id, self._sender.component_id
        return (*self.guard.complaints(now_s), *self._twins.complaints(now_s, *ours))

    def answers(self, link: int) -> list[bytes]:
        """The frames that go to this link alone, as many as may go now."""
        waiting = self._answers[link]
        return [waiting.popleft() for _ in range(min(len(waiting), ANSWERS_AT_ONCE))]

    def say_again(self) -> None:
        """The link has come up: tell again what holds now, to whoever is there now."""
        self._texts.clear()
        self._faults.clear()
        self._told.clear()
        self._placed.clear()

    def _messages(self, now_s: float, status: Status) -> Iterator[tuple[int | None, str, Any]]:
        """To whom (None: to all), its name among the counters, and what."""
        if status.hearing and self._heartbeat.due(now_s):
            state = dialect.STATE_ACTIVE if self.listening else dialect.STATE_STANDBY
            yield None, "HEARTBEAT", dialect.heartbeat(dialect.STATE_CRITICAL if status.faults else state)
        if status.hearing and (wanted := self._streams.due(now_s)) is not None:
            yield None, "COMMAND_LONG", dialect.set_message_interval(self.system_id, *wanted)
        if self.autopilot_heard_s is not None and now_s - self.autopilot_heard_s < GAP_S:
            asked = self.clock.ask(now_s, round(now_s * 1e9)) if status.hearing else None
            if asked:
                yield None, "TIMESYNC", asked
        for chunk in self._due_texts(now_s):
            yield None, "STATUSTEXT", chunk
        sounds = status.hearing and self.listening
        for id, kind in _KINDS.items():
            if not (kind.there(status) and (sounds or kind.deaf_too)):
                continue
            quiet = id == dialect.LOCAGEN_BEARING and status.track is None
            if links := self._rates.due(id, now_s, quiet=quiet):
                made = list(kind.make(self, now_s, status))
                for link in links:
                    yield from ((link, name, message) for name, message in made)
        if not sounds:
            return
        called = status.track if status.track and is_confirmed(status.track) else None
        for command, text in self._interlock.due(now_s, self.system_id, called, status.places):
            self._say(dialect.SEVERITY_WARNING, text, first=True)
            yield None, command.get_type(), command

    def _due_texts(self, now_s: float) -> Iterator[Any]:
        if not self._texts and self.texts_dropped > self._dropped_told:
            left_out = self.texts_dropped - self._dropped_told
            self._dropped_told = self.texts_dropped
            self._say(dialect.SEVERITY_INFO, f"{left_out} texts were left out: too many at once")
        if self._texts and self._text.due(now_s):
            self._text_number = self._text_number % 0xFFFF + 1
            yield from dialect.statustexts(*self._texts.popleft(), self._text_number)

    # --- what repeats (the table _KINDS)

    def _values(self, now_s: float, status: Status) -> Made:
        time_boot_ms = round((now_s - self._start_s) * 1000)
        assert status.track is not None
        for name, value in bearing_values(status.track, status.snr_db):
            yield name, dialect.named_value_float(time_boot_ms, name, value)

    def _records(self, _: float, status: Status) -> Made:
        """LOCAGEN_BEARING and LOCAGEN_POSITION of all callers, or that nothing is heard."""
        for message in self._record_messages(status):
            yield message.get_type(), message
            yield "TUNNEL", dialect.tunnel(message)

    def _record_messages(self, status: Status) -> Iterator[Any]:
        time = self._time_of(status)
        if status.track is None:
            yield bearing_message(_bearing_record(time, status, None))
            return
        for track in (status.track, *status.others):
            if track is not status.track and not is_confirmed(track):
                continue
            yield bearing_message(_bearing_record(time, status, track))
            place = status.place(track)
            if place is not None and is_confirmed(track):
                yield position_message(_position_record(time, status, place, track.id in self._placed))

    def _traffic(self, _: float, status: Status) -> Made:
        for place in status.places:
            if place.somewhere:
                yield "ADSB_VEHICLE", adsb_vehicle(place)

    def _target(self, now_s: float, status: Status) -> Made:
        """Of targets there is one, the surest."""
        here = self.poses.at(round(now_s * 1e9))
        from_deg = None
        if here.latitude_deg is not None and here.longitude_deg is not None:
            from_deg = (here.latitude_deg, here.longitude_deg)
        surest = min((p for p in status.places if p.somewhere), key=lambda place: place.sigma_m)
        yield "CAMERA_TRACKING_GEO_STATUS", camera_target(surest, from_deg)

    def _computer(self, now_s: float, _: Status) -> Made:
        if dialect.ONBOARD_COMPUTER_STATUS not in self._allowed:
            return  # its reading costs milliseconds
        computer = self._hands.computer(round(now_s * 1e9))
        if computer is not None:
            yield "ONBOARD_COMPUTER_STATUS", computer

    def _time_of(self, status: Status) -> Moment:
        """Of the sound: on the autopilot's clock where that is known, else since our start."""
        time_us, on_autopilot = self.clock.time_us(status.t_ns)
        return time_us if on_autopilot else time_us - round(self._start_s * 1e6), on_autopilot

    def _answer(self, link: int, *messages: Any) -> None:
        for message in messages:
            self._answers[link].append(self._pack(message.get_type(), message))

    def _pack(self, name: str, message: Any) -> bytes:
        self.sent[name] += 1
        if message.get_msgId() in _REMEMBERED:
            self._last[message.get_msgId()] = message
        return self._sender.pack(message)

    def _follow_call(self, status: Status) -> None:
        for track in (status.track, *status.others):
            if not track or not is_confirmed(track):
                continue
            how_far = _how_far(status, track) if track.id not in self._placed else ""
            if track.id not in self._told or how_far:
                self._say(
                    dialect.SEVERITY_NOTICE, call_text(track, how_far, ambiguous=status.ambiguous), first=True
                )
                self._told.append(track.id)
            if how_far:
                self._placed.append(track.id)

    def _follow_faults(self, now_s: float, faults: tuple[str, ...]) -> None:
        for fault in faults:
            if fault not in self._faults:
                self._say(dialect.SEVERITY_WARNING, fault)
            self._faults[fault] = now_s
        for fault, last_s in list(self._faults.items()):
            if now_s - last_s > FAULT_GONE_S:
                del self._faults[fault]
                self._say(dialect.SEVERITY_NOTICE, f"Cleared: {fault}")

    def _say(self, severity: int, text: str, *, first: bool = False) -> None:
        """Queues a text; a call goes before faults, and the youngest fault makes room for it."""
        if len(self._texts) >= TEXTS_WAITING:
            self.texts_dropped += 1
            if not first:
                return
            self._texts.pop()
        (self._texts.appendleft if first else self._texts.append)((severity, text))


def is_confirmed(track: Track) -> bool:
    """Whether the operator should be told of this call."""
    return (
        track.confidence >= CONFIRM_CONFIDENCE
        and track.age_s >= CONFIRM_AGE_S
        and not math.isnan(compass_deg(track.azimuth_rad))
    )


def bearing_values(track: Track, snr_db: float) -> Iterator[tuple[str, float]]:
    """Names and values of a bearing, clamped to their range; what is not a number is left out.

    An infinite sigma is the most there is, 180 degrees: a missing value would leave the last good one on
    the ground station's screen.
    """
    shown = track.earth or track
    yield from _value("LG_AZB", compass_deg(track.azimuth_rad), 0, 360)
    if track.earth is not None:
        yield from _value("LG_AZ", compass_deg(track.earth.azimuth_rad), 0, 360)
    if shown.elevation_rad is not None:
        yield from _value("LG_EL", math.degrees(shown.elevation_rad), -90, 90)
    yield from _value("LG_SIG", math.degrees(shown.azimuth_sigma_rad), 0, 180)
    yield from _value("LG_CONF", track.confidence, 0, 1)
    yield from _value("LG_SNR", snr_db, -200, 200)


def call_text(track: Track, how_far: str = "", *, ambiguous: bool = False) -> str:
    """One line for the operator, at most 50 characters: where a confirmed call comes from, with 1-sigma.

    `how_far`: the distance in words, where it is known; it takes the place of the bearing's sigma.
    `ambiguous`: the mirror image at the axis of the microphones is as likely.
    """
    body = compass_deg(track.azimuth_rad)
    sigma = math.degrees(track.azimuth_sigma_rad)
    where = f"{_whole(body)} from nose" if ambiguous else f"{_whole(body)} deg clockwise from nose"
    if track.earth is not None and not math.isnan(true := compass_deg(track.earth.azimuth_rad)):
        sigma = math.degrees(track.earth.azimuth_sigma_rad)
        where = f"{_whole(true)} deg true"
        if not (how_far or ambiguous):
            where += f", {_whole(body)} from nose"
    if ambiguous:
        where += " or mirrored"
    if how_far:
        text = f"Call heard: {where}, {how_far}"
        sure = f", conf {track.confidence:.1f}" if 0.0 <= track.confidence <= 1.0 else ""
        return text + sure if len(text + sure) <= dialect.TEXT_BYTES else text
    return f"Call heard: {where}" + (f", +-{max(1, round(sigma))} deg" if 0 <= sigma <= 180 else "")


def _how_far(status: Status, track: Track) -> str:
    """How far from the vehicle the caller is, over the ground, with the longer semi-axis (1-sigma)."""
    place, pose = status.place(track), status.pose
    if place is None or pose is None or pose.latitude_deg is None or pose.longitude_deg is None:
        return ""
    assert place.latitude_deg is not None
    assert place.longitude_deg is not None
    away = north_east_down_m(
        place.latitude_deg, place.longitude_deg, 0.0, pose.latitude_deg, pose.longitude_deg, 0.0
    )
    return f"{math.hypot(away[0], away[1]):.0f} m +-{max(1, round(place.semi_major_m))} m"


def _bearing_record(time: Moment, status: Status, track: Track | None) -> BearingRecord:
    heard = BearingRecord(
        time_us=time[0],
        autopilot_time=time[1],
        event_id=0,
        snr_db=status.snr_db,
        noise_dbfs=status.noise_dbfs,
        pose=status.pose,
        microphone_fault=bool(status.faults),
        simulated=status.simulated,
    )
    if track is None:
        return heard
    return replace(
        heard,
        event_id=track.id,
        azimuth_body_rad=track.azimuth_rad,
        azimuth_true_rad=None if track.earth is None else track.earth.azimuth_rad,
        azimuth_sigma_rad=track.azimuth_sigma_rad,
        elevation_rad=track.elevation_rad,
        elevation_sigma_rad=None if track.elevation_rad is None else track.elevation_sigma_rad,
        confidence=track.confidence,
        confirmed=is_confirmed(track),
        ambiguous=status.ambiguous,
    )


def _position_record(time: Moment, status: Status, place: Position, told: bool) -> PositionRecord:
    assert place.latitude_deg is not None
    assert place.longitude_deg is not None
    (nn, ne), (_, ee) = place.covariance_m2.tolist()
    # the ground at the caller is told where a depression over a height was: without one, bearings crossed
    on_ground = place.altitude_m is not None
    return PositionRecord(
        time_us=time[0],
        autopilot_time=time[1],
        event_id=place.caller,
        latitude_deg=place.latitude_deg,
        longitude_deg=place.longitude_deg,
        altitude_m=place.altitude_m,
        covariance_m2=(nn, ne, ee),
        age_s=place.age_s,
        looks=place.looks,
        triangulated=not on_ground,
        on_ground=on_ground,
        confirmed=told,
        simulated=status.simulated,
    )


def _whole(degrees: float) -> str:
    return f"{round(degrees) % 360:03d}"


def _value(name: str, value: float, least: float, most: float) -> Iterator[tuple[str, float]]:
    """The value as the wire carries it (float32), or nothing. A turn that float32 rounds to 360 is 0."""
    if math.isnan(value):
        return
    (wire,) = struct.unpack("<f", struct.pack("<f", min(max(value, least), most)))
    yield name, 0.0 if wire == 360.0 else wire + 0.0


def _is_autopilot(packet: Packet) -> bool:
    """Whether a heartbeat comes from the vehicle's autopilot, whose system id is ours too."""
    if packet.component_id != dialect.COMPONENT_AUTOPILOT or packet.system_id in (0, _GROUND_STATION_ID):
        return False
    message = dialect.decode(packet.raw)
    return bool(message.type != dialect.TYPE_GROUND_STATION and message.autopilot != dialect.AUTOPILOT_NONE)


def _periods(settings: MavlinkSettings) -> dict[int, float]:
    """What repeats, and how often in seconds, as the settings say."""
    return {
        dialect.NAMED_VALUE_FLOAT: 1.0 / settings.rate_hz,
        dialect.LOCAGEN_BEARING: 1.0 / settings.rate_hz,  # LOCAGEN_POSITION goes with it
        dialect.ADSB_VEHICLE: PLACES_S,
        dialect.CAMERA_TRACKING_GEO_STATUS: PLACES_S,
        dialect.ONBOARD_COMPUTER_STATUS: COMPUTER_S,
    }


def _allowed(settings: MavlinkSettings) -> frozenset[int]:
    """The messages that the switches let out."""
    on = (ids for name, ids in dialect.SWITCHED.items() if getattr(settings, name))
    return dialect.ALWAYS_SENT.union(*on)


@dataclass(frozen=True, slots=True)
class _Kind:
    """One of the messages that repeat."""

    make: Callable[[Component, float, Status], Made]
    there: Callable[[Status], bool]
    """whether there is anything to say"""
    deaf_too: bool = False


def _somewhere(status: Status) -> bool:
    return any(place.somewhere for place in status.places)


_KINDS: dict[int, _Kind] = {
    dialect.ONBOARD_COMPUTER_STATUS: _Kind(Component._computer, lambda _: True, deaf_too=True),
    dialect.NAMED_VALUE_FLOAT: _Kind(Component._values, lambda status: status.track is not None),
    dialect.LOCAGEN_BEARING: _Kind(Component._records, lambda _: True),
    dialect.ADSB_VEHICLE: _Kind(Component._traffic, _somewhere),
    dialect.CAMERA_TRACKING_GEO_STATUS: _Kind(Component._target, _somewhere),
}
_GOES_WITH = {
    dialect.LOCAGEN_POSITION: dialect.LOCAGEN_BEARING,
    dialect.TUNNEL: dialect.LOCAGEN_BEARING,
}
_REMEMBERED = frozenset({dialect.LOCAGEN_BEARING, dialect.LOCAGEN_POSITION, dialect.ONBOARD_COMPUTER_STATUS})
_REQUESTS: dict[int, Callable[[Component, Packet, Any, int, float], None]] = {
    dialect.PING: Component._hear_ping,
    dialect.TIMESYNC: Component._hear_timesync,
    dialect.PARAM_REQUEST_LIST: Component._hear_list,
    dialect.PARAM_REQUEST_READ: Component._hear_read,
    dialect.PARAM_SET: Component._hear_set,
    dialect.FILE_TRANSFER_PROTOCOL: Component._hear_file,
    dialect.COMMAND_LONG: Component._hear_command,
    dialect.COMMAND_INT: Component._hear_command,
}
"""what is asked of us, and where it goes"""
