"""A network trained on the digital twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from locagen_edge.models import load_model
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import Estimator
from locagen_edge.stages.bearing.far_field import far_field
from locagen_edge.types import Bearing, Tdoa


def learned(settings: Settings) -> Estimator:
    """An ONNX model from normalised delays c tau / d (1, pairs) to the azimuth's (cos, sin) (1, 2).

    What it does not give, elevation and sigmas, is the far field's.
    """
    name = settings.bearing.estimator
    model = load_model(name.removeprefix("model:"), settings)
    scale = settings.speed_m_s / settings.mic_array.spacing_m
    plane_wave = far_field(settings, name)

    def estimate(tdoa: Tdoa) -> Bearing:
        bearing = plane_wave(tdoa)
        if bearing.azimuth_rad is None or not np.isfinite(tdoa.delay_s).all():
            return bearing
        ((cosine, sine),) = model((tdoa.delay_s * scale)[None].astype(np.float32))[0]
        return replace(bearing, azimuth_rad=math.atan2(sine, cosine))

    return estimate
