"""The vehicle's poses for a program that has nothing else to say: `locagen-edge record --poses`.

It shows itself (HEARTBEAT), asks the autopilot for attitude, position and height, and says nothing else: what
is asked of it is not answered, so that nobody takes it for the daemon.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.link import parse
from locagen_edge.mavlink.links import Links
from locagen_edge.mavlink.pose import PoseHistory
from locagen_edge.mavlink.signing import guard_of, save_timestamp, state_file
from locagen_edge.settings import Settings

TICK_S = 0.1
THERE = Status(hearing=True, track=None, snr_db=0.0, faults=())


@asynccontextmanager
async def posefeed(settings: Settings) -> AsyncIterator[PoseHistory]:
    """The poses as they come in on `mavlink.link`. Raises `LinkError` where the signing key is of no use."""
    guard = guard_of(settings)
    mavlink = replace(settings.mavlink, send_records=False, send_tunnel=False, send_computer_status=False)
    component = Component(mavlink, pose=settings.pose, guard=guard)

    def receive(number: int, data: bytes) -> None:
        component.receive(data, time.monotonic(), number)

    links = Links(
        [parse(link) for link in settings.mavlink.link],
        backoff_s=settings.daemon.backoff_s,
        on_bytes=receive,
        guard=guard,
    )

    async def ask() -> None:
        while True:
            if links.up:
                for message in component.due(time.monotonic(), THERE):
                    links.send(message)
            await asyncio.sleep(TICK_S)

    tasks = [asyncio.create_task(links.run()), asyncio.create_task(ask())]
    try:
        yield component.poses
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if guard.signs:
            save_timestamp(state_file(settings), guard.timestamp)
