"""Tdoa -> Bearing, by an estimator chosen by name from one table.

    far-field    least squares for a plane wave over all pairs
    hyperbolic   the paper's: the position that explains the delays against the base microphone
    two-mic      arcsin(c tau / d) of the first pair
    model:NAME   a learned one, ONNX

An estimator is a function from Tdoa to Bearing, made once for an array. A new one is a maker of such a
function and a line in the table.
"""

from __future__ import annotations

from collections.abc import Callable

from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import Estimator
from locagen_edge.stages.bearing.far_field import far_field
from locagen_edge.stages.bearing.hyperbolic import hyperbolic
from locagen_edge.stages.bearing.learned import learned
from locagen_edge.stages.bearing.two_mic import two_mic

ESTIMATORS: dict[str, Callable[[Settings], Estimator]] = {
    "far-field": far_field,
    "hyperbolic": hyperbolic,
    "two-mic": two_mic,
    "model": learned,
}


def make_estimator(settings: Settings) -> Estimator:
    """The estimator that `bearing.estimator` names. Raises `ModelError` where its model is unfit."""
    return ESTIMATORS[settings.bearing.estimator.partition(":")[0]](settings)
