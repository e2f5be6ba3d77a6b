"""A stand-in for an autopilot: what ArduPilot documents of itself, as far as a companion meets it.

For tests only. It is no autopilot's code and flies no drone: a point that goes where it is told at a set
speed. What it is for is what lies between a companion's link and a ground station's:

- routing as ArduPilot's documentation has it (ardupilot.org/dev/docs/mavlink-routing-in-ardupilot.html):
  messages without a target, or to system 0, go on to every other link on which somebody has been heard; those
  for another component to the links on which it has been heard, or else are taken for the autopilot's own;
  heartbeats to links on which their sender has not been heard; ids that its dialect does not know are
  dropped, for their checksum cannot be verified; frames go on byte by byte, with number and signature;
- no attitude and no position until MAV_CMD_SET_MESSAGE_INTERVAL asks for them, for the link that asked, until
  the next start;
- signing by pymavlink's own implementation: with a key unsigned frames are refused without a word, but on the
  first link (ArduPilot's USB port), on which SETUP_SIGNING may come;
- TIMESYNC, parameters, and what it takes to fly: mode, arming, take-off, reposition.

`python tests/autopilot.py 5760 5762` runs it by itself, in the place of a simulator.
"""

from __future__ import annotations

import asyncio
import math
import os
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as ardupilot

from locagen_edge.geodesy import moved, north_east_down_m
from locagen_edge.geometry import quaternion

HOME = (-35.3632621, 149.1652374, 584.0)
"""where ArduPilot's simulator starts"""
GUIDED = 4
SYSTEM, COMPONENT = 1, 1
STEP_S = 0.01
CLIMB_M_S, SPEED_M_S = 25.0, 5.0
YAW_RAD, PITCH_RAD = math.radians(60.0), math.radians(-4.0)

ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3


class Channel:
    """One link of it: a TCP port that lets one connect."""

    def __init__(self, pilot: Autopilot, number: int) -> None:
        self.number = number
        self._pilot = pilot
        self.mav = ardupilot.MAVLink(None, SYSTEM, COMPONENT)
        self.mav.robust_parsing = True
        self.heard: set[tuple[int, int]] = set()
        self.intervals: dict[int, float] = {}
        self.last: dict[int, float] = {}
        self.writer: asyncio.StreamWriter | None = None
        self.port = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.writer is not None:
            self.writer.close()
        self.writer = writer
        try:
            while data := await reader.read(4096):
                for message in self.mav.parse_buffer(data) or []:
                    if not isinstance(message, (ardupilot.MAVLink_bad_data, ardupilot.MAVLink_unknown)):
                        self._pilot.hear(self, message)
        except ConnectionError:
            pass
        finally:
            writer.close()
            if self.writer is writer:
                self.writer = None

    def write(self, frame: bytes) -> None:
        if self.writer is not None:
            self.writer.write(frame)

    def say(self, message: Any) -> None:
        self.write(bytes(message.pack(self.mav)))
        self.mav.seq = (self.mav.seq + 1) % 256

    def set_key(self, key: bytes | None) -> None:
        signing = self.mav.signing
        signing.secret_key, signing.sign_outgoing, signing.link_id = key, key is not None, self.number
        signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
        signing.allow_unsigned_callback = (lambda *_: self.number == 0) if key else None


