"""Models: only what the manifest says may fly, and the runtime keeps to itself."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from locagen_edge.errors import ModelError
from locagen_edge.geometry import direction, wrap
from locagen_edge.models import load_model, read_manifest
from locagen_edge.settings import Settings, from_table
from locagen_edge.stages.bearing import make_estimator
from locagen_edge.types import Tdoa

MODELS = ROOT / "models"
NAME = "tdoa-mlp"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the models that a test may spoil."""
    return Path(shutil.copytree(MODELS, tmp_path / "models"))


def settings_with(folder: Path, **sections) -> Settings:
    return from_table({"models": {"directory": str(folder)}, **sections})


def rewrite(folder: Path, **entry) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["models"][NAME].update(entry)
    path.write_text(json.dumps(manifest))


def refused(folder: Path, says: str, name: str = NAME) -> None:
    with pytest.raises(ModelError, match=says) as caught:
        load_model(name, settings_with(folder))
    assert len(str(caught.value).splitlines()) == 1


def test_every_model_of_the_project_loads_and_has_a_card():
    for name, entry in read_manifest(MODELS).items():
        load_model(name, Settings())
        assert (MODELS / entry["card"]).read_text().startswith(f"# {name}\n")


def test_an_altered_file_is_refused(folder):
    path = folder / f"{NAME}.onnx"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    refused(folder, "is not the one of the manifest")


def test_a_missing_file_is_refused(folder):
    (folder / f"{NAME}.onnx").unlink()
    refused(folder, f"model {NAME}: .*{NAME}.onnx: No such file")


def test_a_file_that_is_no_model_is_refused(folder):
    import hashlib

    (folder / f"{NAME}.onnx").write_bytes(b"not a model")
    rewrite(folder, sha256=hashlib.sha256(b"not a model").hexdigest())
    refused(folder, "cannot be loaded")


@pytest.mark.parametrize("kind", ["inputs", "outputs"])
@pytest.mark.parametrize(
    "change", [{"shape": [1, 4]}, {"name": "other"}, {"type": "tensor(double)"}], ids=lambda c: next(iter(c))
)
def test_other_tensors_are_refused(folder, kind, change):
    tensor = read_manifest(folder)[NAME][kind][0]
    rewrite(folder, **{kind: [{**tensor, **change}]})
    refused(folder, f"{kind} are .* the manifest states")


def test_another_array_is_refused(folder):
    rewrite(folder, array_m=[[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]])
    refused(folder, "trained for another array")


def test_an_array_that_is_only_moved_is_not(folder):
    moved = np.add(read_manifest(folder)[NAME]["array_m"], [0.1, 0.2, 0.3]).tolist()
    rewrite(folder, array_m=moved)
    load_model(NAME, settings_with(folder))


def test_an_unknown_name_is_refused_with_the_known_ones(folder):
    refused(folder, f"model nope: is not in .*there are .*{NAME}", name="nope")


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"models": []}', '{"models": {"tdoa-mlp": []}}', '{"models": {"tdoa-mlp": null}}']
)
def test_a_broken_manifest_is_refused(folder, content):
    (folder / "manifest.json").write_text(content)
    refused(folder, "manifest")


def test_a_missing_manifest_is_refused(tmp_path):
    refused(tmp_path, "set models.directory")


def test_the_learned_estimator_finds_plane_waves():
    """Trained on callers from 0 to 60 m below; its report says 0.10 degrees at 30 dB."""
    settings = from_table({"bearing": {"estimator": f"model:{NAME}"}})
    estimate = make_estimator(settings)
    errors = []
    for azimuth_deg in range(0, 360, 5):
        azimuth = math.radians(azimuth_deg)
        delay = settings.mic_array.delays_s(direction(azimuth, -0.4), settings.speed_m_s)
        bearing = estimate(Tdoa(delay, np.full(3, 1e-6), np.ones(3)))
        errors.append(abs(math.degrees(wrap(bearing.azimuth_rad - azimuth))))
        assert bearing.estimator == f"model:{NAME}"
        assert bearing.elevation_rad == pytest.approx(-0.4, abs=1e-6)
    assert np.mean(errors) < 0.2


def test_silence_has_no_bearing():
    estimate = make_estimator(from_table({"bearing": {"estimator": f"model:{NAME}"}}))
    assert estimate(Tdoa(np.full(3, np.nan), np.full(3, np.inf), np.zeros(3))).azimuth_rad is None


def test_torch_and_onnx_agree():
    """Within 1e-5, float32's accuracy over some 70 sums; the file holds no paths of the machine."""
    torch = pytest.importorskip("torch", reason="the lab extra is not installed")
    from locagen_edge.lab.export import answers_of, to_onnx
    from locagen_edge.lab.nets.mlp import mlp
    from locagen_edge.lab.settings import MlpSettings

    torch.manual_seed(3)
    model = mlp(3, MlpSettings(width=32))
    content = to_onnx(model, torch.zeros(1, 3), "delays", "direction")
    assert content == to_onnx(model, torch.zeros(1, 3), "delays", "direction")
    assert b"stack_trace" not in content
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3)).astype(np.float32)
    with torch.no_grad():
        wanted = model(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(answers_of(content, x), wanted, atol=1e-5)


def test_onnxruntime_writes_nothing_and_starts_no_thread(tmp_path):
    """Its telemetry, on by default from 1.30, leaves a device id below the home folder."""
    script = (
        "import os, threading\n"
        "from locagen_edge.models import load_model\n"
        "from locagen_edge.settings import Settings\n"
        "import numpy as np\n"
        f"load_model({NAME!r}, Settings())(np.zeros((1, 3), np.float32))\n"
        "print(threading.active_count(), len(os.listdir('/proc/self/task')))\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY"}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "c"), "PYTHONPATH": str(ROOT)}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # numpy's own threads
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.rglob("*")) == []
    assert done.stdout.split() == ["1", "1"]
