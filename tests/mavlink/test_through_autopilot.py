"""Through an autopilot: what a companion says on one of its links comes out at the ground's, and back.

Each test runs against the stand-in (`autopilot.py`), and, where `LOCAGEN_SITL` names one, against ArduPilot's
simulator: `tcp:127.0.0.1:5760` is the ground station's link to it, the companion's is two ports on (its
SERIAL1) unless a second is named behind a comma. A copter that has just been started, on flat land:
`sim_vehicle.py -v ArduCopter --no-mavproxy`. It takes off, flies and is left in the air.
"""

from __future__ import annotations

import asyncio
import importlib.util
import math
import re
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot import GUIDED, PILOTS, Ends, met
from peers import WITHIN_S
from pymavlink.dialects.v20 import ardupilotmega as ardupilot
from scenes import heard
from test_daemon import running

from locagen_edge.daemon import Daemon
from locagen_edge.geodesy import moved, north_east_down_m
from locagen_edge.geometry import angles, rotation
from locagen_edge.mavlink import dialect, signing
from locagen_edge.mavlink.parameters import NAMES, value_of
from locagen_edge.mavlink.signing import COMPLAINTS
from locagen_edge.settings import Settings, from_table
from locagen_edge.types import Frame

KEY = bytes(range(32))
GROUND = (255, 190)
PATIENCE_S = {"stand-in": WITHIN_S, "simulator": 180.0}
"""a simulator's vehicle first has to find its place and climbs as a drone does"""


