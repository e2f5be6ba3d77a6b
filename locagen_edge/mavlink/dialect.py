"""The one place that names the generated messages, and the messages that we send.

`_messages.py` is made by the build (`build_dialect.py`) from MAVLink's definitions and `locagen.xml`: the 30
messages that we use, 28 ms and 7.5 MB to import, where pymavlink's `common` takes 51 ms and 11.4 MB, and its
`mavutil`, which blocks, 186 ms and 31 MB. pymavlink itself is not needed at run time.

Only `Sender` makes frames, and only of what `SENT` names. Some ids act on flight when a companion sends them
(LANDING_TARGET, OBSTACLE_DISTANCE, FOLLOW_TARGET, RADIO_STATUS and others); none of them has a place there.
"""

from __future__ import annotations

import binascii
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from types import MappingProxyType
from typing import Any

try:
    from locagen_edge.mavlink import _messages
except ImportError as error:
    raise ImportError(
        "locagen_edge/mavlink/_messages.py is missing: the build makes it. In a checkout: pip install -e . "
        "or, where pymavlink is installed, python -m locagen_edge.mavlink.build_dialect"
    ) from error

messages: Any = _messages

HEARTBEAT: int = messages.MAVLINK_MSG_ID_HEARTBEAT
NAMED_VALUE_FLOAT: int = messages.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
COMMAND_LONG: int = messages.MAVLINK_MSG_ID_COMMAND_LONG
COMMAND_ACK: int = messages.MAVLINK_MSG_ID_COMMAND_ACK
STATUSTEXT: int = messages.MAVLINK_MSG_ID_STATUSTEXT
TUNNEL: int = messages.MAVLINK_MSG_ID_TUNNEL
PING: int = messages.MAVLINK_MSG_ID_PING
LOCAGEN_BEARING: int = messages.MAVLINK_MSG_ID_LOCAGEN_BEARING
LOCAGEN_POSITION: int = messages.MAVLINK_MSG_ID_LOCAGEN_POSITION

TIMESYNC: int = messages.MAVLINK_MSG_ID_TIMESYNC
PARAM_REQUEST_LIST: int = messages.MAVLINK_MSG_ID_PARAM_REQUEST_LIST
PARAM_REQUEST_READ: int = messages.MAVLINK_MSG_ID_PARAM_REQUEST_READ
PARAM_SET: int = messages.MAVLINK_MSG_ID_PARAM_SET
PARAM_VALUE: int = messages.MAVLINK_MSG_ID_PARAM_VALUE
FILE_TRANSFER_PROTOCOL: int = messages.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
COMMAND_INT: int = messages.MAVLINK_MSG_ID_COMMAND_INT
MESSAGE_INTERVAL: int = messages.MAVLINK_MSG_ID_MESSAGE_INTERVAL
AUTOPILOT_VERSION: int = messages.MAVLINK_MSG_ID_AUTOPILOT_VERSION
ONBOARD_COMPUTER_STATUS: int = messages.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
ADSB_VEHICLE: int = messages.MAVLINK_MSG_ID_ADSB_VEHICLE
CAMERA_TRACKING_GEO_STATUS: int = messages.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS

ALWAYS_SENT = frozenset(
    {
        HEARTBEAT,
        NAMED_VALUE_FLOAT,
        STATUSTEXT,
        PING,
        TIMESYNC,
        PARAM_VALUE,
        FILE_TRANSFER_PROTOCOL,
        COMMAND_LONG,
        COMMAND_ACK,
        MESSAGE_INTERVAL,
        AUTOPILOT_VERSION,
    }
)
SWITCHED = {
    "send_records": frozenset({LOCAGEN_BEARING, LOCAGEN_POSITION}),
    "send_tunnel": frozenset({TUNNEL}),
    "send_adsb": frozenset({ADSB_VEHICLE}),
    "send_camera_target": frozenset({CAMERA_TRACKING_GEO_STATUS}),
    "send_computer_status": frozenset({ONBOARD_COMPUTER_STATUS}),
}
"""what each switch in the settings, section `mavlink`, lets out"""
SENT = ALWAYS_SENT.union({COMMAND_INT}, *SWITCHED.values())
"""ids that may leave; COMMAND_INT carries nothing but what the section `flight` switches on"""

SET_MESSAGE_INTERVAL: int = messages.MAV_CMD_SET_MESSAGE_INTERVAL
SET_ROI_LOCATION: int = messages.MAV_CMD_DO_SET_ROI_LOCATION
CONDITION_YAW: int = messages.MAV_CMD_CONDITION_YAW

COMMANDS = frozenset({SET_MESSAGE_INTERVAL})
"""and the commands: an autopilot obeys mode, arming and position from an onboard computer too"""
FLIGHT_COMMANDS = {"roi": SET_ROI_LOCATION, "yaw": CONDITION_YAW}
"""what each switch in the settings file, section `flight`, lets out beside them"""

