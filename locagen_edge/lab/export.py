"""From a torch module to an installed model: ONNX file, hash and tensors in the manifest, a card.

The file, the manifest and the card are each written to a temporary name and renamed, the manifest last, so
that a reader finds either the old model or the new one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from locagen_edge.files import write
from locagen_edge.models import MANIFEST
from locagen_edge.types import F32

OPSET = 18
TYPES = {onnx.TensorProto.FLOAT: "tensor(float)"}


def to_onnx(module: torch.nn.Module, example: torch.Tensor, input_name: str, output_name: str) -> bytes:
    """The module as an ONNX file for tensors of the example's very shape. Same module, same bytes."""
    return to_onnx_with_states(module, (example,), [input_name], [output_name])


def to_onnx_with_states(
    module: torch.nn.Module,
    examples: tuple[torch.Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    open_dimensions: Any = None,
) -> bytes:
    """The same for a module of several tensors. `open_dimensions`: as torch's `dynamic_shapes`."""
    # torchvision's absence is reported at every export; the warning concerns torch's own pytree
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        program = torch.onnx.export(
            module.eval(),
            examples,
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
            dynamic_shapes=open_dimensions,
        )
    assert program is not None
    proto = program.model_proto
    for part in [proto, proto.graph, *proto.graph.node, *proto.graph.input, *proto.graph.output]:
        part.ClearField("metadata_props")  # source paths of this machine
    for value in [*proto.graph.value_info, *proto.graph.initializer]:
        value.ClearField("metadata_props")
    onnx.checker.check_model(proto, full_check=True)
    content: bytes = proto.SerializeToString(deterministic=True)
    return content


def install(name: str, content: bytes, positions_m: np.ndarray | None, card: str, directory: Path) -> None:
    """Puts a model into the directory and its manifest: file, sha256, tensors, array (None: any), card."""
    graph = onnx.load_model_from_string(content).graph
    path = directory / MANIFEST
    manifest: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"models": {}}
    manifest["models"][name] = {
        "file": f"{name}.onnx",
        "sha256": hashlib.sha256(content).hexdigest(),
        "inputs": [_tensor(value) for value in graph.input],
        "outputs": [_tensor(value) for value in graph.output],
        "array_m": None if positions_m is None else np.round(positions_m, 6).tolist(),
        "card": f"{name}.md",
    }
    write(directory / f"{name}.onnx", content)
    write(directory / f"{name}.md", card)
    write(path, json.dumps(manifest, indent=2) + "\n")


def answers_of(content: bytes, x: F32) -> F32:
    """What the file answers (n, outputs) to inputs (n, ...), one by one as in flight."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (given,) = session.get_inputs()
    answers: F32 = np.concatenate([session.run(None, {given.name: row[None]})[0] for row in x])
    return answers


def _tensor(value: Any) -> dict[str, Any]:
    tensor = value.type.tensor_type
    return {
        "name": value.name,
        "type": TYPES[tensor.elem_type],
        "shape": [d.dim_param or d.dim_value for d in tensor.shape.dim],
    }
