"""Makes `_messages.py`: the MAVLink messages that this program reads or sends, and no others.

    python -m locagen_edge.mavlink.build_dialect              _messages.py, as the build does
    python -m locagen_edge.mavlink.build_dialect --lua FILE   a Wireshark dissector: all of common, and ours
    python -m locagen_edge.mavlink.build_dialect --docs FILE  the field tables between FILE's two marks

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

BEGIN, END = "<!-- tables: made from locagen.xml by `make format` -->", "<!-- tables: end -->"

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


def slim(sources: list[Path]) -> ET.Element:
    """One definition that includes nothing and says nothing: `MESSAGES`, our own, and the enums they name."""
    roots = [ET.parse(path).getroot() for path in sources]
    own = ET.parse(OWN_XML).getroot()
    known = {str(message.get("name")): message for root in roots for message in root.iter("message")}
    if missing := [name for name in MESSAGES if name not in known]:
        raise SystemExit(f"{sources[0]}: has no {', '.join(missing)}: another pymavlink is needed")
    chosen = [*(known[name] for name in MESSAGES), *own.iter("message")]
    named = {str(field.get("enum")) for message in chosen for field in message.iter("field")} | {*ENUMS}
    result = ET.Element("mavlink")
    enums = ET.SubElement(result, "enums")
    for root in (*roots, own):
        for enum in root.iter("enum"):
            if enum.get("name") in named:
                enums.append(_cut(enum))
    ET.SubElement(result, "messages").extend(chosen)
    for element in result.iter():
        element.text = None
    ET.SubElement(result, "version").text = "3"
    return result


def whole(definition: Path) -> ET.Element:
    """A definition that includes all of `definition` and ours."""
    result = ET.Element("mavlink")
    for path in (definition, OWN_XML):
        ET.SubElement(result, "include").text = str(path)
    ET.SubElement(result, "messages")
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


def generate(path: Path = MODULE, language: str = "Python3") -> None:
    """Writes the messages in `language` (mavgen's name for it). Raises `SystemExit` with a reason."""
    common = definitions() / "common.xml"
    from pymavlink.generator import mavgen

    root = slim(with_includes(common)) if language == "Python3" else whole(common)
    with tempfile.TemporaryDirectory() as folder, _in_place(path) as output:
        xml = Path(folder) / "locagen.xml"
        ET.ElementTree(root).write(xml, encoding="utf-8")
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            done = mavgen.mavgen(mavgen.Opts(str(output), "2.0", language, validate=False), [str(xml)])
            rest = f"\n# id: (crc_extra, longest payload)\nothers = {others()}\n"
        if not done or not output.exists():
            raise SystemExit(f"mavgen failed:\n{said.getvalue()}")
        if language == "Python3":
            with output.open("a", encoding="utf-8") as file:
                file.write(rest)


def others() -> dict[int, tuple[int, int]]:
    """Seed and size of every message that MAVLink knows, to tell what is not for us from noise."""
    from pymavlink.generator.mavparse import MAVXML

    found = {}
    for path in with_includes(definitions() / "all.xml"):
        definition = MAVXML(str(path), "2.0")
        for id, seed in definition.message_crcs.items():
            found[id] = (seed, definition.message_lengths[id])
    return dict(sorted(found.items()))


def tables() -> str:
    """Our messages and enums as Markdown, with the place of every field in the payload."""
    from pymavlink.generator.mavparse import MAVXML

    definition = MAVXML(str(OWN_XML), "2.0")
    lines = []
    for message in definition.message:
        lines += ["", f"### {message.name} ({message.id})", "", message.description, ""]
        lines += [f"{message.wire_length} bytes, CRC extra {message.crc_extra}, little-endian.", ""]
        lines += ["| byte | field | type | unit | not known | |", "| --- | --- | --- | --- | --- | --- |"]
        for field in message.ordered_fields:
            kind = field.type + (f"[{field.array_length}]" if field.array_length else "")
            unit, invalid = field.units.strip("[]"), field.invalid.strip("[]")
            cells = (field.wire_offset, f"`{field.name}`", kind, unit, invalid, field.description)
            lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    for enum in definition.enum:
        lines += [
            "",
            f"### {enum.name}",
            "",
            enum.description,
            "",
            "| value | name | |",
            "| --- | --- | --- |",
        ]
        for entry in enum.entry:
            lines.append(
                f"| {entry.value} | `{entry.name.removeprefix(enum.name + '_')}` | {entry.description} |"
            )
    return "\n".join([*lines, ""])


def with_tables(text: str) -> str:
    """The document with its tables made anew. Raises `SystemExit` where the two marks are missing."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"the document has no {BEGIN} and {END}")
    return f"{before}{begin}\n{tables()}\n{end}{after}"


def fresh() -> bool:
    """Whether `_messages.py` is younger than what it is made from."""
    return MODULE.exists() and MODULE.stat().st_mtime >= max(
        p.stat().st_mtime for p in (OWN_XML, Path(__file__))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes the MAVLink messages of locagen-edge.")
    parser.add_argument("--lua", type=Path, metavar="FILE", help="write a Wireshark dissector instead")
    parser.add_argument(
        "--docs", type=Path, metavar="FILE", help="renew the tables in a Markdown file instead"
    )
    arguments = parser.parse_args()
    if arguments.docs:
        text = with_tables(arguments.docs.read_text(encoding="utf-8"))
        with _in_place(arguments.docs) as output:
            output.write_text(text, encoding="utf-8")
    elif arguments.lua:
        generate(arguments.lua, "WLua")
    else:
        generate()
    print(f"written: {arguments.docs or arguments.lua or MODULE}", file=sys.stderr)


if __name__ == "__main__":
    main()