STATE_ACTIVE: int = messages.MAV_STATE_ACTIVE
STATE_STANDBY: int = messages.MAV_STATE_STANDBY
STATE_CRITICAL: int = messages.MAV_STATE_CRITICAL

SEVERITY_WARNING: int = messages.MAV_SEVERITY_WARNING
SEVERITY_NOTICE: int = messages.MAV_SEVERITY_NOTICE
SEVERITY_INFO: int = messages.MAV_SEVERITY_INFO

COMPONENT_AUTOPILOT: int = messages.MAV_COMP_ID_AUTOPILOT1
TYPE_GROUND_STATION: int = messages.MAV_TYPE_GCS
AUTOPILOT_NONE: int = messages.MAV_AUTOPILOT_INVALID

TEXT_BYTES = 50
"""STATUSTEXT without chunks"""
TEXT_CHUNKS = 4
"""most chunks of one text"""


@dataclass(frozen=True, slots=True)
class Layout:
    """What a framer has to know of a message."""

    crc_extra: int
    """seeds the checksum, so that both ends agree on the fields"""
    size: int
    """longest payload that this dialect knows, extension fields included, bytes"""


LAYOUTS: Mapping[int, Layout] = MappingProxyType(
    {id: Layout(kind.crc_extra, kind.unpacker.size) for id, kind in messages.mavlink_map.items()}
)


OTHERS: Mapping[int, Layout] = MappingProxyType(
    {id: Layout(seed, size) for id, (seed, size) in messages.others.items() if id not in LAYOUTS}
)
"""messages that are nothing to us, from all of MAVLink's definitions: a framer passes over them whole"""

_MIRROR = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


class _Crc:
    """CRC-16/MCRF4XX by the standard library: its mirror image is CRC-16 of the mirrored bytes.

    0.3 us for 40 bytes; the generated module's own takes fastcrc where it is installed (0.1 us), else 10 us.
    """

    def __init__(self, data: bytes = b"") -> None:
        self._mirrored = 0xFFFF
        self.accumulate(data)

    def accumulate(self, data: bytes) -> None:
        self._mirrored = binascii.crc_hqx(data.translate(_MIRROR), self._mirrored)

    @property
    def crc(self) -> int:
        return _MIRROR[self._mirrored >> 8] | _MIRROR[self._mirrored & 0xFF] << 8


messages.x25crc = _Crc


def checksum(data: bytes, crc_extra: int) -> int:
    """The checksum of a frame without its first byte, then the message's extra byte."""
    return _Crc(data + bytes((crc_extra,))).crc


def _picker(kind: Any) -> tuple[Callable[[tuple[Any, ...]], tuple[Any, ...]], tuple[int, ...]]:
    """What takes the constructor's arguments out of an unpacked payload, and which of them are texts."""
    places: list[int | slice] = []
    for order in kind.orders:
        first, count = sum(kind.lengths[:order]), kind.lengths[order]
        places.append(first if count == 1 else slice(first, first + count))
    texts = tuple(at for at, name in enumerate(kind.fieldtypes) if name == "char")
    pick = itemgetter(*places)
    return (pick if len(places) > 1 else lambda values: (pick(values),)), texts


_PICKERS = {id: _picker(kind) for id, kind in messages.mavlink_map.items()}


def decode(raw: bytes) -> Any:
    """The generated message of a whole frame whose checksum has been verified (`framer.Packet.raw`).

    The generated `MAVLink.decode` does the same in twice the time: it verifies again, and sorts fields anew.
    """
    if raw[0] == 0xFD:
        payload, incompatible, compatible, sequence, system_id, component_id = raw[1:7]
        id, start = int.from_bytes(raw[7:10], "little"), 10
    else:
        payload, sequence, system_id, component_id, id = raw[1:6]
        incompatible, compatible, start = 0, 0, 6
    kind = messages.mavlink_map[id]
    size = kind.unpacker.size
    pick, texts = _PICKERS[id]
    # zeros at the end may have been cut, and a newer sender's fields come behind the ones known here
    fields = pick(kind.unpacker.unpack(raw[start : start + min(payload, size)].ljust(size, b"\0")))
    if texts:
        fields = tuple(field.rstrip(b"\0") if at in texts else field for at, field in enumerate(fields))
    message = kind(*fields)
    message._msgbuf = bytearray(raw)
    message._header = messages.MAVLink_header(
        id, incompatible, compatible, payload, sequence, system_id, component_id
    )
    return message


def heartbeat(state: int) -> Any:
    """HEARTBEAT of an onboard computer that flies nothing."""
    return messages.MAVLink_heartbeat_message(
        type=messages.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=AUTOPILOT_NONE,
        base_mode=0,
        custom_mode=0,
        system_status=state,
        mavlink_version=3,
    )


def named_value_float(time_boot_ms: int, name: str, value: float) -> Any:
    """NAMED_VALUE_FLOAT; the name has 10 characters at most, the time is cut to 32 bits."""
    return messages.MAVLink_named_value_float_message(time_boot_ms & 0xFFFFFFFF, name.encode("ascii"), value)