class Autopilot:
    """The vehicle, and all its links."""

    def __init__(self, links: int = 2) -> None:
        self.channels = [Channel(self, number) for number in range(links)]
        self.start()
        self.parameters = {"SYSID_THISMAV": 1.0, "WPNAV_SPEED": 500.0}

    def start(self) -> None:
        """As after power has come: time from 0, nothing asked for, nobody heard."""
        self.boot_s = time.monotonic()
        self.mode, self.armed = 0, False
        self.place = np.zeros(3)  # north, east, down of home, metres
        self.goal = np.zeros(3)
        self.speed = np.zeros(3)
        for channel in self.channels:
            channel.heard.clear()
            channel.intervals.clear()

    @property
    def boot_ms(self) -> int:
        return round((time.monotonic() - self.boot_s) * 1000)

    # --- in

    def hear(self, channel: Channel, message: Any) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (SYSTEM, COMPONENT):
            return
        channel.heard.add(sender)
        if self._forward(channel, sender, message) and (do := _HEARD.get(message.get_type())):
            do(self, channel, message)

    def _forward(self, channel: Channel, sender: tuple[int, int], message: Any) -> bool:
        """To other links. Whether it is for us too."""
        frame, others = bytes(message.get_msgbuf()), [c for c in self.channels if c is not channel]
        if message.get_type() == "RADIO_STATUS":
            return True
        if message.get_type() == "HEARTBEAT":
            for other in others:
                if sender not in other.heard:
                    other.write(frame)
            return True
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        ours = system in (0, SYSTEM) and component in (0, COMPONENT)
        if ours and system and component:
            return True
        on = [c for c in others if any(_reaches(system, component, who) for who in c.heard)]
        for other in on:
            other.write(frame)
        return ours or (not on and system in (0, SYSTEM))

    def _command(self, channel: Channel, message: Any) -> None:
        do = _COMMANDS.get(message.command)
        result = do(self, channel, message) if do else UNSUPPORTED
        sender = message.get_srcSystem(), message.get_srcComponent()
        channel.say(ardupilot.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def _set_interval(self, channel: Channel, message: Any) -> int:
        if int(message.param1) not in _STREAMS:
            return DENIED
        channel.intervals[int(message.param1)] = message.param2 * 1e-6
        return ACCEPTED

    def _set_mode(self, _: Channel, message: Any) -> int:
        self.mode = int(message.param2)
        return ACCEPTED

    def _arm(self, _: Channel, message: Any) -> int:
        self.armed = message.param1 == 1.0
        return ACCEPTED

    def _take_off(self, _: Channel, message: Any) -> int:
        if not self.armed or self.mode != GUIDED:
            return DENIED
        self.goal = np.array([0.0, 0.0, -(message.z if hasattr(message, "z") else message.param7)])
        return ACCEPTED

    def _reposition(self, _: Channel, message: Any) -> int:
        if self.mode != GUIDED or not hasattr(message, "x"):
            return DENIED
        self.goal = north_east_down_m(message.x * 1e-7, message.y * 1e-7, 0.0, *HOME[:2], 0.0)
        self.goal[2] = -message.z
        return ACCEPTED

    def _timesync(self, channel: Channel, message: Any) -> None:
        if message.tc1 == 0:
            now_ns = round((time.monotonic() - self.boot_s) * 1e9)
            channel.say(ardupilot.MAVLink_timesync_message(now_ns, message.ts1))

    def _list(self, channel: Channel, _: Any) -> None:
        for index, (name, value) in enumerate(self.parameters.items()):
            count = len(self.parameters)
            channel.say(ardupilot.MAVLink_param_value_message(name.encode(), value, 9, count, index))

    def _setup_signing(self, _: Channel, message: Any) -> None:
        key = bytes(message.secret_key)
        for each in self.channels:
            each.set_key(key if any(key) else None)

    # --- out

    async def run(self) -> None:
        beat_s = 0.0
        while True:
            await asyncio.sleep(STEP_S)
            now_s = time.monotonic()
            self._fly(STEP_S)
            if now_s - beat_s >= 1.0:
                beat_s = now_s
                base = 81 | (128 if self.armed else 0)
                for channel in self.channels:
                    channel.say(ardupilot.MAVLink_heartbeat_message(2, 3, base, self.mode, 4, 3))
            for channel in self.channels:
                for id, period_s in channel.intervals.items():
                    if period_s > 0.0 and now_s - channel.last.get(id, 0.0) >= period_s:
                        channel.last[id] = now_s
                        channel.say(_STREAMS[id](self))

    def _fly(self, dt: float) -> None:
        way = self.goal - self.place
        most = np.array([SPEED_M_S, SPEED_M_S, CLIMB_M_S]) * dt
        flat = float(np.hypot(*way[:2]))
        step = np.array(
            [*(way[:2] * min(1.0, most[0] / max(flat, 1e-9))), np.clip(way[2], -most[2], most[2])]
        )
        self.place = self.place + step
        self.speed = step / dt

    def _attitude(self) -> Any:
        pitch = PITCH_RAD if np.hypot(*self.speed[:2]) > 0.1 else 0.0
        q = quaternion(0.0, pitch, YAW_RAD)
        return ardupilot.MAVLink_attitude_quaternion_message(self.boot_ms, *q, 0.0, 0.0, 0.0)

    def _position(self) -> Any:
        lat, lon, _ = moved(*HOME[:2], 0.0, self.place)
        north, east, down = (round(100.0 * speed) for speed in self.speed)
        up_mm = round(-1000.0 * self.place[2])
        return ardupilot.MAVLink_global_position_int_message(
            self.boot_ms, round(lat * 1e7), round(lon * 1e7), round(HOME[2] * 1000) + up_mm, up_mm,
            north, east, down, 65535,
        )  # fmt: skip


def _reaches(system: int, component: int, who: tuple[int, int]) -> bool:
    """Whether a message with these targets goes to a link on which that one has been heard."""
    return not system or (system == who[0] and (component in (0, who[1]) or system != SYSTEM))


_STREAMS: dict[int, Callable[[Autopilot], Any]] = {31: Autopilot._attitude, 33: Autopilot._position}
_COMMANDS: dict[int, Callable[[Autopilot, Channel, Any], int]] = {
    ardupilot.MAV_CMD_SET_MESSAGE_INTERVAL: Autopilot._set_interval,
    ardupilot.MAV_CMD_DO_SET_MODE: Autopilot._set_mode,
    ardupilot.MAV_CMD_COMPONENT_ARM_DISARM: Autopilot._arm,
    ardupilot.MAV_CMD_NAV_TAKEOFF: Autopilot._take_off,
    ardupilot.MAV_CMD_DO_REPOSITION: Autopilot._reposition,
}
_HEARD: dict[str, Callable[[Autopilot, Channel, Any], None]] = {
    "COMMAND_LONG": Autopilot._command,
    "COMMAND_INT": Autopilot._command,
    "TIMESYNC": Autopilot._timesync,
    "PARAM_REQUEST_LIST": Autopilot._list,
    "SETUP_SIGNING": Autopilot._setup_signing,
}


@asynccontextmanager
async def autopilot(*ports: int) -> AsyncIterator[Autopilot]:
    """At work on these TCP ports, or two others; `channels[n].port` says which."""
    pilot = Autopilot(len(ports) or 2)
    servers = []
    for channel, port in zip(pilot.channels, ports or (0, 0), strict=True):
        server = await asyncio.start_server(channel.serve, "127.0.0.1", port)
        channel.port = server.sockets[0].getsockname()[1]
        servers.append(server)
    task = asyncio.create_task(pilot.run())
    try:
        yield pilot
    finally:
        task.cancel()
        await asyncio.wait({task})
        for server in servers:
            server.close()
        for channel in pilot.channels:
            if channel.writer is not None:
                channel.writer.transport.abort()
        await asyncio.sleep(0.02)


# --- it, or a simulator -----------------------------------------------------------------------------------

SITL = os.environ.get("LOCAGEN_SITL", "")
"""ArduPilot's simulator: `tcp:127.0.0.1:5760` is the ground station's link to it, the companion's is two
ports on (its SERIAL1) unless a second is named behind a comma"""
PILOTS = [
    "stand-in",
    pytest.param(
        "simulator",
        marks=pytest.mark.skipif(
            not SITL, reason="no simulator: LOCAGEN_SITL=tcp:127.0.0.1:5760 names one (ArduCopter)"
        ),
    ),
]
"""for tests through an autopilot: against the stand-in, and, where one is named, a simulator"""


@dataclass
class Ends:
    """Where an autopilot can be met."""

    kind: str
    companion: str
    ground: tuple[str, int]
    pilot: Autopilot | None = None


@asynccontextmanager
async def met(kind: str) -> AsyncIterator[Ends]:
    """One of `PILOTS`, at work."""
    if kind == "simulator":
        first, _, second = SITL.partition(",")
        scheme, host, port = first.split(":")
        assert scheme == "tcp", "LOCAGEN_SITL: tcp:HOST:PORT, or two of them with a comma between"
        yield Ends(kind, second or f"tcp:{host}:{int(port) + 2}", (host, int(port)))
        return
    async with autopilot() as pilot:
        ground, companion = pilot.channels
        yield Ends(kind, f"tcp:127.0.0.1:{companion.port}", ("127.0.0.1", ground.port), pilot)


async def main(*ports: int) -> None:
    async with autopilot(*ports):
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(*map(int, sys.argv[1:])))
