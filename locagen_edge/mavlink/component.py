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
- STATUSTEXT once per confirmed call, once per fault and once when a fault has gone.
- COMMAND_LONG to the autopilot, to have its attitude and position sent: never any other command.

ArduPilot forwards the first three between its links and writes the last two into its log. Times are monotonic
seconds. Call `due` only while the link is up, and `say_again` when it has come up: then nothing that
holds is said to nobody.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from locagen_edge.geometry import compass_deg
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer, Packet
from locagen_edge.mavlink.pose import READ, PoseHistory
from locagen_edge.mavlink.streams import Streams
from locagen_edge.settings import MavlinkSettings, PoseSettings
from locagen_edge.types import Track

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
CALLS_REMEMBERED = 16
"""tracks of which the operator was told; more than can be followed at a time"""
TEXTS_WAITING = 8
"""texts that may wait, 4 s of them; beyond that the newest is dropped and counted"""

_FIRST_SYSTEM_ID = 1  # until the autopilot is heard; every autopilot's default
_GROUND_STATION_ID = 255


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


class Component:
    """Collects what is heard on the link, and says what is due.

    `start_s` is the moment from which `time_boot_ms` counts; with 0 and Linux's monotonic clock that is
    the computer's boot, which is what the field is called.
    """

    def __init__(
        self, settings: MavlinkSettings, start_s: float = 0.0, pose: PoseSettings | None = None
    ) -> None:
        self._fixed_id = settings.system_id
        self._start_s = start_s
        self._framer = Framer()
        self._sender = dialect.Sender(self._fixed_id or _FIRST_SYSTEM_ID, settings.component_id)
        self._heartbeat = _Every(HEARTBEAT_S)
        self._values = _Every(1.0 / settings.rate_hz)
        self._text = _Every(TEXT_S)
        self._texts: deque[tuple[int, str]] = deque()
        self._faults: dict[str, float] = {}  # told, and when each was last there
        self._told: deque[int] = deque(maxlen=CALLS_REMEMBERED)
        pose = pose or PoseSettings()
        self._streams = Streams(pose.rate_hz)
        self.poses = PoseHistory(pose)
        """where the vehicle was, as its autopilot tells"""
        self.autopilot_heard_s: float | None = None
        """when the autopilot's last heartbeat came"""
        self.sent: Counter[str] = Counter()
        """frames made, by name: HEARTBEAT, STATUSTEXT, LG_AZB, ..."""
        self.texts_dropped = 0
        """texts for which the queue had no room"""

    @property
    def system_id(self) -> int:
        """The id under which we send."""
        return self._sender.system_id

    @property
    def received(self) -> Framer:
        """The framer, for its counters."""
        return self._framer

    # --- in -------------------------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> None:
        """Takes bytes from the link. Never raises on what they hold."""
        for packet in self._framer.feed(data):
            if packet.message_id == dialect.HEARTBEAT and _is_autopilot(packet):
                self._hear_autopilot(packet.system_id, now_s)
            elif packet.message_id in READ:
                self._hear_pose(packet, now_s)

    def _hear_autopilot(self, system_id: int, now_s: float) -> None:
        if system_id != (self._fixed_id or self.system_id):
            silent = self.autopilot_heard_s is None or now_s - self.autopilot_heard_s > AUTOPILOT_SILENT_S
            if self._fixed_id or not silent:
                return  # another vehicle on the same network
            self._sender.system_id = system_id
        self.autopilot_heard_s = now_s
        self._streams.hear_heartbeat(now_s)

    def _hear_pose(self, packet: Packet, now_s: float) -> None:
        """A message about the vehicle, from the autopilot whose heartbeat we follow."""
        if packet.component_id != dialect.COMPONENT_AUTOPILOT or packet.system_id != self.system_id:
            return
        reboots = self.poses.reboots
        self.poses.take(dialect.decode(packet.raw), round(now_s * 1e9))
        self._streams.hear_message(packet.message_id, now_s)
        if self.poses.reboots > reboots:
            self._streams.ask_all()

    # --- out ------------------------------------------------------------------------------------------

    def due(self, now_s: float, status: Status) -> list[bytes]:
        """The frames to send now. Call it several times as often as `rate_hz`, at least 10 times a second."""
        self._follow_faults(now_s, status.faults)
        if status.hearing:
            self._follow_call(status)
        return [self._pack(name, message) for name, message in self._messages(now_s, status)]

    def say_again(self) -> None:
        """The link has come up: tell again what holds now, to whoever is there now."""
        self._texts.clear()
        self._faults.clear()
        self._told.clear()

    def _messages(self, now_s: float, status: Status) -> Iterator[tuple[str, Any]]:
        if status.hearing and self._heartbeat.due(now_s):
            state = dialect.STATE_CRITICAL if status.faults else dialect.STATE_ACTIVE
            yield "HEARTBEAT", dialect.heartbeat(state)
        if status.hearing and (wanted := self._streams.due(now_s)) is not None:
            yield "COMMAND_LONG", dialect.set_message_interval(self.system_id, *wanted)
        if self._texts and self._text.due(now_s):
            yield "STATUSTEXT", dialect.statustext(*self._texts.popleft())
        if status.hearing and status.track and self._values.due(now_s):
            time_boot_ms = round((now_s - self._start_s) * 1000)
            for name, value in bearing_values(status.track, status.snr_db):
                yield name, dialect.named_value_float(time_boot_ms, name, value)

    def _pack(self, name: str, message: Any) -> bytes:
        self.sent[name] += 1
        return self._sender.pack(message)

    def _follow_call(self, status: Status) -> None:
        for track in (status.track, *status.others):
            if track and track.id not in self._told and is_confirmed(track):
                self._told.append(track.id)
                self._say(dialect.SEVERITY_NOTICE, call_text(track), first=True)

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


def call_text(track: Track) -> str:
    """One line for the operator, at most 50 characters: where a confirmed call comes from, with 1-sigma."""
    body = _whole(compass_deg(track.azimuth_rad))
    where, sigma = f"{body} deg clockwise from nose", math.degrees(track.azimuth_sigma_rad)
    if track.earth is not None and not math.isnan(true := compass_deg(track.earth.azimuth_rad)):
        where, sigma = (
            f"{_whole(true)} deg true, {body} from nose",
            math.degrees(track.earth.azimuth_sigma_rad),
        )
    return f"Call heard: {where}" + (f", +-{max(1, round(sigma))} deg" if 0 <= sigma <= 180 else "")


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


class _Every:
    """Says when a period has passed, without drift; after a pause it begins anew at once."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._next_s = -math.inf

    def due(self, now_s: float) -> bool:
        if now_s < self._next_s:
            return False
        on_time = now_s - self._next_s < self._period_s
        self._next_s = (self._next_s if on_time else now_s) + self._period_s
        return True