def statustexts(severity: int, text: str, number: int = 1) -> list[Any]:
    """STATUSTEXT in printable ASCII; what else the text holds becomes a question mark.

    Beyond 50 bytes it goes in chunks under a common number from 1 to 65535, at most four: the rest is cut.
    The last chunk is the one that is not full, so a text of 100 bytes has an empty third.
    """
    plain = "".join(c if " " <= c <= "~" else "?" for c in text)
    if len(plain) <= TEXT_BYTES:
        return [messages.MAVLink_statustext_message(severity, plain.encode("ascii"))]
    plain = plain[: TEXT_CHUNKS * TEXT_BYTES - 1]
    return [
        messages.MAVLink_statustext_message(
            severity, plain[start : start + TEXT_BYTES].encode("ascii"), number, start // TEXT_BYTES
        )
        for start in range(0, len(plain) + 1, TEXT_BYTES)
    ]


def ping(asked: Any, system_id: int, component_id: int) -> Any:
    """PING, as the answer to one from that component."""
    return messages.MAVLink_ping_message(asked.time_usec, asked.seq, system_id, component_id)


_TUNNEL_BYTES = 128
_TUNNELLED = {id: messages.mavlink_map[id] for id in (LOCAGEN_BEARING, LOCAGEN_POSITION)}


def tunnel(message: Any) -> Any:
    """TUNNEL to everybody with the payload of `message`, a LOCAGEN one, whose id is the payload type.

    For paths through autopilots that drop ids they do not know.
    """
    assert message.id in _TUNNELLED
    message.pack(messages.MAVLink(None))
    payload = bytes(message.get_payload())
    padded = payload.ljust(_TUNNEL_BYTES, b"\0")
    return messages.MAVLink_tunnel_message(0, 0, message.id, len(payload), padded)


def untunnel(message: Any) -> Any | None:
    """The LOCAGEN message inside a TUNNEL; None where there is none. Never raises.

    As in MAVLink itself, zeros at the payload's end may have been cut, and a newer sender's extension fields
    come behind the ones that are known here.
    """
    kind = _TUNNELLED.get(message.payload_type)
    if kind is None or message.payload_length > _TUNNEL_BYTES:
        return None
    size = kind.unpacker.size
    payload = bytes(message.payload)[: message.payload_length][:size].ljust(size, b"\0")
    frame = b"\xfd" + bytes((size, 0, 0, 0, 0, 0)) + kind.id.to_bytes(3, "little") + payload
    return decode(frame + checksum(frame[1:], kind.crc_extra).to_bytes(2, "little"))


def command(system_id: int, command: int, *parameters: float) -> Any:
    """COMMAND_LONG to the autopilot; parameters that are not given are 0."""
    given = [float(value) for value in parameters] + [0.0] * (7 - len(parameters))
    return messages.MAVLink_command_long_message(system_id, COMPONENT_AUTOPILOT, command, 0, *given)


def command_at(
    system_id: int, command: int, latitude_deg: float, longitude_deg: float, altitude_m: float | None
) -> Any:
    """COMMAND_INT to the autopilot with a place; altitude above sea level, None: that of the take-off place.

    In COMMAND_LONG a longitude would be a float32, good for some metres.
    """
    if altitude_m is None or not abs(altitude_m) < 1e5:  # NaN too
        altitude_m, frame = 0.0, messages.MAV_FRAME_GLOBAL_RELATIVE_ALT
    else:
        frame = messages.MAV_FRAME_GLOBAL
    lat, lon = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    return messages.MAVLink_command_int_message(
        system_id, COMPONENT_AUTOPILOT, frame, command, 0, 0, 0.0, 0.0, 0.0, 0.0, lat, lon, altitude_m
    )


def set_message_interval(system_id: int, message_id: int, interval_us: int) -> Any:
    """The command to an autopilot to send us a message this often, on the link on which it was asked."""
    return command(system_id, SET_MESSAGE_INTERVAL, message_id, interval_us)


class Sender:
    """Packs messages as MAVLink 2 under our ids, and numbers them. `commands`: those that may leave."""

    def __init__(self, system_id: int, component_id: int, commands: frozenset[int] = COMMANDS) -> None:
        self._mav = messages.MAVLink(None, system_id, component_id)
        self._commands = commands

    @property
    def component_id(self) -> int:
        return int(self._mav.srcComponent)

    @property
    def system_id(self) -> int:
        return int(self._mav.srcSystem)

    @system_id.setter
    def system_id(self, system_id: int) -> None:
        self._mav.srcSystem = system_id

    def pack(self, message: Any) -> bytes:
        """The frame; the next one gets the next sequence number.

        Raises `ValueError` for what is not in `SENT`, or a command that may not leave.
        """
        if message.get_msgId() not in SENT:
            raise ValueError(f"{message.get_type()} is none of the messages that may leave")
        if message.get_msgId() in (COMMAND_LONG, COMMAND_INT) and message.command not in self._commands:
            raise ValueError(f"command {message.command} is none of those that may leave")
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame
