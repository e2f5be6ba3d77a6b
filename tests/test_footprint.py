"""What `locagen-edge run` takes: modules, threads and files, of the real process, and no more than that."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import ROOT

CHILD = """
import json, os, sys, threading
before = set(sys.modules)
from locagen_edge.cli import main

def strangers():
    known = {thread.native_id for thread in threading.enumerate()}
    return {int(task) for task in os.listdir("/proc/self/task")} - known

def look():
    first = strangers()
    threading.Event().wait(0.1)  # one that begins or ends just now is a stranger once
    names = [thread.name for thread in threading.enumerate() if thread is not threading.current_thread()]
    found.update(native=len(first & strangers()), threads=names)

found = {}
watch = threading.Timer(1.2, look)
watch.start()
try:
    main(["run", "--quiet", "--seconds", "1.3", "--settings", sys.argv[1]])
except SystemExit as end:
    found["code"] = end.code
new = sorted(set(sys.modules) - before)
found["modules"] = [name for name in new if getattr(sys.modules[name], "__file__", None)]
print(json.dumps(found))
"""

ALWAYS = {"numpy", "_cffi_backend", "fastcrc"}
SOUND = {"soundfile", "_soundfile", "_soundfile_data", "typing_extensions"}
PORTAUDIO = {"sounddevice", "_sounddevice", "_sounddevice_data"}
SIM = '[audio]\nsource = "sim"\n'
CASES = {
    "far-field": ('[bearing]\nestimator = "far-field"\n' + SIM, ALWAYS),
    "default": (SIM, ALWAYS),
    "mask": ('[denoise]\nkind = "mask"\n' + SIM, ALWAYS | {"onnxruntime"}),
    "wav": ('[audio]\nsource = "wav"\nfile = "sound.wav"\nloop = true\n', ALWAYS | SOUND),
    "alsa": ('[audio]\nsource = "alsa"\ndevice = "no such"\n', ALWAYS | SOUND | PORTAUDIO),
    "serial": (
        SIM + '[mavlink]\nlink = ["serial:/dev/no-such:57600"]\n',
        ALWAYS | {"serial", "serial_asyncio_fast"},
    ),
}
"""settings, and what of others they may load"""
OWN_UNUSED = {"lab", "calibrate", "calibration", "check", "export", "fusion", "mavproxy_locagen"}
"""of our own, whatever the settings: for other commands"""


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory) -> tuple[str, dict, Path]:
    """The name of a case, what its process found in itself, and the folder it lived in."""
    home = tmp_path_factory.mktemp(request.param)
    work = home / "work"
    work.mkdir()
    noise = np.random.default_rng(1).standard_normal((48_000, 3)) * 0.01
    soundfile.write(work / "sound.wav", noise, 48_000)
    settings = work / "settings.toml"
    settings.write_text(CASES[request.param][0], encoding="utf-8")
    (home / "state").mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "PYTEST"))} | {
        "HOME": str(home), "TMPDIR": str(home), "STATE_DIRECTORY": str(home / "state"),
        "OPENBLAS_NUM_THREADS": "1",  # as the unit says
        "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    environment.pop("ORT_DISABLE_TELEMETRY", None)  # the program's own doing
    done = subprocess.run(
        [sys.executable, "-c", CHILD, settings.name],
        cwd=work, env=environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["code"] == 0, done.stderr
    return request.param, found, home


def test_loads_what_it_uses_and_nothing_else(case):
    name, found, _ = case
    tops = {module.partition(".")[0] for module in found["modules"]}
    others = {top for top in tops - sys.stdlib_module_names if not top.startswith("_locagen")}
    assert others - {"locagen_edge", "_distutils_hack"} <= CASES[name][1]
    own = {module.split(".")[1] for module in found["modules"] if module.startswith("locagen_edge.")}
    assert not own & OWN_UNUSED
    assert ("sim" in own) == ('"sim"' in CASES[name][0])


def test_starts_no_thread_that_is_not_python_s(case):
    """No pool of a model's session and no telemetry: each thread is one of ours."""
    _, found, _ = case
    assert found["native"] == 0
    known = ("MainThread", "pipeline", "asyncio", "capture", "black box", "Timer")
    assert all(thread.startswith(known) for thread in found["threads"]), found["threads"]


def test_writes_nothing_beyond_its_state(case):
    _, _, home = case
    left = {str(path.relative_to(home)) for path in home.rglob("*") if not path.is_dir()}
    beyond = {path for path in left if not path.startswith("state/")}
    assert beyond == {"work/sound.wav", "work/settings.toml"}
