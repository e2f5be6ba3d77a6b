"""The framer beside pymavlink's parser: frames kept in noise, time per frame, on the same streams in turns.

    python bench/bench_framer.py [--quick] [--output FILE]

Both end at decoded messages. Goals: at least 99.9 % of the frames kept with 0 to 100 noise bytes between
them, and no more time per frame that is kept than pymavlink's parser takes. The streams hold what a companion
hears from an autopilot, in pieces of 64 bytes, as a UART delivers them.
"""

import argparse
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import report
from pymavlink.dialects.v20 import common

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.component import Component
from locagen_edge.mavlink.framer import LONGEST, Framer
from locagen_edge.mavlink.link import Link, Spec
from locagen_edge.settings import MavlinkSettings

GOAL_KEPT = 0.999
GOAL_RATIO = 1.0
PIECE = 64
FLOOD_HZ = 2000
NOISE = {"clean": 0, "0-10 noise bytes": 10, "0-100 noise bytes": 100}


def frames(count: int) -> list[bytes]:
    """What an autopilot sends most, every frame different: sequence numbers come again after 256."""
    rng = random.Random(1)
    mav = common.MAVLink(None, 1, 1)
    made = []
    for k in range(count):
        message = rng.choice(
            (
                common.MAVLink_heartbeat_message(2, 3, 81, k, 4, 3),
                common.MAVLink_attitude_message(k, *(rng.uniform(-4, 4) for _ in range(6))),
                common.MAVLink_attitude_quaternion_message(k, *(rng.uniform(-1, 1) for _ in range(7))),
                common.MAVLink_global_position_int_message(
                    k, 473977418, 85455938, 488000, 21000, 1, 2, 3, 35999
                ),
                common.MAVLink_altitude_message(k, *(rng.uniform(0, 500) for _ in range(6))),
                common.MAVLink_statustext_message(rng.randrange(8), f"EKF3 IMU0 is using GPS {k}".encode()),
            )
        )
        made.append(bytes(message.pack(mav)))
        mav.seq = (mav.seq + 1) % 256
    return made


def stream(good: list[bytes], most_noise: int) -> list[bytes]:
    rng = random.Random(2)
    whole = b"".join(frame + rng.randbytes(rng.randint(0, most_noise)) for frame in good) + bytes(LONGEST)
    return [whole[at : at + PIECE] for at in range(0, len(whole), PIECE)]


def ours(pieces: list[bytes]) -> Iterator[bytes]:
    framer = Framer()
    for piece in pieces:
        for packet in framer.feed(piece):
            yield bytes(dialect.decode(packet.raw).get_msgbuf())


def theirs(pieces: list[bytes]) -> Iterator[bytes]:
    parser = common.MAVLink(None)
    parser.robust_parsing = True
    for piece in pieces:
        for message in parser.parse_buffer(piece) or ():
            if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN"):
                yield bytes(message.get_msgbuf())


PEERS: dict[str, Callable[[list[bytes]], Iterator[bytes]]] = {"framer": ours, "pymavlink": theirs}


def flood_share(good: list[bytes], rounds: int) -> list[float]:
    """Share of one core that `FLOOD_HZ` messages a second cost, from the link's bytes to the component."""
    shares = []
    for _ in range(rounds):
        component = Component(MavlinkSettings())
        link = Link(Spec("udpin", "", 1), backoff_s=1.0, on_bytes=lambda data: component.receive(data, 0.0))  # noqa: B023
        start = time.process_time()
        for frame in good[:FLOOD_HZ]:
            link.take(frame)
        shares.append((time.process_time() - start) * FLOOD_HZ / len(good[:FLOOD_HZ]))
    return shares


def timed(parse: Callable[[list[bytes]], Iterator[bytes]], pieces: list[bytes]) -> float:
    start = time.perf_counter()
    for _ in parse(pieces):
        pass
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a few rounds: whether it runs, not how fast")
    parser.add_argument(
        "--output",
        type=Path,
        default=report.default("framer"),
        help="where the numbers go (default: %(default)s)",
    )
    arguments = parser.parse_args()
    good = frames(500 if arguments.quick else 5000)
    rounds = 2 if arguments.quick else 15
    results = {}
    for name, most in NOISE.items():
        pieces = stream(good, most)
        sent = set(good)
        kept = {peer: len(sent & set(parse(pieces))) / len(sent) for peer, parse in PEERS.items()}
        times: dict[str, list[float]] = {peer: [] for peer in PEERS}
        for _ in range(rounds):
            for peer, parse in PEERS.items():
                times[peer].append(1e6 * timed(parse, pieces) / (kept[peer] * len(good)))
        ratios = [a / b for a, b in zip(times["framer"], times["pymavlink"], strict=True)]
        results[name] = {
            "kept": kept,
            "us_per_frame": {peer: report.summary(values) for peer, values in times.items()},
            "ratio": report.summary(ratios),
        }
    flood = flood_share(good, rounds)
    report.write(
        arguments.output,
        pymavlink=report.version("pymavlink"),
        fastcrc=report.version("fastcrc"),
        flood={"messages_hz": FLOOD_HZ, "share_of_a_core": report.summary(flood)},
        frames=len(good),
        rounds=rounds,
        goals={"kept": GOAL_KEPT, "ratio": GOAL_RATIO},
        results=results,
    )
    print(f"{'':20}{'kept':>22}{'us per frame kept':>24}{'ratio':>9}")
    print(f"{'':20}{'framer':>11}{'pymavlink':>11}{'framer':>12}{'pymavlink':>12}{'median':>9}")
    for name, result in results.items():
        share, us = result["kept"], result["us_per_frame"]
        print(
            f"{name:20}{share['framer']:11.3%}{share['pymavlink']:11.3%}"
            f"{us['framer']['median']:12.1f}{us['pymavlink']['median']:12.1f}{result['ratio']['median']:9.2f}"
        )
    print(f"{FLOOD_HZ} messages a second cost {np.median(flood):.1%} of a core")
    print(f"goals: at least {GOAL_KEPT:.1%} kept, ratio at most {GOAL_RATIO:g}\nwritten: {arguments.output}")


if __name__ == "__main__":
    main()