@pytest.fixture(params=PILOTS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@dataclass
class Ground:
    """A ground station on its own link, by pymavlink."""

    writer: asyncio.StreamWriter
    patience_s: float
    mav: Any = field(default_factory=lambda: ardupilot.MAVLink(None, *GROUND))
    heard: deque[Any] = field(default_factory=lambda: deque(maxlen=20_000))
    ids: set[int] = field(default_factory=set)

    def say(self, message: Any) -> None:
        self.writer.write(bytes(message.pack(self.mav)))

    def command(self, number: int, *given: float, component: int = 1) -> None:
        seven = [*given, *[0.0] * (7 - len(given))]
        self.say(ardupilot.MAVLink_command_long_message(1, component, number, 0, *seven))

    def of(self, name: str, component: int | None = 191) -> list[Any]:
        return [
            m
            for m in self.heard
            if m.get_type() == name and (component is None or m.get_srcComponent() == component)
        ]

    async def until(self, condition: Callable[[], Any]) -> Any:
        async with asyncio.timeout(self.patience_s):
            while not (found := condition()):
                await asyncio.sleep(0.02)
        return found

    async def done(self, number: int, *given: float) -> None:
        """Commands the autopilot until it has accepted: a simulator may not be ready yet."""
        self.heard.clear()

        def accepted() -> bool:
            acks = [m.result for m in self.of("COMMAND_ACK", 1) if m.command == number]
            return bool(acks) and acks[-1] == 0

        async with asyncio.timeout(self.patience_s):
            while not accepted():
                self.command(number, *given)
                with suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        while not accepted():
                            await asyncio.sleep(0.02)

    def records(self, name: str) -> list[Any]:
        """What came in TUNNEL."""
        found = [dialect.untunnel(m) for m in self.of("TUNNEL")]
        return [m for m in found if m is not None and m.get_type() == name]


@asynccontextmanager
async def ground_at(ends: Ends, key: bytes | None = None) -> AsyncIterator[Ground]:
    reader, writer = await asyncio.open_connection(*ends.ground)
    ground = Ground(writer, PATIENCE_S[ends.kind])
    ground.mav.robust_parsing = True
    if key:
        ground.mav.signing.secret_key, ground.mav.signing.sign_outgoing = key, True
        ground.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
        ground.mav.signing.allow_unsigned_callback = lambda *_: True  # it shows; the tests judge

    async def listen() -> None:
        while data := await reader.read(4096):
            for message in ground.mav.parse_buffer(data) or []:
                ground.ids.add(message.get_msgId())
                if not isinstance(message, (ardupilot.MAVLink_bad_data, ardupilot.MAVLink_unknown)):
                    ground.heard.append(message)

    async def beat() -> None:
        while True:
            ground.say(ardupilot.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            await asyncio.sleep(0.5)

    tasks = {asyncio.create_task(listen()), asyncio.create_task(beat())}
    try:
        yield ground
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        writer.close()


def settings_for(ends: Ends, state: Path, **mavlink: Any) -> Settings:
    return from_table(
        {
            "mavlink": {"link": ends.companion, "state_directory": str(state), **mavlink},
            "detection": {"snr_db": -20},
            "bearing": {"estimator": "far-field"},
            "pose": {"relief_m": 0.5},  # flat land
            "log": {"directory": str(state / "log")},
        }
    )


Direction = Callable[[float], tuple[float, float] | None]


def sound_from(direction: Direction) -> Callable[[Settings], AsyncGenerator[Frame, None]]:
    """In real time: a second of quiet, then white sound from a direction in body axes (azimuth, elevation)
    at a monotonic time; None: quiet."""

    async def frames(settings: Settings) -> AsyncGenerator[Frame, None]:
        rng, audio = np.random.default_rng(0), settings.audio
        length_s = audio.frame / audio.rate_hz
        for number in count():
            now_s = time.monotonic()
            angle = direction(now_s - 0.5 * length_s) if number > 20 else None
            samples = 1e-4 * rng.standard_normal((3, audio.frame)).astype(np.float32)
            if angle is not None:
                samples = samples + heard(settings, *angle, 20.0, audio.frame, seed=number)
            yield Frame(
                samples.astype(np.float32),
                float(audio.rate_hz),
                round((now_s - length_s) * 1e9),
                number * audio.hop,
            )
            await asyncio.sleep(max(settings.hop_s - (time.monotonic() - now_s), 0.0))

    return frames


STEADY = sound_from(lambda _: (1.0, -0.3))


@asynccontextmanager
async def flying(ends: Ends, settings: Settings, sound: Any = STEADY) -> AsyncIterator[Daemon]:
    async with running(settings, sources=sound) as daemon:
        yield daemon


# --- what comes out where ---------------------------------------------------------------------------------


def test_streams_arrive_after_the_request_and_the_pose_is_known(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with (
            met(kind) as ends,
            ground_at(ends) as ground,
            flying(ends, settings_for(ends, tmp_path)) as daemon,
        ):
            await ground.until(lambda: daemon.component.poses.at(time.monotonic_ns()).attitude)
            await ground.until(lambda: daemon.component.poses.at(time.monotonic_ns()).latitude_deg)
            assert daemon.component.sent["COMMAND_LONG"] >= 2
            await ground.until(lambda: daemon.component.clock.synced)
            await ground.until(lambda: daemon.component.sent["LG_AZ"] > 1)
            assert daemon.component.complaints(time.monotonic()) == ()
            if ends.pilot is None:
                return
            await ground.until(lambda: ends.pilot.boot_ms > 3000)
            ends.pilot.start()  # again, as after a fault of its power: all that was asked is forgotten
            before = daemon.component.sent["COMMAND_LONG"]
            await ground.until(lambda: daemon.component.sent["COMMAND_LONG"] > before)
            await ground.until(lambda: daemon.component.poses.reboots == 1)
            await ground.until(lambda: daemon.component.poses.at(time.monotonic_ns()).attitude)

    asyncio.run(test())


def test_values_texts_and_tunnel_come_out_at_the_other_link(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with (
            met(kind) as ends,
            ground_at(ends) as ground,
            flying(ends, settings_for(ends, tmp_path)) as daemon,
        ):
            await ground.until(lambda: ground.of("HEARTBEAT"))
            await ground.until(lambda: len(ground.of("NAMED_VALUE_FLOAT")) > 12)
            await ground.until(lambda: ground.of("STATUSTEXT"))
            await ground.until(lambda: [m for m in ground.records("LOCAGEN_BEARING") if m.event_id])
            assert daemon.component.sent["LOCAGEN_BEARING"] > 1
            values = {m.name: m.value for m in ground.of("NAMED_VALUE_FLOAT")}
            assert values["LG_AZB"] == pytest.approx(math.degrees(1.0), abs=3.0)
            assert any(m.text.startswith("Call heard: ") for m in ground.of("STATUSTEXT"))
            last = [m for m in ground.records("LOCAGEN_BEARING") if m.event_id][-1]
            assert last.azimuth_body == pytest.approx(math.degrees(1.0), abs=3.0)
            assert not ground.ids & {59500, 59501}, "its firmware does not know our ids: it drops them"

    asyncio.run(test())


def test_parameters_and_commands_go_through_and_come_back(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with (
            met(kind) as ends,
            ground_at(ends) as ground,
            flying(ends, settings_for(ends, tmp_path)) as daemon,
        ):
            await ground.until(lambda: ground.of("HEARTBEAT"))
            ground.say(ardupilot.MAVLink_param_request_list_message(1, 191))
            await ground.until(lambda: len({m.param_id for m in ground.of("PARAM_VALUE")}) == len(NAMES))
            listed = {m.param_id: m.param_value for m in ground.of("PARAM_VALUE")}
            assert listed == pytest.approx({n: value_of(daemon.settings, n) for n in NAMES}, rel=1e-6)
            ground.say(ardupilot.MAVLink_param_set_message(1, 191, b"LG_TRK_COAST", 3.5, 9))
            await ground.until(lambda: daemon.settings.track.coast_s == 3.5)
            for number, one, result in ((31010, 0.0, 0), (31010, 1.0, 0), (400, 1.0, 3), (31010, 9.0, 2)):
                ground.heard.clear()
                ground.command(number, one, component=191)
                (ack,) = await ground.until(lambda: ground.of("COMMAND_ACK"))
                assert (ack.command, ack.result) == (number, result)
            assert daemon.component.listening

    asyncio.run(test())


@pytest.mark.parametrize("ours", [KEY, None, KEY[::-1]], ids=["same key", "no key", "another key"])
def test_signing_works_and_a_mismatch_is_told(
    kind: str, ours: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signing, "SILENCE_S", 0.5)

    async def test() -> None:
        async with met(kind) as ends, ground_at(ends, KEY) as ground:
            stamp = round((time.time() - 1_420_070_400) * 1e5)
            ground.say(ardupilot.MAVLink_setup_signing_message(1, 1, KEY, stamp))
            try:
                await signed(ends, ground)
            finally:
                ground.say(ardupilot.MAVLink_setup_signing_message(1, 1, bytes(32), 0))
                await asyncio.sleep(0.2)

    async def signed(ends: Ends, ground: Ground) -> None:
        await ground.until(lambda: [m for m in ground.of("HEARTBEAT", 1) if m.get_signed()])
        keys = {}
        if ours:
            (tmp_path / "key").write_text(ours.hex())
            (tmp_path / "key").chmod(0o600)
            keys = {"signing_key": str(tmp_path / "key")}
        async with flying(ends, settings_for(ends, tmp_path, **keys)) as daemon:
            if ours == KEY:
                await ground.until(lambda: daemon.component.poses.at(time.monotonic_ns()).attitude)
                told = await ground.until(lambda: ground.of("TUNNEL") and ground.of("STATUSTEXT"))
                assert all(m.get_signed() for m in told)
                assert daemon.component.guard.counts["admitted"] > 2
                assert daemon.component.complaints(time.monotonic()) == ()
                return
            complaint = COMPLAINTS["wrong" if ours else "no key"]
            await ground.until(lambda: complaint in daemon.component.complaints(time.monotonic()))
            if ends.pilot:  # a simulator goes on with what it was asked for before
                assert daemon.component.poses.at(time.monotonic_ns()).attitude is None, "it does not obey us"
            assert not ground.of("NAMED_VALUE_FLOAT"), "and hands on nothing of ours"
            await ground.until(lambda: complaint in daemon._in_words())

    asyncio.run(test())


# --- to the map -------------------------------------------------------------------------------------------

HEIGHT_M = 20.0
ACROSS_M = 20.0
AHEAD_M = 25.0
MISS_M = 5.0
"""25 m away, 20 m of path, sigmas of compass and GPS as in the settings"""


class Caller:
    """Somebody on the ground, north of home, and where the vehicle hears the call from: by what the ground
    station is told of its flight."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._place: Any = None
        self._attitude: Any = None
        self.home: tuple[float, float] | None = None

    @property
    def latitude_longitude(self) -> tuple[float, float]:
        assert self.home is not None
        lat, lon, _ = moved(*self.home, 0.0, np.array([AHEAD_M, 0.5 * ACROSS_M, 0.0]))
        return lat, lon

    def direction(self, _: float) -> tuple[float, float] | None:
        """In body axes, as of now; quiet below half the height."""
        for message in list(self._ground.heard)[-60:]:
            if message.get_type() == "GLOBAL_POSITION_INT":
                self._place = message
            elif message.get_type() == "ATTITUDE_QUATERNION":
                self._attitude = message
        if self._place is None or self._attitude is None or self.home is None:
            return None
        up_m = self._place.relative_alt * 1e-3
        if up_m < 0.5 * HEIGHT_M:
            return None
        here = (self._place.lat * 1e-7, self._place.lon * 1e-7)
        away = north_east_down_m(*self.latitude_longitude, 0.0, *here, 0.0)
        away[2] = up_m
        q = self._attitude
        body = rotation((q.q1, q.q2, q.q3, q.q4)).T @ away
        return angles(body / np.linalg.norm(body))


@pytest.mark.filterwarnings("ignore")  # of other people's code: MAVProxy's
def test_a_flight_past_a_caller_ends_with_the_caller_on_the_map(kind: str, tmp_path: Path) -> None:
    async def test() -> None:
        async with met(kind) as ends, ground_at(ends) as ground:
            caller = Caller(ground)
            settings = settings_for(ends, tmp_path, rate_hz=5.0)
            async with flying(ends, settings, sound_from(caller.direction)) as daemon:
                await fly_past(ground, caller)
                await ground.until(lambda: near(caller, ground.records("LOCAGEN_POSITION")))
                place = daemon.estimate.position(daemon.estimate.track)
                assert place is not None
            assert any(
                re.fullmatch(r"Call heard: \d{3} deg true, \d+ m \+-\d+ m, conf \d\.\d", m.text)
                for m in ground.of("STATUSTEXT")
            )
            drawn_on_a_map(ground, caller)

    asyncio.run(test())


async def fly_past(ground: Ground, caller: Caller) -> None:
    """Up, and east past the caller: at the end it is abeam and behind."""
    for id in (31, 33):
        await ground.done(ardupilot.MAV_CMD_SET_MESSAGE_INTERVAL, id, 50_000)
    start = (await ground.until(lambda: ground.of("GLOBAL_POSITION_INT", 1)))[-1]
    caller.home = home = (start.lat * 1e-7, start.lon * 1e-7)
    await ground.done(ardupilot.MAV_CMD_DO_SET_MODE, 1, GUIDED)
    await ground.done(ardupilot.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    await ground.done(ardupilot.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT_M)
    await ground.until(lambda: height(ground) > 0.95 * HEIGHT_M)
    lat, lon, _ = moved(*home, 0.0, np.array([0.0, ACROSS_M, 0.0]))
    frame = ardupilot.MAV_FRAME_GLOBAL_RELATIVE_ALT
    there = (round(lat * 1e7), round(lon * 1e7))
    ground.say(
        ardupilot.MAVLink_command_int_message(
            1, 1, frame, ardupilot.MAV_CMD_DO_REPOSITION, 0, 0, -1.0, 1.0, 0.0, math.nan, *there, HEIGHT_M
        )
    )
    await ground.until(lambda: abs(ground.of("GLOBAL_POSITION_INT", 1)[-1].lon - there[1]) < 100)


def height(ground: Ground) -> float:
    told = ground.of("GLOBAL_POSITION_INT", 1)
    return told[-1].relative_alt * 1e-3 if told else 0.0


def near(caller: Caller, records: list[Any]) -> bool:
    if not records:
        return False
    last = (records[-1].lat * 1e-7, records[-1].lon * 1e-7)
    away = north_east_down_m(*last, 0.0, *caller.latitude_longitude, 0.0)
    return math.hypot(away[0], away[1]) < MISS_M


def drawn_on_a_map(ground: Ground, caller: Caller) -> None:
    """By the module for MAVProxy, of what came through the autopilot."""
    if importlib.util.find_spec("MAVProxy") is None:
        return  # test_mavproxy_module.py says so
    from test_mavproxy_module import loaded

    module, drawn = loaded()
    for message in ground.of("TUNNEL"):
        module.mavlink_packet(message)
    ellipses = [shape for key, shape in drawn.shapes.items() if key.startswith("place")]
    assert ellipses
    points = np.array(ellipses[-1].points)
    (south, west), (north, east) = points.min(axis=0), points.max(axis=0)
    lat, lon = caller.latitude_longitude
    assert south < lat < north
    assert west < lon < east
