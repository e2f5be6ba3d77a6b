"""The one place that names the generated dialect, and the messages that we send.

`common` as pymavlink ships it: importing it takes 65 ms and 20.5 MB and pulls in no `mavutil`, which
blocks. Only `Sender` and the four functions below make messages: an id that has no function here never
leaves. Some ids act on flight when a companion sends them (LANDING_TARGET, OBSTACLE_DISTANCE,
FOLLOW_TARGET, RADIO_STATUS and others); none of them has a place in this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from pymavlink.dialects.v20 import common

HEARTBEAT: int = common.MAVLINK_MSG_ID_HEARTBEAT
NAMED_VALUE_FLOAT: int = common.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
STATUSTEXT: int = common.MAVLINK_MSG_ID_STATUSTEXT

STATE_ACTIVE: int = common.MAV_STATE_ACTIVE
STATE_CRITICAL: int = common.MAV_STATE_CRITICAL

SEVERITY_WARNING: int = common.MAV_SEVERITY_WARNING
SEVERITY_NOTICE: int = common.MAV_SEVERITY_NOTICE

COMPONENT_AUTOPILOT: int = common.MAV_COMP_ID_AUTOPILOT1
TYPE_GROUND_STATION: int = common.MAV_TYPE_GCS
AUTOPILOT_NONE: int = common.MAV_AUTOPILOT_INVALID

TEXT_BYTES = 50
"""STATUSTEXT without chunks"""


@dataclass(frozen=True, slots=True)
class Layout:
    """What a framer has to know of a message."""

    crc_extra: int
    """seeds the checksum, so that both ends agree on the fields"""
    size: int
    """longest payload that this dialect knows, extension fields included, bytes"""


LAYOUTS: Mapping[int, Layout] = MappingProxyType(
    {id: Layout(kind.crc_extra, kind.unpacker.size) for id, kind in common.mavlink_map.items()}
)


def checksum(data: bytes, crc_extra: int) -> int:
    """CRC-16/MCRF4XX of a frame without its first byte, then the message's extra byte.

    0.4 us for the longest frame with fastcrc, which pymavlink brings along; 40 us without.
    """
    crc = common.x25crc(data + bytes((crc_extra,)))
    return int(crc.crc)


def decode(raw: bytes) -> Any:
    """The generated message of a whole frame whose checksum has been verified (`framer.Packet.raw`)."""
    return common.MAVLink(None).decode(bytearray(raw))


def heartbeat(state: int) -> Any:
    """HEARTBEAT of an onboard computer that flies nothing."""
    return common.MAVLink_heartbeat_message(
        type=common.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=AUTOPILOT_NONE,
        base_mode=0,
        custom_mode=0,
        system_status=state,
        mavlink_version=3,
    )


def named_value_float(time_boot_ms: int, name: str, value: float) -> Any:
    """NAMED_VALUE_FLOAT; the name has 10 characters at most, the time is cut to 32 bits."""
    return common.MAVLink_named_value_float_message(time_boot_ms & 0xFFFFFFFF, name.encode("ascii"), value)


def statustext(severity: int, text: str) -> Any:
    """STATUSTEXT in printable ASCII, cut at 50 bytes: what else the text holds becomes a question mark."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in text[:TEXT_BYTES])
    return common.MAVLink_statustext_message(severity, plain.encode("ascii"))


def set_message_interval(system_id: int, message_id: int, interval_us: int) -> Any:
    """The command to an autopilot to send us a message this often: the only command that we give."""
    return common.MAVLink_command_long_message(
        target_system=system_id,
        target_component=COMPONENT_AUTOPILOT,
        command=common.MAV_CMD_SET_MESSAGE_INTERVAL,
        confirmation=0,
        param1=float(message_id),
        param2=float(interval_us),
        param3=0.0,
        param4=0.0,
        param5=0.0,
        param6=0.0,
        param7=0.0,  # to whom: as the autopilot does by itself, on the link on which it was asked
    )


class Sender:
    """Packs messages as MAVLink 2 under our ids, and numbers them."""

    def __init__(self, system_id: int, component_id: int) -> None:
        self._mav = common.MAVLink(None, system_id, component_id)

    @property
    def system_id(self) -> int:
        return int(self._mav.srcSystem)

    @system_id.setter
    def system_id(self, system_id: int) -> None:
        self._mav.srcSystem = system_id

    def pack(self, message: Any) -> bytes:
        """The frame; the next one gets the next sequence number."""
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame
