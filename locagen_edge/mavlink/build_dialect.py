"""Makes `_messages.py`: the MAVLink messages that this program reads or sends, and no others.

    python -m locagen_edge.mavlink.build_dialect              _messages.py, as the build does
    python -m locagen_edge.mavlink.build_dialect --lua FILE   a Wireshark dissector of the same messages

A build tool: nothing that flies imports it. pymavlink, which it needs, brings MAVLink's definitions (XML) and
their generator along. `common` would be 230 messages, in twice the time and memory. Texts are left out of the
generated module: they are for people, and stay in the XML.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
OWN_XML = HERE / "locagen.xml"
MODULE = HERE / "_messages.py"

MESSAGES = (
    # every component
    "HEARTBEAT",
    "STATUSTEXT",
    "NAMED_VALUE_FLOAT",
    "TUNNEL",
    # pose of the vehicle
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT",
    "ALTITUDE",
    "TERRAIN_REPORT",
    "DISTANCE_SENSOR",
    "SERVO_OUTPUT_RAW",
    # time
    "SYSTEM_TIME",
    "TIMESYNC",
    # commands and parameters
    "COMMAND_LONG",
    "COMMAND_INT",
    "COMMAND_ACK",
    "MESSAGE_INTERVAL",
    "REQUEST_DATA_STREAM",
    "PARAM_REQUEST_READ",
    "PARAM_REQUEST_LIST",
    "PARAM_VALUE",
    "PARAM_SET",
    "PING",
    "AUTOPILOT_VERSION",
    "FILE_TRANSFER_PROTOCOL",
    # on request
    "ONBOARD_COMPUTER_STATUS",
    "ADSB_VEHICLE",
    "CAMERA_TRACKING_GEO_STATUS",
)
"""taken from common.xml and what it includes; all of `OWN_XML` comes on top"""

ENUMS = ("MAV_COMPONENT",)
"""beside those that a field of the messages names"""

ENTRIES = {
    "MAV_CMD": (
        "MAV_CMD_REQUEST_MESSAGE",
        "MAV_CMD_SET_MESSAGE_INTERVAL",
        "MAV_CMD_GET_MESSAGE_INTERVAL",
        "MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES",
        "MAV_CMD_REQUEST_PROTOCOL_VERSION",
        "MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN",
        "MAV_CMD_DO_SET_ROI_LOCATION",
        "MAV_CMD_DO_SET_ROI_NONE",
        "MAV_CMD_CONDITION_YAW",
        "MAV_CMD_USER_1",
        "MAV_CMD_USER_2",
        "MAV_CMD_USER_3",
        "MAV_CMD_USER_4",
        "MAV_CMD_USER_5",
    ),
    "MAV_COMPONENT": (
        "MAV_COMP_ID_ALL",
        "MAV_COMP_ID_AUTOPILOT1",
        "MAV_COMP_ID_MISSIONPLANNER",
        "MAV_COMP_ID_ONBOARD_COMPUTER",
        "MAV_COMP_ID_ONBOARD_COMPUTER2",
        "MAV_COMP_ID_ONBOARD_COMPUTER3",
        "MAV_COMP_ID_ONBOARD_COMPUTER4",
    ),
}
"""enums of which we name few entries"""


def definitions() -> Path:
    """pymavlink's folder of XML definitions. Raises `SystemExit` where pymavlink is missing."""
    try:
        import pymavlink.dialects.v20
    except ImportError as error:
        raise SystemExit("the MAVLink messages are made by pymavlink: pip install pymavlink") from error
    return Path(pymavlink.dialects.v20.__path__[0])


def with_includes(path: Path) -> list[Path]:
    """`path` and all that it includes, each once."""
    found: list[Path] = []
    waiting = [path]
    while waiting:
        here = waiting.pop()
        if here not in found:
            found.append(here)
            waiting += [here.parent / str(include.text).strip() for include in ET.parse(here).iter("include")]
    return found


def slim(sources: list[Path], *, texts: bool) -> ET.Element:
    """One definition that includes nothing: `MESSAGES`, our own, and the enums that they name."""
    roots = [ET.parse(path).getroot() for path in sources]
    own = ET.parse(OWN_XML).getroot()
    known = {str(message.get("name")): message for root in roots for message in root.iter("message")}
    if missing := [name for name in MESSAGES if name not in known]:
        raise SystemExit(f"{sources[0]}: has no {', '.join(missing)}: another pymavlink is needed")
    chosen = [*(known[name] for name in MESSAGES), *own.iter("message")]
    named = {str(field.get("enum")) for message in chosen for field in message.iter("field")} | {*ENUMS}
    result = ET.Element("mavlink")
    ET.SubElement(result, "version").text = "3"
    enums = ET.SubElement(result, "enums")
    for root in (*roots, own):
        for enum in root.iter("enum"):
            if enum.get("name") in named:
                enums.append(_cut(enum))
    ET.SubElement(result, "messages").extend(chosen)
    if not texts:
        for element in result.iter():
            element.text = element.text if element.tag == "version" else None
    return result


def _cut(enum: ET.Element) -> ET.Element:
    wanted = ENTRIES.get(str(enum.get("name")))
    for entry in list(enum.iter("entry")):
        if wanted is not None and entry.get("name") not in wanted:
            enum.remove(entry)
        for parameter in list(entry.iter("param")):
            entry.remove(parameter)
    return enum


@contextlib.contextmanager
def _in_place(path: Path) -> Iterator[Path]:
    """A path to write to, moved to `path` when all went well."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        written = Path(folder) / path.name
        yield written
        os.replace(written, path)


def generate(path: Path = MODULE, language: str = "Python3", *, texts: bool = False) -> None:
    """Writes the messages in `language` (mavgen's name for it). Raises `SystemExit` with a reason."""
    sources = with_includes(definitions() / "common.xml")
    from pymavlink.generator import mavgen

    with tempfile.TemporaryDirectory() as folder, _in_place(path) as output:
        xml = Path(folder) / "locagen.xml"
        ET.ElementTree(slim(sources, texts=texts)).write(xml, encoding="utf-8")
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            done = mavgen.mavgen(mavgen.Opts(str(output), "2.0", language, validate=False), [str(xml)])
        if not done or not output.exists():
            raise SystemExit(f"mavgen failed:\n{said.getvalue()}")


def fresh() -> bool:
    """Whether `_messages.py` is younger than what it is made from."""
    return MODULE.exists() and MODULE.stat().st_mtime >= max(
        p.stat().st_mtime for p in (OWN_XML, Path(__file__))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes the MAVLink messages of locagen-edge.")
    parser.add_argument("--lua", type=Path, metavar="FILE", help="write a Wireshark dissector instead")
    arguments = parser.parse_args()
    if arguments.lua:
        generate(arguments.lua, "WLua", texts=True)
    else:
        generate()
    print(f"written: {arguments.lua or MODULE}", file=sys.stderr)


if __name__ == "__main__":
    main()
