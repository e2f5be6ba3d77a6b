"""The paper's experiments, each a function from settings to plain numbers that JSON can hold.

All methods of one table learn from one draw and are asked about another, larger one; the best possible stands
beside them, from a third. Errors are |azimuth error|; a method without an answer counts as a guess, 90
degrees.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.lab.anova import two_way
from locagen_edge.lab.bound import best_table, errors_rad, look_up
from locagen_edge.lab.export import install
from locagen_edge.lab.methods import METHODS, split, take, train
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.sound import HELD_OUT, from_waveforms
from locagen_edge.lab.triangulation import Azimuths, fixed_start, flight, least_squares, over_cells
from locagen_edge.lab.twin import at_rate, sample, with_spacing, with_twin
from locagen_edge.sim.arrivals import Arrivals
from locagen_edge.stages.bearing import make_estimator
from locagen_edge.stages.bearing.hyperbolic import hyperbolic
from locagen_edge.types import F64, Tdoa

PAPER: dict[str, Any] = {
    "mae_deg": {
        "10000": {"forest-12": 13.16, "forest-24": 14.36, "mlp": 13.38, "siren": 90.0},
        "48000": {"mlp": 2.87},
    },
    "less_than_triangulation": 0.67,
    "distinct_angles": 12,
    "offset_p": [0.266, 0.185],
}
"""Figures of Kunwar, Cantor, Rizzo & Qayyum; the SIREN's is told as "about 90 degrees"."""

SLOW_HZ, FAST_HZ = 10_000, 48_000
"""The paper's two rates."""
START_M = (10.0, 10.0)
"""Where the paper's minimiser is started in the tables of all methods; `assumptions` tries others."""


@dataclass(frozen=True)
class Scale:
    """How much of everything: the full run, or a quick one that only shows that all parts work."""

    samples: int = 100_000_000
    """of [data] at most"""
    held_out: int = 200_000
    table: int = 4_000_000
    rates_hz: tuple[int, ...] = (10_000, 24_000, 44_100, 48_000)
    spacings_m: tuple[float, ...] = (0.02, 0.05, 0.10, 0.20, 0.50, 1.00)
    learning: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
    repeats: int = 100
    """points in each of the 10 x 10 cells of the offset study"""
    calls: int = 300
    """of each estimator when its time is taken"""
    epochs: int = 10_000
    """networks stop here if not before"""
    trees: int = 10_000
    """and forests"""


QUICK = Scale(
    samples=6_000,
    held_out=20_000,
    table=200_000,
    rates_hz=(10_000, 48_000),
    spacings_m=(0.05, 0.10),
    learning=(1_000, 5_000),
    repeats=10,
    calls=20,
    epochs=6,
    trees=10,
)


def reduced(s: LabSettings, scale: Scale) -> LabSettings:
    """The settings with no more trees and passes than the scale allows."""
    return dataclasses.replace(
        s,
        data=dataclasses.replace(s.data, samples=min(s.data.samples, scale.samples)),
        forest=dataclasses.replace(s.forest, trees=min(s.forest.trees, scale.trees)),
        mlp=dataclasses.replace(s.mlp, epochs=min(s.mlp.epochs, scale.epochs)),
        siren=dataclasses.replace(s.siren, epochs=min(s.siren.epochs, scale.epochs)),
    )


def run(
    s: LabSettings, scale: Scale, step: Callable[[str], None], names: Collection[str] = ()
) -> dict[str, Any]:
    """The experiments of these names, none: all; `step` is told the name of each before it begins.

    The result is ready for JSON.
    """
    s = reduced(s, scale)
    result: dict[str, Any] = {"paper": PAPER, "setup": setup(s, scale)}
    for name in names or EXPERIMENTS:
        step(name)
        begin = time.perf_counter()
        result[name] = EXPERIMENTS[name](s, scale)
        result["setup"]["seconds"][name] = round(time.perf_counter() - begin, 1)
    return result


