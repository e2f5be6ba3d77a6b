"""Random forests: the paper's classifiers of azimuth bins, the regression that bins stand in for, and ONNX.

A classifier gives the probability of each bin, and its mean error depends on how an angle is read from them:

    centre   the middle of the likeliest bin: the paper's; half a bin is lost where bins are finer than cells
    mean     the mean direction of all bins, each with its probability
    median   the angle of smallest mean |error|, each bin's probability spread evenly over it

The ONNX file is the features' graph, skl2onnx's trees and the reading, joined. scikit-learn compares
single-precision features with thresholds in double precision; skl2onnx moves each threshold to the single
precision number that decides alike, so trees answer the same even for features right on a threshold.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, compose, helper, numpy_helper
from skl2onnx import convert_sklearn
from skl2onnx.common.data_types import FloatTensorType
from sklearn.ensemble import RandomForestClassifier, RandomForestRegressor

from locagen_edge.lab.export import OPSET, to_onnx
from locagen_edge.lab.features import Features
from locagen_edge.lab.settings import ForestSettings
from locagen_edge.types import F32, F64

OPSETS = {"": OPSET, "ai.onnx.ml": 1}
CANDIDATES = 1440
"""Angles among which the median is looked for: a quarter of a degree apart, 0.06 degrees of error at most."""


class Forest:
    """A trained forest from features to the azimuth; `bins` 0 is the regression of cosine and sine."""

    def __init__(self, s: ForestSettings, bins: int, reading: str = "mean") -> None:
        self.bins, self.reading = bins, reading
        self._first = np.radians(s.bins_deg)
        self._settings = s
        self._model: Any = None

    def fit(self, x: F32, azimuth_rad: F32) -> Forest:
        """Trains on features (n, features) and azimuths (n,)."""
        s = self._settings
        kind = RandomForestClassifier if self.bins else RandomForestRegressor
        self._model = kind(
            s.trees,
            min_samples_leaf=s.leaf,
            max_depth=s.depth,
            max_samples=min(1.0, s.samples_per_tree / len(x)),
            random_state=s.seed,
            n_jobs=2,
        )
        directions = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
        self._model.fit(x, self._bin(azimuth_rad) if self.bins else directions)
        return self

    def predict(self, x: F32) -> F64:
        """Azimuths (n,) for features (n, features), radians."""
        values = self._model.predict_proba(x) if self.bins else self._model.predict(x)
        y = self._read(values) if self.bins else values
        azimuth: F64 = np.arctan2(y[:, 1], y[:, 0])
        return azimuth

    def _bin(self, azimuth_rad: F32) -> np.ndarray:
        turns = (azimuth_rad.astype(np.float64) - self._first) / (2.0 * np.pi) % 1.0
        bins: np.ndarray = np.minimum((turns * self.bins).astype(np.int64), self.bins - 1)
        return bins

    @property
    def _centres(self) -> F64:
        """(classes,) of the bins that the training data had, radians."""
        centres: F64 = self._first + (self._model.classes_ + 0.5) * (2.0 * np.pi / self.bins)
        return centres

    def _read(self, probability: F64) -> F64:
        """Cosine and sine (n, 2) from probabilities (n, classes)."""
        if self.reading == "mean":
            mean: F64 = probability @ _directions(self._centres)
            return mean
        if self.reading == "centre":
            likeliest: F64 = _directions(self._centres)[probability.argmax(axis=1)]
            return likeliest
        median: F64 = _directions(_candidates())[(probability @ self._cost()).argmin(axis=1)]
        return median

    def _cost(self) -> F64:
        """(classes, candidates) mean |error| of each candidate for azimuths spread evenly over each bin."""
        half = np.pi / self.bins
        off = np.abs(np.angle(np.exp(1j * (self._centres[:, None] - _candidates()))))
        # outside the bin the distance to its middle; inside it, and opposite, the mean of the two sides
        inside = (half**2 + off**2) / (2.0 * half)
        opposite = np.pi - (half**2 + (np.pi - off) ** 2) / (2.0 * half)
        cost: F64 = np.where(off < half, inside, np.where(off > np.pi - half, opposite, off))
        return cost

    def to_onnx(self, features: Features, pairs: int) -> bytes:
        """Normalised delays (1, pairs) to cosine and sine (1, 2)."""
        seen = onnx.load_model_from_string(to_onnx(features, torch.zeros(1, pairs), "delays", "features"))
        trees = self._trees(features.size)
        trees.ir_version = seen.ir_version
        io_map = [(seen.graph.output[0].name, trees.graph.input[0].name)]
        model = compose.merge_models(seen, trees, io_map, prefix2="forest_")
        graph = model.graph
        values = graph.output[-1].name
        reading = self.reading if self.bins else "regression"
        steps: dict[str, list[onnx.NodeProto]] = {
            "regression": [helper.make_node("Identity", [values], ["direction"])],
            "mean": [helper.make_node("MatMul", [values, "directions"], ["direction"])],
            "centre": [
                helper.make_node("ArgMax", [values], ["at"], axis=1, keepdims=0),
                helper.make_node("Gather", ["directions", "at"], ["direction"], axis=0),
            ],
            "median": [
                helper.make_node("MatMul", [values, "cost"], ["costs"]),
                helper.make_node("ArgMin", ["costs"], ["at"], axis=1, keepdims=0),
                helper.make_node("Gather", ["directions", "at"], ["direction"], axis=0),
            ],
        }
        graph.node.extend(steps[reading])
        if reading == "median":
            graph.initializer.append(numpy_helper.from_array(self._cost().astype(np.float32), "cost"))
        if reading != "regression":
            angles = _candidates() if reading == "median" else self._centres
            table = _directions(angles).astype(np.float32)
            graph.initializer.append(numpy_helper.from_array(table, "directions"))
        del graph.output[:]
        graph.output.append(helper.make_tensor_value_info("direction", TensorProto.FLOAT, [1, 2]))
        del model.opset_import[:]
        model.opset_import.extend(helper.make_opsetid(*opset) for opset in OPSETS.items())
        onnx.checker.check_model(model, full_check=True)
        content: bytes = model.SerializeToString(deterministic=True)
        return content

    def _trees(self, inputs: int) -> onnx.ModelProto:
        """The forest alone: features (1, inputs) to probabilities (1, bins) or directions (1, 2)."""
        model: onnx.ModelProto = convert_sklearn(
            self._model,
            name="forest",  # else one drawn at random: same trees, same bytes
            initial_types=[("features", FloatTensorType([1, inputs]))],
            options={"zipmap": False} if self.bins else None,
            target_opset=OPSETS,
        )
        outputs = len(self._model.classes_) if self.bins else 2
        last = model.graph.output[-1]  # of a regression with two targets it is stated to have one
        last.CopyFrom(helper.make_tensor_value_info(last.name, TensorProto.FLOAT, [1, outputs]))
        return model


def _directions(azimuth_rad: F64) -> F64:
    return np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)


def _candidates() -> F64:
    return np.arange(CANDIDATES, dtype=np.float64) * (2.0 * np.pi / CANDIDATES)
