"""An independent implementation, MAVSDK (C++), reads what we send and is heard by us, over real sockets."""

from __future__ import annotations

import asyncio
import importlib.util
import math
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from conftest import ROOT
from peers import WITHIN_S, Peer, free_port, mavsdk, null_modem
from test_component import AWAY, position

from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.link import Link, parse
from locagen_edge.settings import MavlinkSettings
from locagen_edge.types import Track, TrueBearing

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None, reason="needs the mavsdk package (extra: dev)"
)

QUIET = Status(hearing=True, track=None, snr_db=0.0, faults=())
CALLING = Status(
    hearing=True,
    track=Track(
        math.radians(-72.25),
        math.radians(2.0),
        math.radians(-10.0),
        0.1,
        0.6,
        0.0,
        0.875,
        5,
        earth=TrueBearing(math.radians(27.75), math.radians(3.25), math.radians(-20.0), 0.1),
    ),
    snr_db=6.5,
    faults=(),
)
WANTED = {"LG_AZB": 287.75, "LG_AZ": 27.75, "LG_EL": -20.0, "LG_SIG": 3.25, "LG_CONF": 0.875, "LG_SNR": 6.5}


class Daemon:
    """Link and component as the daemon joins them, with a status that the test sets."""

    def __init__(self, text: str) -> None:
        self.status = QUIET
        self.component = Component(MavlinkSettings(link=(text,)))
        self.link = Link(
            parse(text),
            backoff_s=0.1,
            on_bytes=lambda data: self.component.receive(data, time.monotonic()),
        )

    async def run(self) -> None:
        was_up = False
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.link.run())
            while True:
                if self.link.up and not was_up:
                    self.component.say_again()
                if was_up := self.link.up:
                    for frame in self.component.due(time.monotonic(), self.status):
                        self.link.send(frame)
                await asyncio.sleep(0.02)


@asynccontextmanager
async def daemon(text: str) -> AsyncIterator[Daemon]:
    one = Daemon(text)
    task = asyncio.create_task(one.run())
    try:
        yield one
    finally:
        task.cancel()
        await asyncio.wait({task})


async def check(ground: Peer, daemon: Daemon, system: int) -> None:
    """The whole profile, as the ground station decodes it."""
    seen = await ground.until(lambda heard: [h for h in heard if h.get("subscribed")])
    assert (seen[0]["system"], seen[0]["components"]) == (system, [191])

    daemon.status = CALLING
    await ground.until(
        lambda _: {m["fields"]["name"] for m in ground.messages("NAMED_VALUE_FLOAT")} >= {*WANTED}
    )
    assert {
        m["fields"]["name"]: m["fields"]["value"] for m in ground.messages("NAMED_VALUE_FLOAT")
    } == pytest.approx(WANTED, rel=1e-6)  # float32
    await ground.until(lambda _: ground.messages("STATUSTEXT"))
    (call,) = ground.messages("STATUSTEXT")
    assert (call["fields"]["severity"], call["fields"]["text"]) == (
        5,
        "Call heard: 028 deg true, 288 from nose, +-3 deg",
    )

    daemon.status = replace(CALLING, faults=("microphone 2 is silent",))
    await ground.until(lambda _: len(ground.messages("STATUSTEXT")) == 2)
    fault = ground.messages("STATUSTEXT")[1]["fields"]
    assert (fault["severity"], fault["text"]) == (4, "microphone 2 is silent")
    await ground.until(
        lambda _: [m for m in ground.messages("HEARTBEAT") if m["fields"]["system_status"] == 5]
    )
    for beat in ground.messages("HEARTBEAT"):
        assert beat["fields"] | {"system_status": 0} == {
            "message_id": 0,
            "message_name": "HEARTBEAT",
            "type": 18,
            "autopilot": 8,
            "base_mode": 0,
            "custom_mode": 0,
            "mavlink_version": 3,
            "system_status": 0,
        }
    said = [message for message in ground.heard if "name" in message]
    assert {(m["system"], m["component"]) for m in said} == {(system, 191)}
    # what its definitions lack, it drops; in TUNNEL it arrives
    assert {m["name"] for m in said} == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT", "TUNNEL"}


