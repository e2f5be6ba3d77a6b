"""Random forests: the paper's classifiers of azimuth bins, the regression that bins stand in for, and ONNX.

A classifier gives the probability of each bin, and its mean error depends on how an angle is read from them:

    centre   the middle of the likeliest bin: the paper's; half a bin is lost where bins are finer than cells
    mean     the mean direction of all bins, each with its probability
    median   the angle of smallest mean |error|, each bin's probability spread evenly over it

The ONNX file is written here, tree by tree. scikit-learn compares single-precision features with thresholds
in double precision; a threshold rounded down to single precision decides alike for every feature, where one
rounded to nearest, as converters do it, sends some to the other side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from sklearn.ensemble import RandomForestClassifier, RandomForestRegressor

from locagen_edge.lab.export import to_onnx
from locagen_edge.lab.features import Features
from locagen_edge.lab.settings import ForestSettings
from locagen_edge.types import F32, F64

READINGS = ("centre", "mean", "median")
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

    def read_as(self, reading: str) -> Forest:
        """The same trees with another way to read an angle."""
        other = Forest(self._settings, self.bins, reading)
        other._model = self._model
        return other

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
        model = onnx.load_model_from_string(to_onnx(features, torch.zeros(1, pairs), "delays", "features"))
        graph, last = model.graph, model.graph.output[0].name
        values = [_leaf_values(tree, self.bins) for tree in self._model.estimators_]
        if self.bins and self.reading == "mean":
            values = [value @ _directions(self._centres) for value in values]
        graph.node.append(_ensemble(self._model.estimators_, values, last, "values"))
        steps: dict[str, list[onnx.NodeProto]] = {
            "mean": [helper.make_node("Identity", ["values"], ["direction"])],
            "centre": [
                helper.make_node("ArgMax", ["values"], ["at"], axis=1, keepdims=0),
                helper.make_node("Gather", ["directions", "at"], ["direction"], axis=0),
            ],
            "median": [
                helper.make_node("MatMul", ["values", "cost"], ["costs"]),
                helper.make_node("ArgMin", ["costs"], ["at"], axis=1, keepdims=0),
                helper.make_node("Gather", ["directions", "at"], ["direction"], axis=0),
            ],
        }
        reading = self.reading if self.bins else "mean"
        graph.node.extend(steps[reading])
        if reading == "median":
            graph.initializer.append(numpy_helper.from_array(self._cost().astype(np.float32), "cost"))
        if reading != "mean":
            angles = self._centres if reading == "centre" else _candidates()
            table = _directions(angles).astype(np.float32)
            graph.initializer.append(numpy_helper.from_array(table, "directions"))
        del graph.output[:]
        graph.output.append(helper.make_tensor_value_info("direction", TensorProto.FLOAT, [1, 2]))
        model.opset_import.append(helper.make_opsetid("ai.onnx.ml", 3))
        onnx.checker.check_model(model, full_check=True)
        content: bytes = model.SerializeToString(deterministic=True)
        return content


def _directions(azimuth_rad: F64) -> F64:
    return np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)


def _candidates() -> F64:
    return np.arange(CANDIDATES, dtype=np.float64) * (2.0 * np.pi / CANDIDATES)


def _leaf_values(tree: Any, bins: int) -> F64:
    """(nodes, outputs) what each node of a fitted tree would answer."""
    value = tree.tree_.value
    counts: F64 = value[:, 0, :] if bins else value[:, :, 0]
    return counts / counts.sum(axis=1, keepdims=True) if bins else counts


def _ensemble(trees: list[Any], values: list[F64], source: str, target: str) -> onnx.NodeProto:
    """The mean of all trees as one node: arrays over all nodes of all trees."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("tree", "node", "mode", "feature", "at")}
    parts |= {name: [] for name in ("yes", "no", "leaf_tree", "leaf_node", "leaf_output", "leaf_value")}
    for number, (fitted, value) in enumerate(zip(trees, values, strict=True)):
        tree = fitted.tree_
        leaf = tree.children_left < 0
        parts["tree"].append(np.full(tree.node_count, number))
        parts["node"].append(np.arange(tree.node_count))
        parts["mode"].append(leaf)
        parts["feature"].append(np.where(leaf, 0, tree.feature))
        parts["at"].append(np.where(leaf, 0.0, _rounded_down(tree.threshold)))
        parts["yes"].append(np.where(leaf, 0, tree.children_left))
        parts["no"].append(np.where(leaf, 0, tree.children_right))
        (where,) = leaf.nonzero()
        outputs = value.shape[1]
        parts["leaf_tree"].append(np.full(len(where) * outputs, number))
        parts["leaf_node"].append(np.repeat(where, outputs))
        parts["leaf_output"].append(np.tile(np.arange(outputs), len(where)))
        parts["leaf_value"].append((value[where] / len(trees)).ravel())
    flat = {name: np.concatenate(arrays).tolist() for name, arrays in parts.items()}
    return helper.make_node(
        "TreeEnsembleRegressor",
        [source],
        [target],
        domain="ai.onnx.ml",
        n_targets=values[0].shape[1],
        aggregate_function="SUM",
        nodes_treeids=flat["tree"],
        nodes_nodeids=flat["node"],
        nodes_modes=["LEAF" if leaf else "BRANCH_LEQ" for leaf in flat["mode"]],
        nodes_featureids=flat["feature"],
        nodes_values=flat["at"],
        nodes_truenodeids=flat["yes"],
        nodes_falsenodeids=flat["no"],
        target_treeids=flat["leaf_tree"],
        target_nodeids=flat["leaf_node"],
        target_ids=flat["leaf_output"],
        target_weights=flat["leaf_value"],
    )


def _rounded_down(threshold: F64) -> F32:
    """The largest single-precision number not above each threshold."""
    single = threshold.astype(np.float32)
    above = single > threshold
    return np.where(above, np.nextafter(single, np.float32(-np.inf)), single).astype(np.float32)
