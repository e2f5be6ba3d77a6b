"""The steered estimator, corrected by a network that has seen the twin's echoes, wind and rotors.

The network sees the score map round the estimate and answers in units of the estimate's own sigmas: what those
know of positions and noise it keeps. What it was worth, disturbance by disturbance: `docs/refined.md`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from locagen_edge.errors import ModelError
from locagen_edge.geometry import wrap
from locagen_edge.models import load_model
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import LARGEST_AZIMUTH_SIGMA_RAD, NOWHERE_RAD
from locagen_edge.stages.bearing.steered import SteeredLocator
from locagen_edge.types import F32, Bearing, Frame, Tdoa

PREFIX = "steered+"
TOLD = 6
"""Features beside the map."""
FARTHEST = 30.0
"""Sigmas: no correction goes further, nor do sigmas change by more than e to the `WIDEST`."""
WIDEST = 3.0


def features(azimuth_axis: F32, scores: F32, bearing: Bearing) -> F32:
    """(rows * columns + TOLD,): the map over its top, the estimate in its middle column, and the estimate.

    `azimuth_axis` (columns,) and `scores` (rows, columns) as the kernel has them; the bearing has both angles.
    """
    assert bearing.azimuth_rad is not None and bearing.elevation_rad is not None
    columns = scores.shape[1]
    top = max(float(scores.max()), 1e-6)
    at = (bearing.azimuth_rad - float(azimuth_axis[0])) * columns / (2.0 * math.pi)
    turned = np.roll(scores / top, columns // 2 - round(at), axis=1)
    told = [
        at - round(at),
        bearing.elevation_rad,
        math.log(top),
        math.log(bearing.azimuth_sigma_rad),
        math.log(bearing.elevation_sigma_rad),
        float(bearing.span_s > 0.0),
    ]
    return np.concatenate([turned.ravel(), told]).astype(np.float32)


class RefinedLocator:
    """`steered`, with the strongest caller's direction and sigmas corrected. One per stream.

    Raises `ModelError` where the model is not for this array, rate or band.
    """

    def __init__(self, settings: Settings):
        self._name = settings.bearing.estimator
        self._steered = SteeredLocator(settings)
        name = self._name.removeprefix(PREFIX)
        self._model = load_model(name, settings)
        rows, columns = self._steered.shape
        self._floor = self._steered.elevations[0], self._steered.elevations[1]
        try:
            (answer,) = self._model(np.zeros((1, rows * columns + TOLD), np.float32))
        except Exception as error:  # onnxruntime raises a class of its own
            raise ModelError(
                f"model {name}: was trained for another audio.rate_hz, correlation.band_hz or array than these "
                f"settings', whose score map is {rows} x {columns}: train it for them, or use `steered`"
            ) from error
        if answer.shape != (1, 4):
            raise ModelError(f"model {name}: answers {answer.shape}, which is no correction of `steered`")

    def __call__(self, frame: Frame, tdoa: Tdoa, elapsed_s: float, /) -> tuple[Bearing, ...]:
        first, *others = self._steered(frame, tdoa, elapsed_s)
        # the network has only ever seen the strongest one in the middle
        return tuple(replace(b, estimator=self._name) for b in (self._refined(first), *others))

    def settle(self, call: bool, /) -> None:
        self._steered.settle(call)

    def _refined(self, bearing: Bearing) -> Bearing:
        if bearing.azimuth_rad is None or bearing.elevation_rad is None:
            return bearing
        (answer,) = self._model(features(*self._steered.scores(bearing), bearing)[None])[0]
        if not np.isfinite(answer).all():
            return bearing
        azimuth, elevation = np.clip(answer[:2], -FARTHEST, FARTHEST).tolist()
        wider = np.exp(np.clip(answer[2:], -WIDEST, WIDEST)).tolist()
        azimuth_sigma = bearing.azimuth_sigma_rad * wider[0]
        low, high = self._floor
        return replace(
            bearing,
            azimuth_rad=(
                wrap(bearing.azimuth_rad + azimuth * bearing.azimuth_sigma_rad)
                if azimuth_sigma < LARGEST_AZIMUTH_SIGMA_RAD
                else None
            ),
            azimuth_sigma_rad=min(azimuth_sigma, NOWHERE_RAD),
            elevation_rad=min(
                max(bearing.elevation_rad + elevation * bearing.elevation_sigma_rad, low), high
            ),
            elevation_sigma_rad=min(bearing.elevation_sigma_rad * wider[1], NOWHERE_RAD),
        )
