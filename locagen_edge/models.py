"""An ONNX model by name: file, hash, tensor names, shapes and array checked before it may fly.

`models/manifest.json` lists every model. A model is refused, by name and reason, where its bytes are not
those of the manifest, its tensors are not those the manifest states, or it was trained for another array.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import ModelError
from locagen_edge.settings import Settings
from locagen_edge.types import F32

MANIFEST = "manifest.json"

Model = Callable[[F32], list[F32]]
"""Input array in, list of output arrays out."""


def directory_of(settings: Settings) -> Path:
    """Where the models lie: `models.directory`, or those that came with the program."""
    return Path(settings.models.directory) if settings.models.directory else default_directory()


def default_directory() -> Path:
    """Where the models that came with the program lie: beside the checkout, or below the prefix."""
    beside = Path(__file__).resolve().parent.parent / "models"
    return beside if (beside / MANIFEST).is_file() else Path(sys.prefix) / "share" / "locagen-edge" / "models"


def read_manifest(directory: Path) -> dict[str, Any]:
    """Entries by model name. Raises `ModelError` where the manifest is missing or unreadable."""
    path = directory / MANIFEST
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["models"]
    except OSError as error:
        raise ModelError(f"models: {path}: {error.strerror}; set models.directory") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"models: {path}: is not a manifest of models") from error
    if not isinstance(entries, dict):
        raise ModelError(f"models: {path}: `models` has to be a table of names")
    return entries


class Network:
    """A checked model with states: what it says of a stream depends on what came before.

    Its first output is the answer, the others are the states to give back with the next inputs.
    """

    def __init__(self, session: Any, entry: dict[str, Any]) -> None:
        self._session = session
        self._names = [tensor["name"] for tensor in entry["inputs"]]
        self._shapes = [tensor["shape"] for tensor in entry["inputs"]]
        self._states = len(entry["outputs"]) - 1

    def zeros(self, **dimensions: int) -> list[F32]:
        """The states before anything was heard; `dimensions`: sizes that the file leaves open, by name."""
        return [
            np.zeros([dimensions.get(d, 1) if isinstance(d, str) else d for d in shape], dtype=np.float32)
            for shape in self._shapes[len(self._shapes) - self._states :]
        ]

    def __call__(self, inputs: Sequence[F32]) -> list[F32]:
        """The answer and the next states, in the order of the manifest."""
        outputs: list[F32] = self._session.run(None, dict(zip(self._names, inputs, strict=True)))
        return outputs


def load_model(name: str, settings: Settings) -> Model:
    """A checked model with one input, ready to call. Raises `ModelError`, naming the model and the reason."""
    session, entry = _open(name, settings)
    names = [entry["inputs"][0]["name"]]

    def call(x: F32) -> list[F32]:
        outputs: list[F32] = session.run(None, {names[0]: x})
        return outputs

    return call


def load_network(name: str, settings: Settings) -> Network:
    """A checked model with states. Raises `ModelError`, naming the model and the reason."""
    return Network(*_open(name, settings))


def _open(name: str, settings: Settings) -> tuple[Any, dict[str, Any]]:
    directory = directory_of(settings)
    entries = read_manifest(directory)
    if name not in entries:
        raise ModelError(
            f"model {name}: is not in {directory / MANIFEST}; there are {', '.join(sorted(entries))}"
        )
    entry = entries[name]
    if not isinstance(entry, dict):
        raise ModelError(f"model {name}: its entry in {directory / MANIFEST} is not a table")
    try:
        content = (directory / entry["file"]).read_bytes()
        _check_hash(name, content, entry["sha256"])
        _check_array(name, entry["array_m"], settings)
        session = _session(content)
        _check_tensors(name, "input", session.get_inputs(), entry["inputs"])
        _check_tensors(name, "output", session.get_outputs(), entry["outputs"])
    except OSError as error:
        raise ModelError(f"model {name}: {error.filename}: {error.strerror}") from error
    except KeyError as error:
        raise ModelError(f"model {name}: the manifest does not say {error}") from error
    except ModelError:
        raise
    except Exception as error:  # onnxruntime raises a class of its own for each kind of broken file
        raise ModelError(f"model {name}: {entry.get('file')} cannot be loaded: {error}") from error
    return session, entry


def _check_hash(name: str, content: bytes, wanted: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != wanted:
        raise ModelError(
            f"model {name}: the file is not the one of the manifest "
            f"(sha256 {found[:12]}..., expected {wanted[:12]}...); install both together again"
        )


def _check_array(name: str, positions_m: Any, settings: Settings) -> None:
    """Only the shape counts: where the array sits, and 1 mm, do not matter to delays. None: any array."""
    if positions_m is None:
        return
    wanted = np.asarray(positions_m, dtype=np.float64)
    here = settings.mic_array.positions_m
    same = wanted.shape == here.shape and np.allclose(wanted - wanted[0], here - here[0], atol=1e-3)
    if not same:
        raise ModelError(
            f"model {name}: was trained for another array than array.positions_m with array.mount_deg; "
            "train it for this one, or choose another bearing.estimator"
        )


def _check_tensors(name: str, kind: str, found: list[Any], stated: list[dict[str, Any]]) -> None:
    have = [{"name": t.name, "type": t.type, "shape": list(t.shape)} for t in found]
    if have != stated:
        raise ModelError(f"model {name}: {kind}s are {have}, the manifest states {stated}")


def _session(content: bytes) -> Any:
    """One thread, no arena that grows, and no telemetry: it has to be off before the import.

    onnxruntime 1.30 and later otherwise writes a device id below the home folder and starts a thread.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False
    options.log_severity_level = 3  # errors: what is wrong reaches the user as a ModelError
    return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