@pytest.mark.parametrize(
    ("ours", "theirs", "kind"),
    [
        ("udpout:127.0.0.1:{}", "udpin://127.0.0.1:{}", socket.SOCK_DGRAM),
        ("udpin:127.0.0.1:{}", "udpout://127.0.0.1:{}", socket.SOCK_DGRAM),
        ("tcp:127.0.0.1:{}", "tcpin://127.0.0.1:{}", socket.SOCK_STREAM),
    ],
)
def test_a_ground_station_reads_all_that_we_say(ours: str, theirs: str, kind: socket.SocketKind) -> None:
    async def test() -> None:
        port = free_port(kind)
        async with daemon(ours.format(port)) as one, mavsdk("ground", theirs.format(port)) as ground:
            await check(ground, one, system=1)
            assert one.component.received[0].frames >= 1  # and we read it: its heartbeats at least

    asyncio.run(test())


def test_a_ground_station_on_a_serial_line_reads_all_that_we_say() -> None:
    async def test() -> None:
        async with (
            null_modem() as (near, far),
            daemon(f"serial:{near}:57600") as one,
            mavsdk("ground", f"serial://{far}:57600") as ground,
        ):
            await check(ground, one, system=1)
            assert one.component.received[0].frames >= 1

    asyncio.run(test())


def test_with_our_definition_a_ground_station_decodes_our_messages() -> None:
    """The XML as it is installed, read at run time by a generator that is not pymavlink's."""

    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        xml = str(ROOT / "locagen_edge" / "mavlink" / "locagen.xml")
        ours, theirs = f"udpout:127.0.0.1:{port}", f"udpin://127.0.0.1:{port}"
        async with daemon(ours) as one, mavsdk("ground", theirs, xml) as ground:
            await ground.until(lambda heard: [h for h in heard if h.get("subscribed")])
            one.status = replace(CALLING, pose=AWAY, positions=(position(5),), noise_dbfs=-41.0)
            called = await ground.until(
                lambda _: [m for m in ground.messages("LOCAGEN_BEARING") if m["fields"]["event_id"] == 5]
            )
            told = called[0]["fields"]
            sent = {"azimuth_body": 287.75, "azimuth_true": 27.75, "azimuth_sigma": 2.0, "elevation": -10.0}
            sent |= {"confidence": 0.875, "snr": 6.5, "noise_level": -41.0, "height": 20.0}
            sent |= {"lat": 470_000_000, "lon": 80_000_000, "alt": 420_000}
            assert {name: told[name] for name in sent} == pytest.approx(sent, rel=1e-6)
            assert told["q"] == [1.0, 0.0, 0.0, 0.0]
            assert told["flags"] & 8, "azimuth_true holds"
            place = (await ground.until(lambda _: ground.messages("LOCAGEN_POSITION")))[0]["fields"]
            assert place["lat"] * 1e-7 == pytest.approx(position().latitude_deg, abs=1e-7)
            assert (place["event_id"], place["looks"]) == (5, 12)
            assert (place["covariance_nn"], place["covariance_ne"]) == (60.0, 5.0)

    asyncio.run(test())


def test_an_autopilot_teaches_us_its_system_id_before_the_ground_station_sees_us() -> None:
    async def test() -> None:
        port = free_port(socket.SOCK_DGRAM)
        async with daemon(f"udpin:127.0.0.1:{port}") as one:
            deadline = time.monotonic() + WITHIN_S
            async with mavsdk("autopilot", f"udpout://127.0.0.1:{port}"):
                while one.component.autopilot_heard_s is None:
                    assert time.monotonic() < deadline
                    await asyncio.sleep(0.01)
                async with mavsdk("ground", f"udpout://127.0.0.1:{port}") as ground:
                    await check(ground, one, system=42)

    asyncio.run(test())
