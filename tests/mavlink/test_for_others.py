"""What others read our messages by: the tables, the example, the dissector. None may lag behind."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from shutil import which

import pytest
from conftest import ROOT
from peers import free_port

from locagen_edge.mavlink import build_dialect, dialect
from locagen_edge.mavlink.records import BearingRecord, PositionRecord, bearing_message, position_message

BEARING = bearing_message(
    BearingRecord(time_us=61_500_000, autopilot_time=True, event_id=3, azimuth_true_rad=1.0, call=2)
)
NOTHING = bearing_message(BearingRecord(time_us=62_000_000, autopilot_time=True, event_id=0))
POSITION = position_message(
    PositionRecord(
        time_us=61_500_000,
        autopilot_time=True,
        event_id=3,
        latitude_deg=47.3977418,
        longitude_deg=8.5455938,
        altitude_m=None,
        covariance_m2=(25.0, 0.0, 4.0),
        age_s=0.5,
        looks=12,
    )
)


def test_the_documents_tables_are_those_of_the_definition():
    text = (ROOT / "docs" / "mavlink.md").read_text(encoding="utf-8")
    assert build_dialect.with_tables(text) == text, "run: make format"
    for kind in (BEARING, POSITION):
        for name in kind.fieldnames:
            assert f"| `{name}` |" in text


def until_heard(out: socket.socket, frame: bytes) -> None:
    """Sends until somebody listens: on the same host a second send tells that nobody took the first."""
    while True:
        try:
            out.send(frame)
            out.send(frame)
            return
        except ConnectionRefusedError:
            time.sleep(0.01)


def test_the_example_reads_both_ways():
    port = free_port(socket.SOCK_DGRAM)
    command = [sys.executable, str(ROOT / "examples" / "decode.py"), str(port)]
    sender = dialect.Sender(1, 191)
    with (
        subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": str(ROOT)}
        ) as example,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        assert example.stdout
        try:
            out.connect(("127.0.0.1", port))
            until_heard(out, sender.pack(dialect.heartbeat(dialect.STATE_ACTIVE)))
            for message in (BEARING, dialect.tunnel(NOTHING), dialect.tunnel(POSITION)):
                out.send(sender.pack(message))
            lines = [example.stdout.readline() for _ in range(3)]
        finally:
            example.kill()
    assert lines == [
        "61.500 s: event 3: 57 deg true\n",
        "62.000 s: event 0: nothing heard\n",
        "event 3: 47.3977418 8.5455938\n",
    ]


def captured(frames: list[bytes]) -> bytes:
    """The frames as UDP datagrams in a pcap file of raw IPv4 packets."""
    pcap = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
    home = bytes((127, 0, 0, 1))
    for frame in frames:
        udp = struct.pack(">HHHH", 14550, 14550, 8 + len(frame), 0) + frame
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, home, home)
        pcap += struct.pack("<IIII", 0, 0, len(ip + udp), len(ip + udp)) + ip + udp
    return pcap


@pytest.mark.skipif(not which("tshark"), reason="tshark is not installed")
def test_wireshark_takes_our_messages_apart(tmp_path):
    lua, capture = tmp_path / "locagen.lua", tmp_path / "locagen.pcap"
    build_dialect.generate(lua, "WLua")
    sender = dialect.Sender(1, 191)
    capture.write_bytes(captured([sender.pack(message) for message in (BEARING, POSITION)]))
    done = subprocess.run(
        ["tshark", "-X", f"lua_script:{lua}", "-r", str(capture), "-V"],
        capture_output=True,
        text=True,
        check=True,
    )
    for line in (
        "Message id: LOCAGEN_BEARING (59500)",
        "azimuth_true (float) [deg]: 57.2958",
        "call (LOCAGEN_CALL): LOCAGEN_CALL_WHISTLE (2)",
        "LOCAGEN_BEARING_FLAGS_AZIMUTH_TRUE_VALID: True",
        "LOCAGEN_BEARING_FLAGS_SIMULATED: False",
        "lat (int32_t) [degE7]: 473977418",
        "looks (uint16_t): 12",
    ):
        assert line in done.stdout
