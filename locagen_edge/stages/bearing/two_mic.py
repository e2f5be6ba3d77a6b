"""The angle from broadside of one pair."""

from __future__ import annotations

import math

from locagen_edge.geometry import NOWHERE_RAD, wrap
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing.common import DelayModel, Estimator, no_bearing
from locagen_edge.types import Bearing, Tdoa


def two_mic(settings: Settings) -> Estimator:
    """arcsin(c tau / d) of the first pair: the angle from broadside, towards the microphone heard first.

    One pair cannot tell a source from its mirror image behind the pair; the answer is the one on the side
    of the pair that looks ahead (or right, where the pair itself points ahead), on the horizon.
    """
    model = DelayModel.of(settings)
    baseline = model.array.baselines_m[0]
    spacing = math.hypot(baseline[0], baseline[1])  # a source on the horizon does not see a pair's tilt
    along = math.atan2(baseline[1], baseline[0])
    sides = (wrap(along - math.pi / 2), wrap(along + math.pi / 2))
    # cos, then sin with a nudge: ahead wins, and of left and right the right
    broadside = max(sides, key=lambda side: (round(math.cos(side), 9), math.sin(side)))
    clockwise = math.copysign(1.0, math.sin(wrap(along - broadside)))

    def estimate(tdoa: Tdoa) -> Bearing:
        if not math.isfinite(tdoa.delay_s[0]):
            return no_bearing("two-mic")
        sine = float(tdoa.delay_s[0]) * model.speed_m_s / spacing
        sigma = float(model.sigma_s(tdoa)[0]) * model.speed_m_s / spacing
        angle = math.asin(min(max(sine, -1.0), 1.0))
        angle_sigma = sigma / max(math.cos(angle), math.sqrt(sigma))
        return Bearing(
            azimuth_rad=wrap(broadside + clockwise * angle),
            azimuth_sigma_rad=min(angle_sigma, NOWHERE_RAD),
            elevation_rad=None,
            elevation_sigma_rad=NOWHERE_RAD,
            misfit=max(abs(sine) - 1.0, 0.0) / sigma,
            estimator="two-mic",
        )

    return estimate
