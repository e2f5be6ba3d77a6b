"""Somebody else under our ids: told from our own frames that come back. No I/O, time passed in.

Two components with one pair of ids are one to everybody else: parameters, commands and bearings of both get
mixed up, and neither is told by the protocol. What comes in under our ids is never obeyed. But with two links
to one router or autopilot our own heartbeats come back to us, byte by byte but for version and signature; so
each link counts its frames by itself, as MAVLink wants it (mavlink.io/en/guide/packet_loss.html: a receiver
takes a gap for a loss), and what was sent of late is remembered.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque

from locagen_edge.mavlink.dialect import HEARTBEAT, LAYOUTS, checksum
from locagen_edge.mavlink.framer import Packet

ECHOES = 80
"""heartbeats remembered: 10 s on eight links"""
HEARD = 3
"""heartbeats that are not ours within `WITHIN_S`, before it is told: one may be of our last start"""
WITHIN_S = 10.0


class Numbers:
    """Numbers the frames of each link, and knows its own again."""

    def __init__(self) -> None:
        self._next: defaultdict[int, int] = defaultdict(int)
        self._beats: deque[tuple[int, bytes]] = deque(maxlen=ECHOES)

    def number(self, frame: bytes, link: int) -> bytes:
        """A MAVLink 2 frame that is not signed yet, with the next number of that link."""
        sequence = self._next[link]
        self._next[link] = (sequence + 1) % 256
        id = int.from_bytes(frame[7:10], "little")
        body = frame[1:4] + bytes((sequence,)) + frame[5:-2]
        if id == HEARTBEAT:
            self._beats.append((sequence, body[9:]))
        return frame[:1] + body + checksum(body, LAYOUTS[id].crc_extra).to_bytes(2, "little")

    def ours(self, packet: Packet) -> bool:
        """Whether this heartbeat is one that we have sent."""
        start, length = (10 if packet.raw[0] == 0xFD else 6), packet.raw[1]
        return (packet.sequence, packet.raw[start : start + length]) in self._beats


class Twins:
    """Notices another component under our ids."""

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self._heard_s: deque[float] = deque(maxlen=HEARD)
        self._told_s = -math.inf  # until when it holds

    def hear(self, packet: Packet, now_s: float) -> None:
        """What has come in under our ids."""
        if packet.message_id != HEARTBEAT or self._numbers.ours(packet):
            return
        self._heard_s.append(now_s)
        if len(self._heard_s) == HEARD and now_s - self._heard_s[0] <= WITHIN_S:
            self._told_s = now_s + WITHIN_S

    def complaints(self, now_s: float, system_id: int, component_id: int) -> tuple[str, ...]:
        """What an operator should know, at most 50 characters; nothing where all is well."""
        if now_s > self._told_s:
            return ()
        return (f"Ids {system_id}/{component_id} are taken: set mavlink.component_id",)
