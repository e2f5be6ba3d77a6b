"""Every method by its name: trained on a draw of the twin, then asked for azimuths, and exported.

A new method is a maker and a line in the table. The makers take `Arrivals`, whatever made them: delays that
were measured on sound (filtered or not) train the same models by the same names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from locagen_edge.errors import ModelError
from locagen_edge.lab.export import to_onnx
from locagen_edge.lab.features import fit_features, normalised
from locagen_edge.lab.fit import History, Tell, fit, predict, quiet
from locagen_edge.lab.forest import Forest
from locagen_edge.lab.nets.mlp import mlp
from locagen_edge.lab.nets.siren import siren
from locagen_edge.lab.settings import LabSettings, MlpSettings, SirenSettings
from locagen_edge.lab.triangulation import Azimuths
from locagen_edge.sim.arrivals import Arrivals
from locagen_edge.types import F32, F64


@dataclass(frozen=True)
class Trained:
    """A method that has learned."""

    azimuths: Azimuths
    onnx: Callable[[], bytes]
    """the model file: normalised delays of all pairs (1, pairs) to cosine and sine (1, 2)"""
    history: History | None = None
    ties: bool = False
    """whether two angles may be equally good answers, which the last bit tells apart"""


Maker = Callable[[LabSettings, Arrivals, Tell], Trained]


def _forest(bins: int, reading: str) -> Maker:
    def make(s: LabSettings, data: Arrivals, _: Tell) -> Trained:
        array = s.mic_array
        x = normalised(data.delay_s, array, s.speed_m_s)
        features = fit_features(x, array.mics)
        forest = Forest(s.forest, bins, reading).fit(apply(features, x), data.azimuth_rad)

        def azimuths(delay_s: F32) -> F64:
            return forest.predict(apply(features, normalised(delay_s, array, s.speed_m_s)))

        return Trained(
            azimuths, lambda: forest.to_onnx(features, len(array.pairs)), ties=reading in ("median", "centre")
        )

    return make


def _network(
    net: Callable[[int, MlpSettings], torch.nn.Module] | Callable[[int, SirenSettings], torch.nn.Module],
    section: str,
    features_of: Callable[[F32, int], torch.nn.Module] = fit_features,
    **keys: float,
) -> Maker:
    """`keys` are set in the section whatever the settings say."""

    def make(s: LabSettings, data: Arrivals, tell: Tell) -> Trained:
        array, own = s.mic_array, replace(getattr(s, section), **keys)
        x = normalised(data.delay_s, array, s.speed_m_s)
        features = features_of(x, array.mics)
        torch.manual_seed(own.seed)
        seen = apply(features, x)
        model = net(seen.shape[1], own)
        history = fit(model, seen, data.azimuth_rad, own, s.data.validation_share, tell)
        whole = torch.nn.Sequential(features, model)

        def azimuths(delay_s: F32) -> F64:
            return predict(whole, normalised(delay_s, array, s.speed_m_s))

        example = torch.zeros(1, len(array.pairs))
        return Trained(azimuths, lambda: to_onnx(whole, example, "delays", "direction"), history)

    return make


def apply(features: torch.nn.Module, x: F32) -> F32:
    """Features (n, features) of normalised delays (n, pairs)."""
    with torch.no_grad():
        seen: F32 = features(torch.from_numpy(x)).numpy()
    return seen


class Seconds(torch.nn.Module):
    """The base delays in seconds, as they are measured: what a SIREN must not be fed with.

    They are 3e-4 at most, a sine's slope is constant over that, and at the article's learning rate of 1e-4
    the weights never grow to where it is not: the answer hardly depends on the input, and is 90 degrees off.
    """

    def __init__(self, mics: int, seconds_per_unit: float) -> None:
        super().__init__()
        self.base, self.scale = mics - 1, seconds_per_unit

    def forward(self, delays: torch.Tensor) -> torch.Tensor:
        return delays[:, : self.base] * self.scale


def _as_they_are(_: F32, __: int) -> torch.nn.Module:
    return torch.nn.Identity()


def _in_seconds(_: F32, mics: int) -> torch.nn.Module:
    return Seconds(mics, 0.1 / 343.0)  # a share of 1 is the longest delay of 10 cm


METHODS: dict[str, Maker] = {
    "forest-12": _forest(12, "centre"),
    "forest-12-mean": _forest(12, "mean"),
    "forest-12-median": _forest(12, "median"),
    "forest-24": _forest(24, "centre"),
    "forest-24-mean": _forest(24, "mean"),
    "forest-24-median": _forest(24, "median"),
    "forest": _forest(0, "mean"),
    "mlp": _network(mlp, "mlp"),
    "mlp-pairs": _network(mlp, "mlp", _as_they_are),
    "siren": _network(siren, "siren"),
    "siren-unscaled": _network(
        siren, "siren", _in_seconds, omega=1.0, omega_hidden=1.0, rate=1e-4, epochs=20
    ),
}
"""The paper's; beside its classifiers the forest that regresses cosine and sine, and beside its MLP the one
on the delays of all pairs as they are: the ratio goes through infinity at two azimuths, which whole-sample
delays never meet and sub-sample ones do."""


def train(name: str, s: LabSettings, data: Arrivals, tell: Tell = quiet) -> Trained:
    """The method of this name, trained. Raises `ModelError` for a name that is not in the table."""
    if name not in METHODS:
        raise ModelError(f"method {name}: is unknown; there are {', '.join(METHODS)}")
    return METHODS[name](s, data, tell)


def take(data: Arrivals, rows: Any) -> Arrivals:
    """Some of the samples, by a slice or a mask."""
    return Arrivals(
        data.delay_s[:, rows], data.true_delay_s[:, rows], data.position_m[:, rows], data.azimuth_rad[rows]
    )


def split(data: Arrivals, share: float) -> tuple[Arrivals, Arrivals]:
    """The first `share` to train on, and the rest. Draws are independent, so no shuffling is needed."""
    count = int(len(data.azimuth_rad) * share)
    return take(data, slice(0, count)), take(data, slice(count, None))
