"""Settings that a ground station may change in flight: MAVLink's parameter protocol. No I/O, time passed in.

All are REAL32 (ground stations decode the integer types of an onboard computer differently); switches are 0
or 1. Text, unit and limits of a parameter are those of its setting. The table's order is the protocol's index
and does not change while the program runs.

PARAM_REQUEST_LIST is taken at our own ids and at (our system, 0), READ and SET at our own ids alone. A SET is
always answered with PARAM_VALUE: the new value, or the old one where the new cannot be, with a text that
says why. FILE_TRANSFER_PROTOCOL is answered with NAK: MAVProxy then lists parameters after one second, and
after eleven without an answer. Nothing in the section `flight` is in the table: what acts on flight is
switched on in the settings file or not at all. Protocol: mavlink.io/en/services/parameter.html and ftp.html.
"""

from __future__ import annotations

import dataclasses
import math
import struct
import tomllib
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import SettingsError
from locagen_edge.files import write
from locagen_edge.mavlink.dialect import messages
from locagen_edge.mavlink.signing import state_file
from locagen_edge.settings import Settings

TABLE: Mapping[str, str] = {
    "LG_ARRAY_YAW": "array.mount_deg[2]",
    "LG_AIR_TEMP": "environment.temperature_c",
    "LG_DET_EVIDENCE": "detection.evidence",
    "LG_DET_SNR": "detection.snr_db",
    "LG_DET_MISFIT": "detection.misfit",
    "LG_DET_BACKGR": "detection.background_s",
    "LG_STEER_SPAN": "steered.span_s",
    "LG_STEER_FORGET": "steered.forget_s",
    "LG_TRK_COAST": "track.coast_s",
    "LG_TRK_AGIL_B": "track.agility_deg_s2",
    "LG_TRK_AGIL_E": "track.agility_earth_deg_s2",
    "LG_TRK_MOST": "track.most",
    "LG_RATE": "mavlink.rate_hz",
    "LG_POSE_RATE": "pose.rate_hz",
    "LG_COMPASS_SIG": "pose.compass_deg",
    "LG_TILT_SIG": "pose.tilt_deg",
    "LG_TX_RECORDS": "mavlink.send_records",
    "LG_TX_TUNNEL": "mavlink.send_tunnel",
    "LG_TX_ADSB": "mavlink.send_adsb",
    "LG_TX_CAMERA": "mavlink.send_camera_target",
    "LG_TX_COMPUTER": "mavlink.send_computer_status",
}
"""name (16 bytes at most) -> setting; `[2]`: one number of a list"""

NAMES = tuple(TABLE)

PER_S = 40.0
"""values of a list that go out in a second: 1.5 kB/s, a quarter of a link at 57600 baud"""
LISTS_AT_ONCE = 8
"""links that may be sent the list at a time; there are no more"""
FILE = "parameters.toml"

_HEAD = """\
# Parameters that were set over MAVLink. They stand over the settings file.
# Delete a line, or this file, and restart to go back to it.
"""


def place_of(name: str) -> tuple[str, str, int | None]:
    """Section, key, and which number of it, of a parameter."""
    section, _, rest = TABLE[name].partition(".")
    key, _, item = rest.partition("[")
    return section, key, int(item.rstrip("]")) if item else None


def field_of(name: str) -> dataclasses.Field[Any]:
    """The setting's own entry: text, unit and limits."""
    section, key, _ = place_of(name)
    return {field.name: field for field in dataclasses.fields(getattr(Settings(), section))}[key]


def value_of(settings: Settings, name: str) -> float:
    """What the settings hold for a parameter."""
    section, key, item = place_of(name)
    value = getattr(getattr(settings, section), key)
    return float(value if item is None else value[item])


def with_value(settings: Settings, name: str, value: float) -> Settings:
    """The settings with one parameter changed. Raises `SettingsError` where it cannot be."""
    section, key, item = place_of(name)
    part = getattr(settings, section)
    old = getattr(part, key)
    new: Any = value
    if isinstance(old, bool | int):
        if not (math.isfinite(value) and value == round(value)):
            raise SettingsError(f"{section}.{key}: {value:g} is not a whole number")
        new = int(value)
        if isinstance(old, bool):
            if new not in (0, 1):
                raise SettingsError(f"{section}.{key}: {value:g} is neither 0 nor 1")
            new = bool(new)
    elif item is not None:
        new = (*old[:item], value, *old[item + 1 :])
    return dataclasses.replace(settings, **{section: dataclasses.replace(part, **{key: new})})


