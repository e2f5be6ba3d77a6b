"""The service as installed: files in their places, a unit that systemd has nothing to say against.

No second systemd is ever started on the machine itself; only its offline checks are used.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

UNIT = ROOT / "systemd" / "locagen-edge.service"
EXPOSURE = 1.5
"""of 10, by systemd's own count; audio and serial devices stay usable"""

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """What `make install DESTDIR=...` lays down (some 20 s: a virtual environment and its packages)."""
    destination = tmp_path_factory.mktemp("root")
    make("install", destination)
    return destination


def make(target: str, destination: Path) -> None:
    done = subprocess.run(
        ["make", target, f"DESTDIR={destination}", f"PYTHON={sys.executable}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_installed_program_runs_with_its_models(installed):
    assert (installed / "etc/locagen-edge/locagen-edge.toml").read_text() == (
        ROOT / "systemd" / "locagen-edge.toml"
    ).read_text()
    home = installed / "opt/locagen-edge"
    assert (home / "bin/locagen-edge").read_text().startswith("#!/opt/locagen-edge/bin/python")
    settings = installed / "learned.toml"
    settings.write_text('[bearing]\nestimator = "model:tdoa-mlp"\n')
    done = subprocess.run(
        [home / "bin/python", "-m", "locagen_edge", "check", "--seconds", "0.5", "--settings", settings],
        cwd=installed,  # not the checkout: only what was installed may be found
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ok     estimator: model:tdoa-mlp" in done.stdout


@needs_systemd
def test_systemd_finds_nothing_wrong_with_the_unit(installed):
    """It exits with 0 on unknown keys, so nothing at all may be said."""
    (command,) = re.findall(r"^ExecStart=(\S+)", UNIT.read_text(), re.MULTILINE)
    assert (installed / command.lstrip("/")).is_file()
    copy = installed / UNIT.name
    copy.write_text(UNIT.read_text().replace(command, str(installed / command.lstrip("/"))))
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@needs_systemd
def test_the_sandbox_is_tight():
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE * 10:.0f}", UNIT],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-300:]


def test_the_unit_says_what_the_program_relies_on():
    text = UNIT.read_text()
    for line in ("Type=notify", "Restart=on-failure", "User=locagen-edge"):
        assert f"\n{line}\n" in text
    assert re.search(r"^WatchdogSec=\d+$", text, re.MULTILINE)
    assert re.search(r"^SupplementaryGroups=.*\baudio\b", text, re.MULTILINE)
    for limit in ("MemoryMax", "MemorySwapMax", "CPUQuota", "CPUWeight", "TasksMax", "LimitCORE"):
        assert re.search(rf"^{limit}=\d", text, re.MULTILINE), limit
    assert "\nMemoryDenyWriteExecute=yes\n" in text


def test_uninstall_leaves_only_the_settings(installed):
    (installed / "learned.toml").unlink(missing_ok=True)
    (installed / UNIT.name).unlink(missing_ok=True)
    make("uninstall", installed)
    left = [str(p.relative_to(installed)) for p in installed.rglob("*") if not p.is_dir()]
    assert left == ["etc/locagen-edge/locagen-edge.toml"]
