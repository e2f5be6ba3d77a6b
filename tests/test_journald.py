"""Levels in the journal, letters on a terminal."""

from __future__ import annotations

import io
import logging
import os

import pytest

from locagen_edge.journald import formatter

LEVELS = {"CRITICAL": 2, "ERROR": 3, "WARNING": 4, "INFO": 6, "DEBUG": 7}


def record(level, text="two\nlines"):
    return logging.LogRecord("name", level, __file__, 1, text, None, None)


@pytest.fixture
def journal(tmp_path, monkeypatch):
    with (tmp_path / "stream").open("w") as stream:
        found = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        yield stream


@pytest.mark.parametrize(("name", "level"), LEVELS.items())
def test_every_line_in_the_journal_has_its_level(journal, name, level):
    made = formatter(journal).format(record(logging.getLevelName(name)))
    assert made == f"<{level}>two\n<{level}>lines"


def test_a_traceback_is_of_one_level(journal):
    try:
        raise ValueError("no")
    except ValueError as error:
        entry = record(logging.ERROR, "why")
        entry.exc_info = (type(error), error, error.__traceback__)
    lines = formatter(journal).format(entry).splitlines()
    assert len(lines) > 2
    assert all(line.startswith("<3>") for line in lines)


def test_elsewhere_a_letter_says_it(journal, tmp_path):
    """Under the same variable, as a child of a service inherits it, but with stderr in a file or memory."""
    with (tmp_path / "other").open("w") as stream:
        assert formatter(stream).format(record(logging.WARNING, "text")) == "W text"
    assert formatter(io.StringIO()).format(record(logging.ERROR, "text")) == "E text"
