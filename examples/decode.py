"""Prints what locagen-edge says on UDP: LOCAGEN_BEARING and LOCAGEN_POSITION, bare or inside TUNNEL.

python examples/decode.py 14550
"""

import socket
import sys

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import Framer


def main(port: int) -> None:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("", port))
    framer = Framer()  # one sender; with several, one framer for each address
    while True:
        for packet in framer.feed(receiver.recv(65535)):
            message = dialect.decode(packet.raw)
            if packet.message_id == dialect.TUNNEL:
                message = dialect.untunnel(message)  # None: somebody else's
            if message and message.get_type() == "LOCAGEN_BEARING":
                heard = f"{message.azimuth_true:.0f} deg true" if message.event_id else "nothing heard"
                print(f"{message.time_usec / 1e6:.3f} s: event {message.event_id}: {heard}", flush=True)
            elif message and message.get_type() == "LOCAGEN_POSITION":
                print(
                    f"event {message.event_id}: {message.lat / 1e7:.7f} {message.lon / 1e7:.7f}", flush=True
                )


if __name__ == "__main__":
    main(int(sys.argv[1]))
