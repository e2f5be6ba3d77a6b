"""docs/faults.md is kept honest: tests it names are there, messages are the program's, none is left out."""

from __future__ import annotations

import ast
import re

import pytest
from conftest import ROOT

ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "faults.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ") and not line.startswith(("| fault", "| ---"))
]


def texts_of(path) -> list[str]:
    """All texts of a program's file; what a formatted one takes from elsewhere is an ellipsis."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            parts = [str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values]
            found.append("".join(parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(re.sub(r"%(?:\.\d+f|[sd])", "…", node.value).replace("%%", "%"))
    return found


PROGRAM = [text for path in (ROOT / "locagen_edge").rglob("*.py") for text in texts_of(path)]


def test_there_is_a_table():
    assert len(ROWS) > 40
    assert all(len(row) == 5 for row in ROWS), [row for row in ROWS if len(row) != 5]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_tests_of_a_row_are_there(row):
    names = re.findall(r"`([^`]+)`", row[4])
    assert names
    for name in names:
        if name.startswith("make "):
            assert re.search(rf"^{name[5:]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), name
            continue
        file, test = name.split("::")
        (path,) = (ROOT / "tests").rglob(file)
        functions = {n.name for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)}
        assert test in functions, name


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_the_messages_of_a_row_are_the_programs(row):
    """Every piece between two ellipses stands in one text of the program, in that order."""
    messages = [m for m in re.findall(r"`([^`]+)`", row[1]) if "…" in m or len(m) > 25]
    assert messages or row[1].startswith(("nothing", "the same"))
    for message in messages:
        if re.fullmatch(r'(device "…": |[^:]*: )?…', message):  # the driver's own words
            continue
        pieces = [re.escape(piece.strip()) for piece in message.split("…") if len(piece.strip()) > 2]
        assert pieces, message
        wanted = re.compile(".*".join(pieces), re.DOTALL)
        assert any(wanted.search(text) for text in PROGRAM), message


def test_no_fault_of_the_channels_is_left_out():
    told = " ".join(row[1] for row in ROWS)
    source = ROOT / "locagen_edge" / "stages" / "faults.py"
    for text in texts_of(source):
        if re.match(r"(microphones? …|no microphone|delays longer|the delays fit)", text):
            assert f"`{text}`" in told, text
