"""Laws of the framer: what it finds depends on the bytes alone, noise costs nothing, nothing grows."""

from __future__ import annotations

import random
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

from conftest import ROOT
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.framer import LONGEST, Framer, Packet


def frames(count: int, seed: int = 1, *, v1: bool = False, key: bytes = b"") -> list[bytes]:
    """Frames of several messages and lengths, numbered, from another MAVLink implementation's packer."""
    rng = random.Random(seed)
    mav = common.MAVLink(None, 7, 1)
    if key:
        mav.signing.secret_key = key
        mav.signing.sign_outgoing = True
    made = []
    for k in range(count):
        message = rng.choice(
            (
                common.MAVLink_heartbeat_message(2, 3, 81, rng.getrandbits(32), 4, 3),
                common.MAVLink_attitude_message(k, *(rng.uniform(-4, 4) for _ in range(6))),
                common.MAVLink_tunnel_message(0, 0, 40000, 128, [rng.getrandbits(8) for _ in range(128)]),
                common.MAVLink_statustext_message(rng.randrange(8), b"EKF3 IMU0 is using GPS"),
            )
        )
        if v1 and message.id > 255:
            message = common.MAVLink_system_time_message(k, k)
        made.append(message.pack(mav, force_mavlink1=v1))
        mav.seq = (mav.seq + 1) % 256
    return made


def raws(packets: list[Packet]) -> list[bytes]:
    return [packet.raw for packet in packets]


def chunks(stream: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[a:b] for a, b in pairwise(edges)]


MIXED = b"".join(
    [
        *frames(6, seed=2),
        b"\x00noise\xfd\x09\x00\xfe\x03",
        *frames(6, seed=3, v1=True),
        b"\xfd\xff\x00",
        *frames(6, seed=4, key=b"k" * 32),
        bytes(LONGEST),
    ]
)
ALL = frames(6, seed=2) + frames(6, seed=3, v1=True) + frames(6, seed=4, key=b"k" * 32)


@given(st.lists(st.integers(0, len(MIXED)), max_size=40))
@example(list(range(len(MIXED))))  # byte by byte
@example([])
def test_any_split_gives_the_same_frames(cuts: list[int]) -> None:
    framer = Framer()
    found = [raw for chunk in chunks(MIXED, cuts) for raw in raws(framer.feed(chunk))]
    # The signatures hold wall-clock time, so the last six are compared by what they carry.
    assert found[:12] == ALL[:12]
    assert len(found) == 18
    assert framer.skipped + framer.waiting + sum(map(len, found)) == len(MIXED)


@given(st.lists(st.binary(max_size=600), max_size=20))
@settings(max_examples=300)
def test_random_bytes_neither_raise_nor_pile_up(pieces: list[bytes]) -> None:
    framer = Framer()
    for piece in pieces:
        framer.feed(piece)
        assert framer.waiting < LONGEST


@given(st.lists(st.sampled_from([0xFD, 0xFE, 0x00, 0x01, 0x09, 0xFF, 0x1E]), max_size=900))
@settings(max_examples=300)
def test_bytes_that_look_like_headers_neither_raise_nor_pile_up(values: list[int]) -> None:
    framer = Framer()
    for value in values:
        framer.feed(bytes((value,)))
        assert framer.waiting < LONGEST


def test_noise_between_frames_costs_less_than_one_frame_in_a_thousand() -> None:
    rng = random.Random(5)
    good = frames(5000, seed=6)
    stream = b"".join(frame + rng.randbytes(rng.randint(0, 100)) for frame in good) + bytes(LONGEST)
    framer = Framer()
    found = raws([p for at in range(0, len(stream), 333) for p in framer.feed(stream[at : at + 333])])
    kept = len(set(found) & set(good)) / len(set(good))
    assert kept >= 0.999  # a false start is believed once in 65536 checksums
    assert framer.skipped > 200_000


def test_noise_made_of_start_bytes_costs_no_frame() -> None:
    good = frames(50)
    stream = b"".join(b"\xfd\xfe\xfd" * 20 + frame for frame in good) + bytes(LONGEST)
    assert raws(Framer().feed(stream)) == good


@given(st.integers(0, 19), st.data())
def test_a_truncated_frame_costs_itself_alone(which: int, data: st.DataObject) -> None:
    good = frames(20)
    keep = data.draw(st.integers(0, len(good[which]) - 1))
    stream = b"".join([*good[:which], good[which][:keep], *good[which + 1 :], bytes(LONGEST)])
    assert raws(Framer().feed(stream)) == good[:which] + good[which + 1 :]