def setup(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """What the figures hold for."""
    return {
        "rate_hz": s.audio.rate_hz,
        "spacing_m": float(s.mic_array.spacing_m.mean()),
        "speed_m_s": s.speed_m_s,
        "twin": dataclasses.asdict(s.twin),
        "data": dataclasses.asdict(s.data),
        "forest": dataclasses.asdict(s.forest),
        "mlp": dataclasses.asdict(s.mlp),
        "siren": dataclasses.asdict(s.siren),
        "held_out": scale.held_out,
        "quick": scale == QUICK,
        "seconds": {},
    }


# --- one table of methods -----------------------------------------------------------------------------


def errors(estimate: F64, true: Any) -> F64:
    """|azimuth error| (n,), radians; a quarter turn where there is no answer."""
    return np.where(np.isnan(estimate), math.pi / 2, errors_rad(np.nan_to_num(estimate), true))


def azimuth_of(answers: Azimuths) -> Azimuths:
    """Of a solver's azimuth, x and y the azimuth alone."""
    return lambda delay_s: answers(delay_s)[0]


def unlearned(s: LabSettings) -> dict[str, Azimuths]:
    """The methods that learn nothing, by name."""
    rate = s.audio.rate_hz
    return {
        "least squares": least_squares(s),
        "hyperbolic": azimuth_of(over_cells(flight(s, hyperbolic(s)), rate)),
        "minimiser": azimuth_of(over_cells(fixed_start(s, START_M), rate)),
    }


@dataclass(frozen=True)
class Draws:
    """What the methods of one table see."""

    train: Arrivals
    test: Arrivals
    """the rest of the paper's 24,000"""
    held_out: Arrivals
    large: Arrivals
    """for the best possible alone"""

    @staticmethod
    def of(s: LabSettings, scale: Scale) -> Draws:
        learned, rest = split(sample(s, s.data.samples, s.data.seed), s.data.train_share)
        held_out, large = (sample(s, n, s.data.seed + k) for k, n in ((1, scale.held_out), (2, scale.table)))
        return Draws(learned, rest, held_out, large)


def best(s: LabSettings, draws: Draws) -> Azimuths:
    """The best answer for each combination of whole-sample delays."""
    rate = s.audio.rate_hz
    table = best_table(draws.large.delay_s, draws.large.azimuth_rad, rate)
    return lambda delay_s: look_up(table, delay_s, rate)


def answers(s: LabSettings, draws: Draws, names: tuple[str, ...]) -> Iterator[tuple[str, Azimuths]]:
    """Every method ready to be asked: the best possible, those that learn nothing, then `names`."""
    yield "best possible", best(s, draws)
    yield from unlearned(s).items()
    for name in names:
        yield name, over_cells(train(name, s, draws.train).azimuths, s.audio.rate_hz)


def table(s: LabSettings, scale: Scale, names: tuple[str, ...]) -> dict[str, Any]:
    """MAE of every method: on the held-out draw, and on the paper's own 20 %."""
    draws = Draws.of(s, scale)
    row = {}
    for name, azimuths in answers(s, draws, names):
        row[name] = {
            "mae_deg": _mean_deg(azimuths, draws.held_out),
            "mae_test_deg": _mean_deg(azimuths, draws.test),
        }
    return row


def _mean_deg(azimuths: Azimuths, data: Arrivals) -> float:
    return math.degrees(float(errors(azimuths(data.delay_s), data.azimuth_rad).mean()))


# --- the experiments ----------------------------------------------------------------------------------

SWEPT = ("forest", "mlp", "siren")
"""Methods of the longer sweeps."""


def by_rate(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """MAE of every method at every sample rate."""
    return {str(rate): table(at_rate(s, rate), scale, tuple(METHODS)) for rate in scale.rates_hz}


def by_spacing(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """MAE at every side of the triangle, at the settings' rate."""
    return {f"{d:g}": table(with_spacing(s, d), scale, SWEPT) for d in scale.spacings_m}


def distribution(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """Errors themselves: a histogram at the settings' rate, and percentiles at 48 kHz."""
    edges = np.arange(0.0, 181.0, 2.0)
    low = Draws.of(s, scale)
    methods = dict(answers(s, low, ("forest-12", "forest")))
    histogram = {}
    for name in ("minimiser", "hyperbolic", "forest-12", "forest"):
        off = np.degrees(errors(methods[name](low.held_out.delay_s), low.held_out.azimuth_rad))
        histogram[name] = (np.histogram(off, edges)[0] / len(off)).tolist()
    high = at_rate(s, FAST_HZ)
    draws = Draws.of(high, scale)
    percent = np.linspace(0.0, 100.0, 201)
    cdf = {}
    for name, azimuths in answers(high, draws, tuple(METHODS)):
        off = np.degrees(errors(azimuths(draws.held_out.delay_s), draws.held_out.azimuth_rad))
        cdf[name] = np.percentile(off, percent).round(4).tolist()
    return {
        "edges_deg": edges.tolist(),
        "histogram": histogram,
        "percent": percent.tolist(),
        "cdf_deg": cdf,
    }


def offsets(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """Does a fixed sampling offset of a microphone matter? 10 x 10 offsets of microphones 1 and 2.

    ANOVA of the error in position, as in the paper, of two solvers, ranges cut at the disc's edge: the
    flight's, and the paper's from a fixed start. And of the flight's error in azimuth.
    """
    levels = np.arange(10) / 10.0
    rate = s.audio.rate_hz
    solvers = {
        "hyperbolic": over_cells(flight(s, hyperbolic(s)), rate),
        "minimiser": over_cells(fixed_start(s, START_M), rate),
    }
    place = {name: np.empty((10, 10, scale.repeats)) for name in solvers}
    angle = np.empty((10, 10, scale.repeats))
    others = (0.0,) * (s.mic_array.mics - 3)
    for a, first in enumerate(levels):
        for b, second in enumerate(levels):
            here = with_twin(s, offset_samples=(0.0, float(first), float(second), *others))
            data = sample(here, scale.repeats, s.data.seed + 3, (10 * a + b) * scale.repeats)
            for name, solve in solvers.items():
                azimuth, *position = solve(data.delay_s)
                range_m = np.maximum(np.hypot(*position), 1e-9)
                near = np.array(position) * np.minimum(1.0, s.twin.range_m / range_m)
                place[name][a, b] = np.hypot(*(np.nan_to_num(near) - data.position_m))
                if name == "hyperbolic":
                    angle[a, b] = np.degrees(errors(azimuth, data.azimuth_rad))
    measured = {f"position, {name}": (y, "m") for name, y in place.items()}
    measured["azimuth"] = (angle, "degrees")
    return {
        "levels_samples": levels.tolist(),
        "points": int(angle.size),
        "errors": {
            name: {"unit": unit, "mean": y.mean(axis=2).tolist(), "sd": float(y.std()), "p": two_way(y)}
            for name, (y, unit) in measured.items()
        },
    }


TIMED = ("mlp", "siren", "forest", "forest-12", "forest-24")


def times(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """Wall-clock time of one estimate, microseconds: each as it flies, one after the other.

    Learned ones are exported, installed and called by name, with all that the flight side does around them.
    """
    rate = s.audio.rate_hz
    learned, rest = split(sample(s, s.data.samples, s.data.seed), s.data.train_share)
    delays = rest.delay_s[:, : scale.calls]
    sigma = np.full(len(delays), 1.0 / (math.sqrt(6.0) * rate))
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        sizes = {}
        for name in TIMED:
            content = train(name, s, learned).onnx()
            sizes[f"model:{name}"] = len(content)
            install(name, content, s.mic_array.positions_m, f"# {name}\n", Path(folder))
        models = dataclasses.replace(s.models, directory=folder)
        for name in ("far-field", "hyperbolic", *(f"model:{name}" for name in TIMED)):
            bearing = dataclasses.replace(s.bearing, estimator=name)
            estimator = make_estimator(dataclasses.replace(s, models=models, bearing=bearing))
            tdoas = [Tdoa(d, sigma, np.ones(len(d))) for d in delays.T.astype(np.float64)]
            found[name] = _times_us([lambda t=t, e=estimator: e(t) for t in tdoas])  # type: ignore[misc]
            found[name]["bytes"] = sizes.get(name)
    minimiser = fixed_start(s, START_M)
    found["minimiser"] = _times_us([lambda k=k: minimiser(delays[:, k : k + 1]) for k in range(scale.calls)])  # type: ignore[misc]
    return found


def _times_us(calls: list[Callable[[], Any]]) -> dict[str, Any]:
    calls[0]()
    taken = []
    for call in calls:
        begin = time.perf_counter()
        call()
        taken.append(1e6 * (time.perf_counter() - begin))
    return {
        "median_us": float(np.median(taken)),
        "p99_us": float(np.percentile(taken, 99)),
        "most_us": max(taken),
    }


def learning(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """MAE at 48 kHz over the number of training samples; at 10 kHz a thousand are enough for all."""
    high = at_rate(s, FAST_HZ)
    draws = Draws.of(high, scale)
    rate = high.audio.rate_hz
    data = sample(high, max(scale.learning), s.data.seed + 4)
    curves: dict[str, list[float]] = {
        "table of cells": [],
        "forest-24": [],
        "forest": [],
        "mlp": [],
        "siren": [],
    }
    for count in scale.learning:
        part = take(data, slice(0, count))
        # as many steps for the largest as for a twentieth of it: they see every sample a few times at least
        passes = max(4, 60 * 50_000 // max(count, 50_000))
        here = reduced(high, dataclasses.replace(scale, epochs=min(scale.epochs, passes)))
        cut = best_table(part.delay_s, part.azimuth_rad, rate)
        methods: dict[str, Azimuths] = {"table of cells": lambda d, t=cut: look_up(t, d, rate)}  # type: ignore[misc]
        for name in ("forest-24", *SWEPT):
            methods[name] = over_cells(train(name, here, part).azimuths, rate)
        for name, azimuths in methods.items():
            curves[name].append(_mean_deg(azimuths, draws.held_out))
    return {
        "samples": list(scale.learning),
        "rate_hz": rate,
        "mae_deg": curves,
        "best_deg": _mean_deg(best(high, draws), draws.held_out),
    }


# --- what the paper leaves open -----------------------------------------------------------------------

ASSUMPTIONS: dict[str, Callable[[LabSettings], LabSettings]] = {
    "as described, common clock": lambda s: s,
    "call begins on a sample, arrivals rounded down": lambda s: with_twin(
        s, phase="aligned", rounding="floor"
    ),
    "converters without a common clock": lambda s: with_twin(s, phase="each"),
    "arrival noise of 30 us": lambda s: with_twin(s, noise="fixed", noise_us=30.0),
    "half the spacing": lambda s: with_spacing(s, 0.5 * float(s.mic_array.spacing_m.mean())),
}
STARTS_M = (0.0, 1.0, 10.0, 25.0, 50.0)


def assumptions(s: LabSettings, scale: Scale) -> dict[str, Any]:
    """The paper's figures under each reading of what it leaves open, and the minimiser from several starts.

    Here the 12 bins are centred on multiples of 30 degrees and the 24 begin at 0.
    """
    rows: dict[str, Any] = {}
    for name, change in ASSUMPTIONS.items():
        low = change(at_rate(s, SLOW_HZ))
        high = change(at_rate(s, FAST_HZ))
        draws, fast = Draws.of(low, scale), Draws.of(high, scale)
        centred = dataclasses.replace(low, forest=dataclasses.replace(low.forest, bins_deg=-15.0))
        rows[name] = {
            "distinct_angles": distinct_angles(low, draws.held_out),
            "best_10k_deg": _mean_deg(best(low, draws), draws.held_out),
            "forest-12": _trained_deg("forest-12", centred, draws),
            "forest-24": _trained_deg("forest-24", low, draws),
            "mlp": _trained_deg("mlp", low, draws),
            "mlp_48k": _trained_deg("mlp", high, fast),
            "best_48k_deg": _mean_deg(best(high, fast), fast.held_out),
        }
    starts: dict[str, Any] = {}
    for name in ("as described, common clock", "half the spacing"):
        here = ASSUMPTIONS[name](at_rate(s, SLOW_HZ))
        held_out = sample(here, scale.held_out, s.data.seed + 1)
        for start in STARTS_M:
            azimuths = azimuth_of(over_cells(fixed_start(here, (start, start)), SLOW_HZ))
            mae = _mean_deg(azimuths, held_out)
            forest = rows[name]["forest-12"]
            starts.setdefault(name, {})[f"{start:g}"] = {"mae_deg": mae, "forest_less": 1.0 - forest / mae}
    return {"readings": rows, "starts_m": starts}


def _trained_deg(name: str, s: LabSettings, draws: Draws) -> float:
    azimuths: Azimuths = over_cells(train(name, s, draws.train).azimuths, s.audio.rate_hz)
    return _mean_deg(azimuths, draws.held_out)


def distinct_angles(s: LabSettings, data: Arrivals) -> int:
    """How many different azimuths least squares ever answers, counting those of one sample in a thousand."""
    degrees = np.degrees(least_squares(s)(data.delay_s)) % 360.0
    _, share = np.unique(np.round(degrees, 1) % 360.0, return_counts=True)
    return int((share > len(degrees) / 1000).sum())


EXPERIMENTS: dict[str, Callable[[LabSettings, Scale], dict[str, Any]]] = {
    "by_rate": by_rate,
    "waveforms": lambda s, scale: from_waveforms(s, s.data.samples, min(HELD_OUT, scale.held_out // 10)),
    "by_spacing": by_spacing,
    "distribution": distribution,
    "offsets": offsets,
    "times": times,
    "learning": learning,
    "assumptions": assumptions,
}
"""In the order of the report."""
