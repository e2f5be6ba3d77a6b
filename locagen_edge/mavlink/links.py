"""All links of one component: what it says goes to all of them, an answer to the one that asked.

We are a component and no router: what comes in on one link never leaves on another. Each link opens, fails
and waits for itself (`link.py`), counts its frames (`twins.py`) and signs under its own link id, and none
holds up another.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from locagen_edge.mavlink.link import Link, Spec
from locagen_edge.mavlink.signing import Guard
from locagen_edge.mavlink.twins import Numbers

BACKOFF_S = 0.9
"""most between two attempts to open: a peer that is back has a heartbeat, one a second, within 2 s"""


class Links:
    """`on_bytes(number, data)` gets what comes in, with the number of the link in the order of `specs`."""

    def __init__(
        self,
        specs: Sequence[Spec],
        *,
        backoff_s: float,
        on_bytes: Callable[[int, bytes], None],
        guard: Guard | None = None,
        numbers: Numbers | None = None,
    ) -> None:
        self._guard = guard or Guard()
        self._numbers = numbers or Numbers()

        def hears(number: int) -> Callable[[bytes], None]:
            return lambda data: on_bytes(number, data)

        self.links = [
            Link(spec, backoff_s=min(backoff_s, BACKOFF_S), on_bytes=hears(number))
            for number, spec in enumerate(specs)
        ]

    @property
    def up(self) -> int:
        """How many have somewhere to send to."""
        return sum(link.up for link in self.links)

    @property
    def dropped(self) -> int:
        """Frames that did not go, over all links; a link that is down is not asked to send."""
        return sum(link.dropped for link in self.links)

    @property
    def flooded_bytes(self) -> int:
        """What came in beyond all measure and was not read, over all links."""
        return sum(link.flooded_bytes for link in self.links)

    @property
    def refused(self) -> int:
        return sum(link.refused for link in self.links)

    @property
    def last_error(self) -> str:
        """Why links are down, in words; empty where all are up, or have not yet failed."""
        down = [link for link in self.links if not link.up and link.last_error]
        if len(self.links) == 1:
            return "".join(link.last_error for link in down)
        return "; ".join(f"{link.spec}: {link.last_error}" for link in down)

    def send(self, frame: bytes, but: frozenset[int] = frozenset()) -> None:
        """To all that are up, but these. Never waits."""
        for number, link in enumerate(self.links):
            if link.up and number not in but:
                link.send(self._made_for(frame, number))

    def send_to(self, number: int, frame: bytes) -> None:
        """To this one alone, where it is up. Never waits."""
        if self.links[number].up:
            self.answer(number, frame)

    def answer(self, number: int, frame: bytes) -> None:
        """To the link that asked, and no other. Never waits."""
        self.links[number].send(self._made_for(frame, number))

    def _made_for(self, frame: bytes, number: int) -> bytes:
        return self._guard.sign(self._numbers.number(frame, number), number)

    async def run(self) -> None:
        """Opens all and keeps them open until cancelled."""
        async with asyncio.TaskGroup() as group:
            for link in self.links:
                group.create_task(link.run(), name=f"link {link.spec}")
