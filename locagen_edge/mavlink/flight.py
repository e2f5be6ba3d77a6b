"""The interlock: what acts on flight, and all that has to hold before it is sent. No I/O, time passed in.

An autopilot obeys mode, arming, position, ROI and yaw from an onboard computer as it does from a pilot. So
nothing of the kind is sent unless the settings file, section `flight`, switches it on; no parameter or
command over MAVLink can. Then only two commands can leave, and each only

- to an armed multicopter whose heartbeat is fresh, in a flight mode that the settings name,
- for a call that is confirmed, heard now, and known well enough,
- `flight.every_s` after the last, and only where the bearing has moved by `flight.turn_deg`.

Each use is logged and told by STATUSTEXT, and so is an autopilot's refusal, after which that command rests
for `REFUSED_S`. The pilot ends it by changing the flight mode.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from typing import Any

from locagen_edge.geometry import compass_deg, wrap
from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.dialect import messages
from locagen_edge.mavlink.targets import Place
from locagen_edge.settings import FlightSettings
from locagen_edge.types import Track

log = logging.getLogger(__name__)

ARDUPILOT: int = messages.MAV_AUTOPILOT_ARDUPILOTMEGA
PX4: int = messages.MAV_AUTOPILOT_PX4

MODES: Mapping[tuple[int, int], str] = {
    (ARDUPILOT, 3): "AUTO",
    (ARDUPILOT, 4): "GUIDED",
    (ARDUPILOT, 5): "LOITER",
    (ARDUPILOT, 16): "POSHOLD",
    (PX4, 4 << 16 | 3 << 24): "HOLD",
    (PX4, 4 << 16 | 4 << 24): "MISSION",
}
"""(autopilot, custom_mode) -> name: ArduCopter's mode.h, PX4's px4_custom_mode.h (main mode, sub mode)"""
COPTERS = frozenset(
    {
        messages.MAV_TYPE_QUADROTOR,
        messages.MAV_TYPE_COAXIAL,
        messages.MAV_TYPE_HELICOPTER,
        messages.MAV_TYPE_HEXAROTOR,
        messages.MAV_TYPE_OCTOROTOR,
        messages.MAV_TYPE_TRICOPTER,
        messages.MAV_TYPE_DODECAROTOR,
        messages.MAV_TYPE_DECAROTOR,
    }
)
"""a plane's custom_mode 4 is another mode than a copter's"""

FRESH_S = 2.5
"""two heartbeats missed: the mode is not known any more"""
HEARD_S = 1.0
"""a call that has been silent for longer is not acted on"""
PLACE_S = 10.0
"""nor a place that has not been looked at for longer"""
REFUSED_S = 60.0
_ARMED = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
_SPEED_DEG_S = 20.0


class Interlock:
    """Decides for one vehicle."""

    def __init__(self, settings: FlightSettings) -> None:
        self._settings = settings
        self._mode = ""
        self._autopilot = -1
        self._armed = False
        self._heard_s = -math.inf
        self._last_s = -math.inf
        self._rests_until_s: dict[int, float] = {}
        self._told: dict[int, tuple[int, float]] = {}  # command -> event, bearing or distance told
        self._now_s = -math.inf

    @property
    def commands(self) -> frozenset[int]:
        """The commands that the settings file switches on."""
        return frozenset(id for name, id in dialect.FLIGHT_COMMANDS.items() if getattr(self._settings, name))

    def hear_heartbeat(self, message: Any, now_s: float) -> None:
        """Of the autopilot."""
        copter = message.type in COPTERS
        self._mode = MODES.get((message.autopilot, message.custom_mode), "") if copter else ""
        self._autopilot = message.autopilot
        self._armed = bool(message.base_mode & _ARMED)
        self._heard_s = now_s

    @property
    def _open(self) -> bool:
        fresh = self._now_s - self._heard_s <= FRESH_S
        return fresh and self._armed and self._mode in self._settings.modes

    def due(
        self, now_s: float, system_id: int, track: Track | None, places: tuple[Place, ...]
    ) -> Iterator[tuple[Any, str]]:
        """The command to send now, and how the operator is told; mostly none. `track`: a confirmed call's."""
        self._now_s = now_s
        if not self.commands or not self._open or now_s - self._last_s < self._settings.every_s:
            return
        if track is None or not track.silent_s <= HEARD_S:
            return
        looked_at = (p for p in places if p.event_id == track.id and p.somewhere and p.age_s <= PLACE_S)
        place = next(looked_at, None)
        if self._settings.roi and place is not None and track.earth is not None:
            if self._moved(dialect.SET_ROI_LOCATION, track):
                yield (
                    dialect.command_at(
                        system_id,
                        dialect.SET_ROI_LOCATION,
                        place.latitude_deg,
                        place.longitude_deg,
                        place.altitude_m,
                    ),
                    self._use(
                        dialect.SET_ROI_LOCATION,
                        track,
                        f"ROI set to caller: {place.latitude_deg:.6f} {place.longitude_deg:.6f}",
                    ),
                )
        elif self._settings.yaw and self._autopilot == ARDUPILOT and self._sure(track):
            assert track.earth is not None
            degrees = compass_deg(track.earth.azimuth_rad)
            if self._moved(dialect.CONDITION_YAW, track):
                yield (
                    # direction 0: the short way; the last 0: an absolute angle
                    dialect.command(system_id, dialect.CONDITION_YAW, degrees, _SPEED_DEG_S, 0.0, 0.0),
                    self._use(
                        dialect.CONDITION_YAW, track, f"Nose turns to caller: {degrees:03.0f} deg true"
                    ),
                )

    def _sure(self, track: Track) -> bool:
        return (
            track.earth is not None
            and math.isfinite(track.earth.azimuth_rad)
            and math.degrees(track.earth.azimuth_sigma_rad) <= self._settings.sigma_deg
        )

    def _moved(self, command: int, track: Track) -> bool:
        """Whether there is something new to say: another caller, or the same elsewhere."""
        if self._now_s < self._rests_until_s.get(command, -math.inf) or not self._sure(track):
            return False
        assert track.earth is not None
        event, azimuth_rad = self._told.get(command, (None, 0.0))
        turned = abs(math.degrees(wrap(track.earth.azimuth_rad - azimuth_rad)))
        return event != track.id or turned >= self._settings.turn_deg

    def _use(self, command: int, track: Track, text: str) -> str:
        assert track.earth is not None
        self._last_s = self._now_s
        self._told[command] = (track.id, track.earth.azimuth_rad)
        log.warning("%s (mode %s, event %d)", text, self._mode, track.id)
        return text

    def hear_answer(self, message: Any, now_s: float) -> str:
        """COMMAND_ACK of the autopilot: what the operator is told, '' for nothing."""
        if message.command not in self.commands or message.result in (
            messages.MAV_RESULT_ACCEPTED,
            messages.MAV_RESULT_IN_PROGRESS,
        ):
            return ""
        self._rests_until_s[message.command] = now_s + REFUSED_S
        names = {id: name for name, id in dialect.FLIGHT_COMMANDS.items()}
        text = f"Autopilot refuses {names[message.command]} (result {message.result})"
        log.warning("%s", text)
        return text
