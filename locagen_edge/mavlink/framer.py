"""Whole valid frames out of a stream of bytes: MAVLink 1 and 2, signed or not. No I/O.

Why not the generated parser (pymavlink 2.4.50): after a false start byte it swallows the length that the
noise announces (with 1 to 100 noise bytes between frames it keeps 97 to 56 % of them), it returns messages
of unknown id with their checksum unread, and its buffer grows without bound where chunks always end inside
a frame. This one gives up one byte at a time, and gives up early: a start byte with flags that do not
exist, with an id that MAVLink does not know (its checksum cannot be verified), or in MAVLink 1 longer than
its message can be, starts no frame. So noise seldom makes it wait for bytes, and an unknown message is passed
over like noise. MAVLink 2 frames that are nothing to us are verified and passed over whole: what they carry,
a log or another's tunnel, may hold bytes that look like a frame.

Framing: mavlink.io/en/guide/serialization.html. Every byte is looked at a bounded number of times (at
most once per start byte in the 280 bytes before it).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from locagen_edge.mavlink.dialect import LAYOUTS, OTHERS, checksum

_V1 = 0xFE
_V2 = 0xFD
_START = re.compile(rb"[\xfd\xfe]")
_HEADER_V1 = 6
_HEADER_V2 = 10
_CHECKSUM = 2
_ALL = {**OTHERS, **LAYOUTS}
_SIGNED = 0x01
_SIGNATURE = 13

LONGEST = _HEADER_V2 + 255 + _CHECKSUM + _SIGNATURE
"""bytes of the longest frame"""


@dataclass(frozen=True, slots=True)
class Packet:
    """One frame whose checksum is right. Its signature, if it has one, has not been looked at."""

    message_id: int
    system_id: int
    component_id: int
    sequence: int
    signed: bool
    raw: bytes
    """the whole frame, as `dialect.decode` takes it and as it could be forwarded"""


class Framer:
    """Feed it what comes in, in pieces of any size."""

    def __init__(self) -> None:
        self._rest = b""
        self.frames = 0
        """frames found"""
        self.others = 0
        """frames of messages that the dialect leaves out, MAVLink 2"""
        self.bad_crc = 0
        """what looked like a frame and failed its checksum"""
        self.skipped = 0
        """bytes that belonged to no frame of ours: noise, damage, messages that the dialect leaves out"""

    @property
    def waiting(self) -> int:
        """Bytes held back until the frame they begin is whole; below `LONGEST`."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[Packet]:
        """The frames that end in `data`, in order. Never raises."""
        buffer = self._rest + data
        packets: list[Packet] = []
        at = 0
        while at < len(buffer):
            start = _START.search(buffer, at)
            here = start.start() if start else len(buffer)
            self.skipped += here - at
            at = here
            if not start:
                break
            length = _length(buffer, at)
            if length > len(buffer) - at:
                break
            if length and (packet := _checked(buffer[at : at + length])):
                if packet.message_id in LAYOUTS:
                    packets.append(packet)
                else:
                    self.others += 1
                    self.skipped += length
                at += length
                continue
            self.bad_crc += length > 0
            self.skipped += 1
            at += 1
        self._rest = buffer[at:]
        self.frames += len(packets)
        return packets


def _length(buffer: bytes, at: int) -> int:
    """Length of the frame that starts here, as far as can be told; 0: no frame starts here.

    While the header is not whole, this is the header's length: more than there is.
    """
    there = len(buffer) - at
    if buffer[at] == _V1:
        if there < _HEADER_V1:
            return _HEADER_V1
        layout = LAYOUTS.get(buffer[at + 5])
        payload = buffer[at + 1]
        return _HEADER_V1 + payload + _CHECKSUM if layout and payload <= layout.size else 0
    if there >= 3 and buffer[at + 2] & ~_SIGNED:
        return 0  # the specification: drop frames with an incompatibility flag that is not understood
    if there < _HEADER_V2:
        return _HEADER_V2
    # No limit by the layout here: a newer dialect's message may carry more extension fields.
    if int.from_bytes(buffer[at + 7 : at + 10], "little") not in _ALL:
        return 0
    return _HEADER_V2 + buffer[at + 1] + _CHECKSUM + (_SIGNATURE if buffer[at + 2] else 0)


def _checked(raw: bytes) -> Packet | None:
    """The packet of a whole frame of a known message; None when its checksum is wrong."""
    v2 = raw[0] == _V2
    end = (_HEADER_V2 if v2 else _HEADER_V1) + raw[1]
    sequence, system_id, component_id = raw[4:7] if v2 else raw[2:5]
    message_id = int.from_bytes(raw[7:10], "little") if v2 else raw[5]
    if checksum(raw[1:end], _ALL[message_id].crc_extra) != int.from_bytes(raw[end : end + 2], "little"):
        return None
    return Packet(message_id, system_id, component_id, sequence, v2 and bool(raw[2]), raw)
