"""Where the vehicle was, and how it was turned, when a sound reached the microphones.

The autopilot's messages are kept for a few seconds under its own clock and interpolated at the time asked
for: attitudes by slerp, position and heights on a line. Between messages that are far apart, and further
after the last than the settings allow, nothing is known, and `Pose` says None.

Height over ground comes from whatever knows it best now, each with a sigma that says which it was: a
rangefinder that looks down, the autopilot's terrain data, else the height over the take-off place with the
relief of the land in its sigma.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from locagen_edge.geometry import quaternion, slerp
from locagen_edge.settings import PoseSettings
from locagen_edge.types import Pose, Quaternion

T = TypeVar("T")

KEPT = 256
"""messages kept of a kind: 5 s at 50 Hz"""
DRIFT = 2e-4
"""how fast two computers' clocks drift apart at worst: crystals are good for 1e-4 each"""
REBOOT_MS = 2000.0
"""a `time_boot_ms` this much before the last one is another boot; less: one message overtook the other"""
LATE_MS = 1000.0
"""nothing but messages later than `REBOOT_MS` for so long: no link holds so much back. It is another boot,
whose time has passed the last one's while nothing was heard"""

RANGEFINDER_M = 0.1
RANGEFINDER_SHARE = 0.03
"""1-sigma of a rangefinder that does not tell its own: a share of the distance on top (grass, slope)"""
TERRAIN_M = 8.0
"""1-sigma of heights over terrain data: SRTM's is 16 m at 90 %, mostly of shape and trees, plus the baro's"""
STEEPEST_COS = 0.5
"""leaning by more than 60 degrees a rangefinder looks past the ground below"""


class BootClock:
    """The autopilot's `time_boot_ms` against our monotonic clock, from arrivals alone.

    A message can be late but not early, so the least (arrival - boot time) of late is the offset, and it may
    rise by no more than clocks drift. What is left is the way's shortest delay, some milliseconds.
    """

    def __init__(self) -> None:
        self._offset_ms = math.inf
        self._heard_ms = -math.inf
        self._late_since_ms: float | None = None

    def hear(self, time_boot_ms: float, arrived_ns: int) -> bool:
        """Takes the time of a message. True: the autopilot has started anew, and so has this clock."""
        arrived_ms = arrived_ns * 1e-6
        rebooted = time_boot_ms < self._heard_ms - REBOOT_MS or self._long_late(time_boot_ms, arrived_ms)
        if rebooted:
            self._late_since_ms = None
            self._offset_ms = math.inf
        elif math.isfinite(self._offset_ms):
            self._offset_ms += DRIFT * max(time_boot_ms - self._heard_ms, 0.0)
        self._heard_ms = time_boot_ms if rebooted else max(time_boot_ms, self._heard_ms)
        self._offset_ms = min(self._offset_ms, arrived_ms - time_boot_ms)
        return rebooted

    def _long_late(self, time_boot_ms: float, arrived_ms: float) -> bool:
        if arrived_ms - time_boot_ms - self._offset_ms <= REBOOT_MS:
            self._late_since_ms = None
            return False
        if self._late_since_ms is None:
            self._late_since_ms = arrived_ms
        return arrived_ms - self._late_since_ms >= LATE_MS

    def boot_ms(self, t_ns: int) -> float | None:
        """What the autopilot's clock showed at a monotonic time; None: it has not been heard."""
        return t_ns * 1e-6 - self._offset_ms if math.isfinite(self._offset_ms) else None


