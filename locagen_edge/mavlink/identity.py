"""Who we are: AUTOPILOT_VERSION with our version and a number of this computer's own."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from locagen_edge import __version__
from locagen_edge.mavlink.dialect import messages

_APPLICATION = b"locagen-edge"
_CAPABILITIES = (
    messages.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | messages.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | messages.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)


def machine_uid(path: Path = Path("/etc/machine-id")) -> int:
    """64 bits that stay the same on this computer; 0 where it has no machine id.

    Hashed with our own name, as machine-id(5) asks: the id itself is not for the air.
    """
    try:
        machine = path.read_bytes().strip()
    except OSError:
        return 0
    digest = hashlib.sha256(_APPLICATION + machine).digest()
    return int.from_bytes(digest[:8], "little") if machine else 0


def version_number(version: str = __version__) -> int:
    """Major, minor, patch, a byte each, and 255 for a release, 0 for what is under way."""
    numbers = [int("".join(filter(str.isdigit, part)) or 0) for part in version.split(".")[:3]]
    released = version.replace(".", "").isdigit()
    return int.from_bytes(bytes([*(min(n, 255) for n in numbers), *[0] * (3 - len(numbers))]), "big") << 8 | (
        255 if released else 0
    )


def version_message(uid: int) -> Any:
    """AUTOPILOT_VERSION: every component has one, whatever the message is called."""
    none = (0,) * 8
    number = version_number()
    return messages.MAVLink_autopilot_version_message(
        _CAPABILITIES, number, 0, 0, 0, none, none, none, 0, 0, uid
    )
