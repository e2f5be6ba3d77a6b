"""Restarts in a row are put off; whoever ran for a while, or ended as asked, starts at once."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.restarts import FILE, LONGEST_S, STEADY_S, forget, put_off_s


def starts(directory, lives_s):
    """What each start waits, where each run lasts for so long and then fails."""
    now_s, waits = 1000.0, []
    for life_s in lives_s:
        waits.append(put_off_s(directory, now_s))
        now_s += waits[-1] + life_s
    return waits


def test_the_first_restart_is_at_once_and_then_each_waits_twice_as_long(tmp_path):
    assert starts(tmp_path, [0.5] * 9) == [0, 0, 1, 2, 4, 8, 16, 30, 30]


def test_a_run_that_lasted_begins_anew(tmp_path):
    assert starts(tmp_path, [0.5, 0.5, 0.5, STEADY_S, 0.5, 0.5]) == [0, 0, 1, 2, 0, 0]


def test_a_clean_end_is_forgotten(tmp_path):
    starts(tmp_path, [0.5] * 4)
    forget(tmp_path)
    forget(tmp_path)  # twice is no error
    assert put_off_s(tmp_path, 1010.0) == 0


@given(st.lists(st.floats(0, 1e4), max_size=60))
def test_it_waits_for_the_longest_at_most(tmp_path_factory, lives_s):
    assert all(0 <= wait_s <= LONGEST_S for wait_s in starts(tmp_path_factory.mktemp("notes"), lives_s))


@given(st.binary(max_size=40))
def test_a_damaged_note_is_no_reason_not_to_start(tmp_path_factory, torn):
    directory = tmp_path_factory.mktemp("notes")
    (directory / FILE).write_bytes(torn)
    assert 0 <= put_off_s(directory, 1000.0) <= LONGEST_S


def test_where_nothing_can_be_noted_nothing_waits(tmp_path):
    assert starts(tmp_path / "missing", [0.1] * 5) == [0] * 5


def test_a_time_from_before_the_boot_does_not_count(tmp_path):
    (tmp_path / FILE).write_text("7 999999.0\n")
    assert put_off_s(tmp_path, 5.0) == 0


@pytest.mark.parametrize("asked", [True, False])
def test_only_a_failure_puts_off_the_next_start(tmp_path, asked):
    """The program itself, as the unit starts it: settings at fault, or a run that ends as it was asked to."""
    settings = tmp_path / "settings.toml"
    settings.write_text("" if asked else "[audio]\nrate_hz = 1\n")
    done = subprocess.run(
        [sys.executable, "-m", "locagen_edge", "run", "--quiet", "--seconds", "0.3", "--settings", settings],
        env={"RUNTIME_DIRECTORY": str(tmp_path)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == (0 if asked else 1), done.stderr
    assert (tmp_path / FILE).exists() is not asked


def test_a_start_that_is_put_off_ends_when_asked(tmp_path):
    """Before its own handlers are set: the signal ends it as the system does."""
    (tmp_path / FILE).write_text("0 0\n")
    child = subprocess.Popen(
        [sys.executable, "-c", "from pathlib import Path; from locagen_edge import cli, restarts;"
         f"cli.put_off_s = lambda notes, now_s: 600.0; cli._put_off(Path('{tmp_path}'))"],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with child:
        assert "waiting for 600 s" in child.stderr.readline()
        child.send_signal(signal.SIGTERM)
        assert child.wait(10) == -signal.SIGTERM