class History(Generic[T]):
    """The last values of one quantity, in the order of the autopilot's time."""

    def __init__(self, limit_s: float, mix: Callable[[T, T, float], T]) -> None:
        self._limit_ms = 1000.0 * limit_s
        self._mix = mix
        self._times: deque[float] = deque(maxlen=KEPT)
        self._values: deque[T] = deque(maxlen=KEPT)

    def add(self, at_ms: float, value: T) -> None:
        """A value older than the last is left out: something overtook it."""
        if not self._times or at_ms > self._times[-1]:
            self._times.append(at_ms)
            self._values.append(value)

    def clear(self) -> None:
        self._times.clear()
        self._values.clear()

    def at(self, at_ms: float) -> T | None:
        """The value at a time; None where no message is near enough."""
        times, values = self._times, self._values
        after = bisect_right(times, at_ms)
        if after == 0:
            return None
        before = after - 1
        if after == len(times):
            return self._beyond(at_ms)
        if times[after] - times[before] > 2.0 * self._limit_ms:
            return None
        share = (at_ms - times[before]) / (times[after] - times[before])
        return self._mix(values[before], values[after], share)

    def _beyond(self, at_ms: float) -> T | None:
        """After the last value: on as it went over a time before it as long as that since."""
        last_ms, last = self._times[-1], self._values[-1]
        since_ms = at_ms - last_ms
        if since_ms > self._limit_ms:
            return None
        for before_ms, before in zip(reversed(self._times), reversed(self._values), strict=True):
            # two messages of one moment would make a great rate of a small difference
            if since_ms <= last_ms - before_ms <= 2.0 * self._limit_ms and before_ms < last_ms:
                return self._mix(before, last, (at_ms - before_ms) / (last_ms - before_ms))
        return last


class PoseHistory:
    """Feed it the autopilot's messages; ask it for the pose at a time.

    `clock`: from our time to the autopilot's. The default knows arrivals only.
    """

    def __init__(self, settings: PoseSettings, clock: BootClock | None = None) -> None:
        self._settings = settings
        self._clock = clock or BootClock()
        self._attitude: History[Quaternion] = History(settings.attitude_limit_s, slerp)
        # latitude, longitude (degrees), altitude (m)
        self._position: History[tuple[float, float, float]] = History(settings.position_limit_s, _on_a_line)
        # height over ground and its sigma (m), by who told it
        self._heights: dict[int, History[tuple[float, float]]] = {
            id: History(settings.position_limit_s, _held) for id in READERS
        }
        self.reboots = 0
        """times that the autopilot's clock began anew"""

    def take(self, message: Any, arrived_ns: int) -> None:
        """A decoded message of the autopilot, and when it came (monotonic). Never raises on what it holds."""
        boot_ms = getattr(message, "time_boot_ms", 0) or None  # 0: who sent it knows no time
        if boot_ms is not None and self._clock.hear(float(boot_ms), arrived_ns):
            self.reboots += 1
            self._attitude.clear()
            self._position.clear()
            for height in self._heights.values():
                height.clear()
        at_ms = self._clock.boot_ms(arrived_ns) if boot_ms is None else float(boot_ms)
        if at_ms is None:
            return
        id = message.get_msgId()
        if id in ATTITUDES and (attitude := ATTITUDES[id](message)) is not None:
            self._attitude.add(at_ms, attitude)
        if id == GLOBAL_POSITION_INT and (message.lat or message.lon):  # 0, 0: no fix yet
            self._position.add(at_ms, (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3))
        if id in READERS:
            for height_m, sigma_m in READERS[id](message, self._settings.relief_m):
                self._heights[id].add(at_ms, (height_m, sigma_m))

    def at(self, t_ns: int) -> Pose:
        """The pose at a monotonic time; None in it for what is not known then."""
        at_ms = self._clock.boot_ms(t_ns)
        if at_ms is None:
            return Pose(t_ns=t_ns, attitude=None)
        attitude = self._attitude.at(at_ms)
        position = self._position.at(at_ms)
        height = self._height(at_ms, attitude)
        return Pose(
            t_ns=t_ns,
            attitude=attitude,
            latitude_deg=position[0] if position else None,
            longitude_deg=position[1] if position else None,
            altitude_m=position[2] if position else None,
            height_m=height[0] if height else None,
            height_sigma_m=height[1] if height else 0.0,
        )

    def _height(self, at_ms: float, attitude: Quaternion | None) -> tuple[float, float] | None:
        """The surest of the heights that are known."""
        known = []
        for id, history in self._heights.items():
            found = history.at(at_ms)
            if found is None:
                continue
            if id == DISTANCE_SENSOR and attitude is not None:  # along the body's z
                _, x, y, _ = attitude
                lean = 1.0 - 2.0 * (x * x + y * y)
                if lean < STEEPEST_COS:
                    continue
                found = (found[0] * lean, found[1])
            known.append(found)
        return min(known, key=lambda height: height[1], default=None)


