"""Tdoa, or Frame itself -> Bearing, by an estimator chosen by name.

    far-field    least squares for a plane wave over all pairs
    hyperbolic   the paper's: the position that explains the delays against the base microphone
    two-mic      arcsin(c tau / d) of the first pair
    model:NAME   a learned one, ONNX
    steered      greatest likelihood over directions, whitened by the noise's own matrix

All but the last are functions from Tdoa to Bearing, made once for an array: a new one is a maker of such a
function and a line in the table.
"""

from __future__ import annotations

from collections.abc import Callable

from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import Estimator, Locator, OnDelays
from locagen_edge.stages.bearing.far_field import far_field
from locagen_edge.stages.bearing.hyperbolic import hyperbolic
from locagen_edge.stages.bearing.learned import learned
from locagen_edge.stages.bearing.steered import SteeredLocator
from locagen_edge.stages.bearing.two_mic import two_mic

ESTIMATORS: dict[str, Callable[[Settings], Estimator]] = {
    "far-field": far_field,
    "hyperbolic": hyperbolic,
    "two-mic": two_mic,
    "model": learned,
}


def make_estimator(settings: Settings) -> Estimator:
    """The estimator on delays that `bearing.estimator` names. Raises `ModelError` for an unfit model."""
    return ESTIMATORS[settings.bearing.estimator.partition(":")[0]](settings)


def make_locator(settings: Settings) -> Locator:
    """What `bearing.estimator` names, ready for frames. Raises like `make_estimator`."""
    if settings.bearing.estimator == "steered":
        return SteeredLocator(settings)
    return OnDelays(make_estimator(settings))
