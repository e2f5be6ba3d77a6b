"""The walls of the house: what flies holds nothing of the workshop, and imports go down only."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGE = ROOT / "locagen_edge"
HEAVY = {"torch", "sklearn", "scipy", "matplotlib", "pandas", "onnx", "skl2onnx", "pymavlink"}


def modules_after(statement: str) -> set[str]:
    script = f"import sys; {statement}; print('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "statement",
    [
        "import locagen_edge.daemon",
        "import locagen_edge.cli",
        "import locagen_edge.check",
        "import locagen_edge.calibrate",
        "import locagen_edge.stages.mic",
        "import locagen_edge.store.recorder",
        "from locagen_edge.pipeline import Pipeline; from locagen_edge.settings import from_table; "
        "Pipeline(from_table({'denoise': {'kind': 'wave'}}))",
        "from locagen_edge.pipeline import Pipeline; from locagen_edge.settings import from_table; "
        "Pipeline(from_table({'bearing': {'estimator': 'model:tdoa-mlp'}}))",
    ],
)
def test_what_flies_holds_nothing_of_the_workshop(statement):
    loaded = modules_after(statement)
    assert not loaded & HEAVY
    assert not any(name.startswith("locagen_edge.lab") for name in loaded)


def test_what_is_not_used_is_not_loaded():
    """The default scene without a learned estimator needs no onnxruntime, PortAudio or libsndfile."""
    loaded = modules_after("import locagen_edge.daemon, locagen_edge.sim.scene")
    assert not loaded & {"onnxruntime", "sounddevice", "soundfile", "tqdm"}


GROUND = {
    "types",
    "geometry",
    "geodesy",
    "errors",
    "settings",
    "kernel",
    "models",
    "framing",
    "resampling",
    "sampleclock",
    "alignment",
    "files",
    "jsonl",
    "poses",
    "highpass",
    "gone",
    "memory",
}
ABOVE = {
    **dict.fromkeys(GROUND, GROUND),
    "stages": GROUND,
    "sim": GROUND,
    "mavlink": GROUND,
    "pipeline": GROUND | {"stages"},
    "sources": GROUND,  # the sources themselves are imported by name, when they are chosen
    "restarts": set(),
    "journald": set(),
    "store": GROUND | {"sightings"},
    "export": GROUND | {"sightings"},
    "sightings": GROUND,
    "fusion": GROUND | {"stages"},
    "notify": set(),
    "stopping": set(),
    "mavproxy_locagen": GROUND | {"mavlink"},  # loaded by MAVProxy alone
    "calibration": GROUND,
    "calibrate": GROUND | {"stages", "calibration"},
    "check": GROUND | {"stages", "mavlink", "pipeline", "sources"},
    "daemon": GROUND | {"stages", "mavlink", "pipeline", "sources", "notify", "store"},
}
"""What each part may import. The command line and the workshop stand on top and may import anything."""


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("locagen_edge."):
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names if name.name.startswith("locagen_edge.")}
    return found


SOURCES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down_only(path):
    part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if part in {"__init__", "__main__", "cli", "lab"}:
        return
    allowed = ABOVE[part] | {part, "_kernel"}
    for module in imports_of(path):
        assert module.split(".")[1] in allowed, f"{path.name} imports {module}"


def test_no_stage_imports_another():
    stages = PACKAGE / "stages"
    for path in stages.rglob("*.py"):
        own = path.relative_to(stages).parts[0].removesuffix(".py")
        for module in imports_of(path):
            if module.startswith("locagen_edge.stages."):
                assert module.split(".")[2] == own, f"{path} imports {module}"


def test_only_one_file_touches_cffi():
    users = [p.name for p in SOURCES if "locagen_edge._kernel" in imports_of(p)]
    assert users == ["kernel.py"]