# --- what the messages hold -----------------------------------------------------------------------------

ATTITUDE = 30
ATTITUDE_QUATERNION = 31
GLOBAL_POSITION_INT = 33
DISTANCE_SENSOR = 132
TERRAIN_REPORT = 136
ALTITUDE = 141

_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
_COVARIANCE_UNKNOWN = 255


def _attitude(message: Any) -> Quaternion | None:
    angles = (message.roll, message.pitch, message.yaw)
    return quaternion(*angles) if all(map(math.isfinite, angles)) else None


def _attitude_quaternion(message: Any) -> Quaternion | None:
    w, x, y, z = message.q1, message.q2, message.q3, message.q4
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < length < 1.1:  # NaN too
        return None
    return (w / length, x / length, y / length, z / length)


Heights = Iterator[tuple[float, float]]


def _relative(message: Any, relief_m: float) -> Heights:
    yield message.relative_alt * 1e-3, relief_m


def _distance(message: Any, _: float) -> Heights:
    distance = message.current_distance * 1e-2
    within = message.min_distance < message.current_distance < message.max_distance
    if message.orientation == _DOWN and within:
        told = math.sqrt(message.covariance) * 1e-2 if message.covariance != _COVARIANCE_UNKNOWN else 0.0
        yield distance, max(told, math.hypot(RANGEFINDER_M, RANGEFINDER_SHARE * distance))


def _terrain(message: Any, _: float) -> Heights:
    if message.spacing > 0 and math.isfinite(message.current_height):  # spacing 0: no data here
        yield message.current_height, TERRAIN_M


def _altitude(message: Any, _: float) -> Heights:
    """Of PX4, which knows it from a rangefinder only; not a number or below zero: not known."""
    height = message.bottom_clearance
    if math.isfinite(height) and height >= 0.0:
        yield height, math.hypot(RANGEFINDER_M, RANGEFINDER_SHARE * height)


ATTITUDES: dict[int, Callable[[Any], Quaternion | None]] = {
    ATTITUDE: _attitude,
    ATTITUDE_QUATERNION: _attitude_quaternion,
}
READERS: dict[int, Callable[[Any, float], Heights]] = {
    GLOBAL_POSITION_INT: _relative,
    DISTANCE_SENSOR: _distance,
    TERRAIN_REPORT: _terrain,
    ALTITUDE: _altitude,
}
"""heights over ground and their sigmas in a message, given the land's relief"""

WANTED = {ATTITUDE_QUATERNION: 1.0, GLOBAL_POSITION_INT: 0.5, DISTANCE_SENSOR: 0.25, TERRAIN_REPORT: 0.1}
"""messages to ask the autopilot for, and how often, as a share of the rate of attitudes. ALTITUDE comes
unasked where it exists: asking others for it would be refused each time."""
READ = frozenset(ATTITUDES) | frozenset(READERS)
"""messages that `take` has a use for"""


def _on_a_line(
    a: tuple[float, float, float], b: tuple[float, float, float], share: float
) -> tuple[float, float, float]:
    east = (b[1] - a[1] + 180.0) % 360.0 - 180.0  # the short way over the date line
    longitude = (a[1] + share * east + 180.0) % 360.0 - 180.0
    return a[0] + share * (b[0] - a[0]), longitude, a[2] + share * (b[2] - a[2])


def _held(a: tuple[float, float], b: tuple[float, float], share: float) -> tuple[float, float]:
    """On a line too, but no further than the last: a rangefinder's jump over a roof does not go on."""
    share = min(share, 1.0)
    return a[0] + share * (b[0] - a[0]), b[1]
