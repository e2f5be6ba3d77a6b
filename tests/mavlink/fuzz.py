"""Everything that reads the wire, fed with damaged frames by the million: no exception, no growth.

    python tests/mavlink/fuzz.py [--inputs N] [--seed N]

Inputs are frames of a real packer, cut, spliced, repeated, with bits and bytes changed, and half of them with
their checksum made right again, so that damage gets past the framer to whatever reads the fields.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component, Status
from locagen_edge.mavlink.framer import LONGEST, Framer
from locagen_edge.mavlink.signing import Guard
from locagen_edge.settings import MavlinkSettings

KEY = b"k" * 32
GROWTH_KIB = 4096
"""what the process may grow by once it is warm: an allocator's scatter, far below a byte per input"""
WARM = 20_000
"""inputs before growth is measured"""
TICK = 1000
"""inputs from one look at the component's output, growth and counters to the next"""


def seeds() -> list[bytes]:
    """One frame of every message that we know, as MAVLink 2, 1 where that exists, and signed."""
    plain, signed = common.MAVLink(None, 1, 1), common.MAVLink(None, 1, 1)
    signed.signing.secret_key = KEY
    signed.signing.sign_outgoing = True
    made = []
    for id, layout in dialect.LAYOUTS.items():
        kind = common.mavlink_map.get(id) or dialect.messages.mavlink_map[id]
        payload = bytes((7 * at + id) % 256 for at in range(layout.size))
        message = kind.__new__(kind)
        common.MAVLink_message.__init__(message, id, kind.msgname)
        made.append(message._pack(plain, layout.crc_extra, payload))
        made.append(message._pack(signed, layout.crc_extra, payload))
        if id < 256:
            made.append(message._pack(plain, layout.crc_extra, payload, force_mavlink1=True))
    return [bytes(frame) for frame in made]


def flip(rng: random.Random, data: bytearray) -> None:
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def overwrite(rng: random.Random, data: bytearray) -> None:
    data[rng.randrange(len(data))] = rng.choice((0x00, 0x01, 0x7F, 0x80, 0xFD, 0xFE, 0xFF))


def insert(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    data[at:at] = rng.randbytes(rng.randrange(1, 8))


def remove(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    del data[at : at + rng.randrange(1, 16)]


def repeat(rng: random.Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    data[at:at] = data[at : at + rng.randrange(1, 40)]


def cut(rng: random.Random, data: bytearray) -> None:
    del data[rng.randrange(len(data)) :]


CHANGES: tuple[Callable[[random.Random, bytearray], None], ...] = (
    flip,
    overwrite,
    insert,
    remove,
    repeat,
    cut,
)


def mended(data: bytearray) -> bytes:
    """With a length and a checksum that fit, where the start still names a message that we know."""
    if len(data) < 12 or data[0] != 0xFD:
        return bytes(data)
    layout = dialect.LAYOUTS.get(int.from_bytes(data[7:10], "little"))
    if layout is None:
        return bytes(data)
    data[1] = min(len(data) - 12, 255)
    data[2] = 0
    body = bytes(data[: 10 + data[1]])
    return body + dialect.checksum(body[1:], layout.crc_extra).to_bytes(2, "little")


def damaged(rng: random.Random, corpus: list[bytes]) -> bytes:
    data = bytearray(rng.choice(corpus))
    for _ in range(rng.randrange(5)):
        if data:
            rng.choice(CHANGES)(rng, data)
    return mended(data) if rng.random() < 0.5 else bytes(data)


def rss_kib() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def fuzz(inputs: int, seed: int) -> int:
    """Feeds that many inputs; returns by how much the process grew, KiB. Raises on the first thing wrong."""
    rng = random.Random(seed)
    corpus = seeds()
    framer, component = Framer(), Component(MavlinkSettings())
    guarded = Component(MavlinkSettings(), guard=Guard(KEY, clock=lambda: 0))
    status = Status(hearing=True, track=None, snr_db=0.0, faults=())
    fed = found = grown_from = 0
    for done in range(1, inputs + 1):
        data = damaged(rng, corpus)
        fed += len(data)
        for packet in framer.feed(data):
            found += len(packet.raw)
            message = dialect.decode(packet.raw)
            if packet.message_id == dialect.TUNNEL:
                dialect.untunnel(message)
        assert framer.waiting < LONGEST
        component.receive(data, done * 1e-3)
        guarded.receive(data, done * 1e-3)
        if done % TICK == 0:
            assert fed == found + framer.skipped + framer.waiting
            assert component.received[0].frames == guarded.received[0].frames == framer.frames
            for speaker in (component, guarded):
                for frame in (*speaker.due(done * 1e-3, status), *speaker.answers(0)):
                    assert len(guarded.guard.sign(frame)) <= LONGEST
        if done == min(WARM, inputs // 2):
            grown_from = rss_kib()
    grown = rss_kib() - grown_from
    assert grown <= GROWTH_KIB, f"grew by {grown} KiB"
    assert guarded.guard.counts["wrong"], "no signature was ever looked at"
    assert framer.frames > inputs // 10, "hardly anything got through: this tests nothing"
    return grown


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 2**32)
    arguments = parser.parse_args()
    print(f"seed {arguments.seed}", flush=True)  # before anything can go wrong: it repeats the run
    start = time.monotonic()
    grown = fuzz(arguments.inputs, arguments.seed)
    print(f"{arguments.inputs} inputs in {time.monotonic() - start:.0f} s: no exception, {grown} KiB more")


if __name__ == "__main__":
    sys.exit(main())