@given(st.data())
def test_a_flipped_bit_is_never_believed(data: st.DataObject) -> None:
    frame = bytearray(frames(4)[data.draw(st.integers(0, 3))])
    frame[data.draw(st.integers(0, len(frame) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert Framer().feed(bytes(frame) + bytes(LONGEST)) == []


def test_headers_are_read_alike_in_both_versions() -> None:
    for v1 in (False, True):
        packets = Framer().feed(b"".join(frames(300, v1=v1)))
        assert [packet.sequence for packet in packets] == [k % 256 for k in range(300)]
        assert {(p.system_id, p.component_id, p.signed) for p in packets} == {(7, 1, False)}
        for packet in packets[:20]:
            message = dialect.decode(packet.raw)
            assert message.get_msgId() == packet.message_id
            assert message.get_srcSystem() == packet.system_id


def test_signed_frames_are_whole_and_marked() -> None:
    signed = frames(10, key=b"k" * 32)
    packets = Framer().feed(b"".join(signed))
    assert raws(packets) == signed
    assert all(packet.signed for packet in packets)


def test_an_unknown_message_is_passed_over() -> None:
    before, after = frames(2)
    unknown = b"\xfd\x08\x00\x00\x05\x01\x01\x39\x30\x00" + b"\xfd\x00\x01\x02\xfe\x05\x06\x07" + b"ab"
    framer = Framer()
    assert raws(framer.feed(before + unknown + after)) == [before, after]
    assert framer.skipped == len(unknown)


def test_what_another_message_carries_is_no_frame() -> None:
    """A log on its way through the autopilot may hold a whole heartbeat: it was never said on this wire."""
    mav = common.MAVLink(None, 7, 1)
    (heartbeat,) = frames(1)
    carrier = bytes(common.MAVLink_log_data_message(1, 0, 90, heartbeat.ljust(90, b"\0")).pack(mav))
    assert heartbeat in carrier
    framer = Framer()
    assert raws(framer.feed(carrier + heartbeat)) == [heartbeat]
    assert (framer.frames, framer.others, framer.skipped) == (1, 1, len(carrier))


def test_all_that_an_autopilot_says_is_told_from_noise() -> None:
    framer = Framer()
    mav = common.MAVLink(None, 7, 1)
    for id, kind in common.mavlink_map.items():
        message = kind.__new__(kind)
        common.MAVLink_message.__init__(message, id, kind.msgname)
        framer.feed(bytes(message._pack(mav, kind.crc_extra, bytes(range(1, kind.unpacker.size + 1)))))
    assert framer.frames + framer.others == len(common.mavlink_map)
    assert framer.bad_crc == 0


def test_an_unknown_id_does_not_make_it_wait() -> None:
    """Eleven bytes of noise that announce 255 more must not hold back a heartbeat for seconds."""
    (heartbeat,) = frames(1)
    assert raws(Framer().feed(b"\xfd\xff\x00\x00\x00\x01\x01\xff\xff\xff" + heartbeat)) == [heartbeat]


def test_a_length_that_no_message_has_does_not_make_it_wait() -> None:
    """MAVLink 1 has no extension fields: a HEARTBEAT of 255 bytes is noise."""
    (heartbeat,) = frames(1)
    assert raws(Framer().feed(b"\xfe\xff\x00\x01\x01\x00" + heartbeat)) == [heartbeat]


def test_flags_that_are_not_understood_drop_the_frame() -> None:
    """Its length is not known then: the specification says to drop it."""
    flagged = bytearray(frames(1)[0])
    flagged[2] = 0x02
    assert Framer().feed(bytes(flagged) + bytes(LONGEST)) == []


def test_a_newer_peers_longer_message_is_taken() -> None:
    """Extension fields that this dialect does not know yet come behind those that it knows."""
    mav = common.MAVLink(None, 7, 1)
    payload = common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
    size = common.MAVLink_heartbeat_message.unpacker.size
    frame = payload._pack(mav, payload.crc_extra, bytes(range(1, size + 1)) + b"\x07\x08")
    (packet,) = Framer().feed(frame)
    assert packet.message_id == dialect.HEARTBEAT
    dialect.decode(packet.raw)


def test_counters_add_up() -> None:
    good = frames(3)
    broken = good[1][:-1] + bytes((good[1][-1] ^ 1,))
    framer = Framer()
    framer.feed(good[0] + broken + good[2] + b"\x00" * 5)
    assert framer.frames == 2
    assert framer.bad_crc >= 1
    assert framer.skipped == len(broken) + 5


def test_damaged_frames_by_the_thousand_neither_raise_nor_pile_up() -> None:
    """A short run of what the night runs by the ten million, in a process whose size is measured."""
    script = Path(__file__).parent / "fuzz.py"
    done = subprocess.run(
        [sys.executable, str(script), "--inputs", "60000", "--seed", "1"],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert "no exception" in done.stdout