class Parameters:
    """The parameters of one component, over the settings in `settings`.

    `base`: the settings as the file has them, against which is told what has been changed.
    """

    def __init__(self, settings: Settings, base: Settings | None = None) -> None:
        self.settings = settings
        self._base = base or settings
        self._lists: dict[int, deque[int]] = {}
        self._listed_s = -math.inf

    @property
    def changed(self) -> dict[str, float]:
        """What differs from the settings file: what has to be kept over a restart."""
        return {
            name: value_of(self.settings, name)
            for name in NAMES
            if value_of(self.settings, name) != value_of(self._base, name)
        }

    def value(self, name: str) -> Any:
        """PARAM_VALUE."""
        return messages.MAVLink_param_value_message(
            name.encode("ascii"),
            value_of(self.settings, name),
            messages.MAV_PARAM_TYPE_REAL32,
            len(NAMES),
            NAMES.index(name),
        )

    def read(self, message: Any) -> list[Any]:
        """The answer to PARAM_REQUEST_READ, by name or index; none where there is no such parameter."""
        if message.param_index >= 0:
            return [self.value(NAMES[message.param_index])] if message.param_index < len(NAMES) else []
        return [self.value(message.param_id)] if message.param_id in TABLE else []

    def set(self, message: Any) -> tuple[list[Any], str]:
        """PARAM_SET: the answer, and why the value is refused ('': it is not)."""
        name = message.param_id
        if name not in TABLE:
            return [], ""
        fault = ""
        if message.param_type != messages.MAV_PARAM_TYPE_REAL32:
            fault = f"{name}: its type is REAL32"
        else:
            try:
                self.settings = with_value(self.settings, name, shortest(message.param_value))
            except SettingsError as error:
                # one line each: "section.key: why"
                fault = f"{name}: " + str(error).splitlines()[0].partition(": ")[2]
        return [self.value(name)], fault

    def put_back(self, settings: Settings) -> list[Any]:
        """These could not be applied: back to what holds. What has to be told again."""
        differ = [n for n in NAMES if value_of(self.settings, n) != value_of(settings, n)]
        self.settings = settings
        return [self.value(name) for name in differ]

    def list_to(self, link: int) -> None:
        """PARAM_REQUEST_LIST: all of them to that link, from the start."""
        if link in self._lists or len(self._lists) < LISTS_AT_ONCE:
            self._lists[link] = deque(range(len(NAMES)))

    def due(self, now_s: float) -> Iterator[tuple[int, Any]]:
        """Values of lists that go now, each with its link: a few at a time."""
        room = math.floor(min((now_s - self._listed_s) * PER_S, 8.0)) if self._lists else 0
        if room < 1:
            return
        self._listed_s = now_s
        for _ in range(room):
            for link in list(self._lists):
                yield link, self.value(NAMES[self._lists[link].popleft()])
                if not self._lists[link]:
                    del self._lists[link]


def shortest(value: float) -> float:
    """The shortest decimal that the wire's float32 stands for: 0.1, not 0.10000000149."""
    return float(str(np.float32(value)))


def no_files(message: Any, system_id: int, component_id: int) -> Any | None:
    """NAK to a request for files: we have none. None for what is itself an answer, or damaged.

    Payload: sequence (2), session, opcode, size, opcode asked, burst, padding, offset (4), data.
    """
    payload = bytes(message.payload)
    sequence, session, opcode = struct.unpack_from("<HBB", payload)
    if opcode >= _ACK:
        return None
    answer = struct.pack("<HBBBBBBIB", (sequence + 1) % 65536, session, _NAK, 1, opcode, 0, 0, 0, _UNKNOWN)
    return messages.MAVLink_file_transfer_protocol_message(
        0, system_id, component_id, answer.ljust(len(payload), b"\0")
    )


_ACK, _NAK, _UNKNOWN = 128, 129, 6


# --- kept over restarts ---------------------------------------------------------------------------------


def kept_file(settings: Settings) -> Path:
    """Where changed parameters are kept."""
    return state_file(settings).with_name(FILE)


def keep(path: Path, changed: Mapping[str, float]) -> None:
    """Writes them, whole or not at all; no file where nothing is changed. Raises `OSError`."""
    if not changed:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, _HEAD + "".join(f"{name} = {value!r}  # {TABLE[name]}\n" for name, value in changed.items()))


def kept(settings: Settings) -> tuple[Settings, list[str], list[str]]:
    """The settings with what was kept on top, in words what that is, and what could not be used.

    Never raises: a damaged file must not keep the daemon from listening.
    """
    path = kept_file(settings)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return settings, [], []
    except PermissionError:
        lost = "what was set over MAVLink does not hold here"
        return settings, [], [f"{path}: may not be read, {lost}: as root, or the user locagen-edge"]
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        why = getattr(error, "strerror", None) or "cannot be understood; delete it"
        return settings, [], [f"{path}: {why}"]
    told, faults = [], []
    for name, value in table.items():
        if name not in TABLE or type(value) not in (int, float):
            faults.append(f"{path}: {name} is no parameter of this version, or no number; delete that line")
            continue
        here = value_of(settings, name)
        try:
            settings = with_value(settings, name, float(value))
        except (SettingsError, OverflowError) as error:
            faults.append(f"{path}: {name}: {error}; delete that line")
        else:
            if value_of(settings, name) != here:
                told.append(f"{TABLE[name]} is {value:g}, not {here:g}: {name} in {path}")
    return settings, told, faults
