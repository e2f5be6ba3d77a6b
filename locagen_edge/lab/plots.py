"""The figures of the experiments, drawn from the plain numbers of report.json alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from locagen_edge.files import replacing

Drawing = Callable[[Axes, dict[str, Any]], None]

STYLES: dict[str, dict[str, Any]] = {
    "best possible": {"color": "black", "linestyle": "-", "linewidth": 4.0, "alpha": 0.3},
    "least squares": {"color": "tab:blue", "marker": "o"},
    "hyperbolic": {"color": "tab:cyan", "marker": "s"},
    "minimiser": {"color": "tab:red", "marker": "X"},
    "forest-12": {"color": "tab:olive", "marker": "v"},
    "forest-24": {"color": "tab:green", "marker": "^"},
    "forest": {"color": "darkgreen", "marker": "D"},
    "mlp": {"color": "tab:purple", "marker": "P"},
    "siren": {"color": "tab:orange", "marker": "*", "linestyle": "--"},
    "siren-unscaled": {"color": "tab:brown", "marker": "x", "linestyle": ":"},
    "table of cells": {"color": "tab:blue", "marker": "o"},
}
LABELS = {
    "hyperbolic": "hyperbolic solver (flight)",
    "minimiser": "minimiser, fixed start",
    "forest-12": "forest, 12 bins",
    "forest-12-mean": "forest, 12 bins, mean direction",
    "forest-12-median": "forest, 12 bins, median",
    "forest-24": "forest, 24 bins",
    "forest-24-mean": "forest, 24 bins, mean direction",
    "forest-24-median": "forest, 24 bins, median",
    "forest": "forest, regression",
    "mlp": "MLP",
    "mlp-pairs": "MLP on all pairs, no ratio",
    "siren": "SIREN",
    "siren-unscaled": "SIREN, inputs unscaled",
}
SHOWN = (
    "best possible", "least squares", "hyperbolic", "minimiser", "forest-12", "forest-24", "forest", "mlp",
    "siren", "siren-unscaled",
)  # fmt: skip
PAPER: dict[str, Any] = {
    "color": "black",
    "marker": "*",
    "markersize": 13,
    "linestyle": "none",
    "markerfacecolor": "gold",
}


def draw_all(result: dict[str, Any], folder: Path) -> None:
    """Writes the figure of every experiment in the result as NAME.png."""
    for name, (experiment, function, size) in FIGURES.items():
        if experiment in result:
            draw(folder / f"{name}.png", _of(function, result), size)


def _of(function: Drawing, result: dict[str, Any]) -> Callable[[Axes], None]:
    return lambda axes: function(axes, result)


def draw(path: Path, function: Callable[[Axes], None], size: tuple[float, float]) -> None:
    """Writes one figure of this size in inches."""
    with matplotlib.rc_context({"figure.dpi": 120, "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}):
        figure, axes = plt.subplots(figsize=size, layout="constrained")
        function(axes)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})
        plt.close(figure)


def label(name: str) -> str:
    return LABELS.get(name, name)


def _plain(axis: Any) -> None:
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def histogram(axes: Axes, result: dict[str, Any]) -> None:
    data = result["distribution"]
    edges = np.array(data["edges_deg"])
    rows = result.get("by_rate", {}).get(str(result["setup"]["rate_hz"]), {})
    for name, share in data["histogram"].items():
        style = STYLES[name]
        mae = f", mean {rows[name]['mae_deg']:.1f}°" if name in rows else ""
        axes.stairs(
            100 * np.array(share), edges, color=style["color"], label=label(name) + mae, linewidth=1.6
        )
    axes.set(
        xlabel="|azimuth error| (degrees)",
        ylabel="share of samples per 2 degrees (%)",
        yscale="log",
        ylim=(0.02, 60),
        xlim=(0, 180),
        title=f"Forest against triangulation, {result['setup']['rate_hz'] / 1000:g} kHz, "
        f"{100 * result['setup']['spacing_m']:g} cm",
    )
    _plain(axes.yaxis)
    axes.legend()


def cdf(axes: Axes, result: dict[str, Any]) -> None:
    data = result["distribution"]
    for name in SHOWN:
        style = {k: v for k, v in STYLES[name].items() if k != "marker"}
        axes.plot(np.maximum(data["cdf_deg"][name], 1e-2), data["percent"], label=label(name), **style)
    axes.set(
        xlabel="|azimuth error| (degrees)",
        ylabel="share of samples with a smaller error (%)",
        xscale="log",
        xlim=(0.05, 180),
        ylim=(0, 100),
        title="Distribution of the error at 48 kHz, 10 cm",
    )
    axes.set_xticks([0.1, 0.3, 1, 3, 10, 30, 100])
    _plain(axes.xaxis)
    axes.legend(loc="upper left")


def rates(axes: Axes, result: dict[str, Any]) -> None:
    data = result["by_rate"]
    khz = np.array([int(rate) for rate in data]) / 1000
    for name in SHOWN:
        axes.plot(khz, [row[name]["mae_deg"] for row in data.values()], label=label(name), **STYLES[name])
    told = [
        (int(rate) / 1000, value)
        for rate, values in result["paper"]["mae_deg"].items()
        for value in values.values()
    ]
    axes.plot(*zip(*told, strict=True), label="the paper's own figures", **PAPER)
    axes.set(
        xlabel="sample rate (kHz)",
        ylabel="mean |azimuth error| (degrees)",
        xscale="log",
        yscale="log",
        title=f"Error over sample rate, {100 * result['setup']['spacing_m']:g} cm",
    )
    axes.set_xticks(khz, [f"{k:g}" if k != 44.1 else "44.1  " for k in khz])
    axes.set_yticks([1, 2, 5, 10, 20, 50, 100])
    _plain(axes.yaxis)
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def spacings(axes: Axes, result: dict[str, Any]) -> None:
    data = result["by_spacing"]
    cm = np.array([float(d) for d in data]) * 100
    for name in [name for name in SHOWN if name in next(iter(data.values()))]:
        axes.plot(cm, [row[name]["mae_deg"] for row in data.values()], label=label(name), **STYLES[name])
    axes.set(
        xlabel="spacing of the microphones (cm)",
        ylabel="mean |azimuth error| (degrees)",
        xscale="log",
        yscale="log",
        title=f"Error over spacing, {result['setup']['rate_hz'] / 1000:g} kHz",
    )
    axes.set_xticks(cm)
    axes.set_yticks([0.5, 1, 2, 5, 10, 20, 50])
    _plain(axes.xaxis)
    _plain(axes.yaxis)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _offset_map(axes: Axes, result: dict[str, Any], name: str) -> None:
    data = result["offsets"]
    levels, error = np.array(data["levels_samples"]), data["errors"][name]
    image = axes.pcolormesh(levels, levels, np.array(error["mean"]).T, cmap="viridis", shading="nearest")
    p = error["p"]
    axes.figure.colorbar(image, ax=axes, label=f"mean error ({error['unit']})")
    axes.grid(visible=False)
    axes.set(
        xlabel="offset of microphone 1 (samples)",
        ylabel="offset of microphone 2 (samples)",
        title=f"Error in {name}\np = {p[0]:.2g} (microphone 1), {p[1]:.2g} (2)",
        aspect="equal",
    )


def offsets_position(axes: Axes, result: dict[str, Any]) -> None:
    _offset_map(axes, result, "position, minimiser")


def offsets_azimuth(axes: Axes, result: dict[str, Any]) -> None:
    _offset_map(axes, result, "azimuth")


def times(axes: Axes, result: dict[str, Any]) -> None:
    data = dict(sorted(result["times"].items(), key=lambda item: -item[1]["median_us"]))
    medians = [row["median_us"] for row in data.values()]
    to_p99 = [max(row["p99_us"] - row["median_us"], 0.0) for row in data.values()]
    axes.barh(list(data), medians, color="tab:blue", xerr=[[0.0] * len(data), to_p99], ecolor="tab:red")
    for at, value in enumerate(medians):
        axes.annotate(f"{value:.0f} µs", (value, at), xytext=(-4, 0), textcoords="offset points",
                      ha="right", va="center", color="white")  # fmt: skip
    axes.set(
        xlabel="wall-clock time of one estimate (µs), median; red: to the 99th percentile",
        xscale="log",
        xlim=(10, None),
        title="Time per estimate on the machine that wrote this report",
    )
    axes.grid(visible=False, axis="y")


def learning(axes: Axes, result: dict[str, Any]) -> None:
    data = result["learning"]
    for name, mae in data["mae_deg"].items():
        axes.plot(data["samples"], mae, label=label(name), **STYLES[name])
    axes.axhline(data["best_deg"], label="best possible", **STYLES["best possible"])
    axes.set(
        xlabel="training samples",
        ylabel="mean |azimuth error| (degrees)",
        xscale="log",
        yscale="log",
        title=f"Learning curve, {data['rate_hz'] / 1000:g} kHz",
    )
    axes.set_yticks([1.5, 2, 3, 4, 5, 7, 10])
    _plain(axes.yaxis)
    axes.legend()


def from_waveforms(axes: Axes, result: dict[str, Any]) -> None:
    data = result["waveforms"]["mae_deg"]
    names = list(next(iter(data.values())))[::-1]
    height = 0.8 / len(data)
    for k, (scene, row) in enumerate(data.items()):
        at = np.arange(len(names)) + 0.4 - height * (k + 0.5)
        values = [row[name] for name in names]
        axes.barh(at, values, height, label=scene, color=("tab:purple", "tab:cyan")[k % 2])
        for y, value in zip(at, values, strict=True):
            axes.annotate(f"{value:.2f}°", (value, y), xytext=(3, 0), textcoords="offset points", va="center")
    told = result["waveforms"]["paper_deg"]
    axes.plot(
        list(told.values()), [names.index(name) for name in told], label="the paper's own figures", **PAPER
    )
    axes.set_yticks(range(len(names)), names)
    axes.grid(visible=False, axis="y")
    axes.set(
        xlabel="mean |azimuth error| (degrees)",
        xscale="log",
        xlim=(0.08, 200),
        title=f"From sound, {result['setup']['rate_hz'] / 1000:g} kHz, "
        f"{100 * result['setup']['spacing_m']:g} cm, one frame",
    )
    _plain(axes.xaxis)
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, -0.12), ncol=3)


def training(axes: Axes, result: dict[str, Any]) -> None:
    """Of a report of `train`: error over SNR, beside least squares and the best possible."""
    snr = [float(key) for key in result["by_snr"]]
    styles = {"model": "mlp", "least squares": "least squares", "best possible": "best possible"}
    for name, style in styles.items():
        shown = f"model {result['name']}" if name == "model" else name
        values = [row[name] for row in result["by_snr"].values()]
        axes.plot(snr, values, label=shown, **STYLES[style])
    axes.set(
        xlabel="in-band SNR (dB)",
        ylabel="mean |azimuth error| (degrees)",
        yscale="log",
        title=f"{result['name']}: one frame, {result['level']}",
    )
    _plain(axes.yaxis)
    axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
    axes.legend()


def field(axes: Axes, result: dict[str, Any]) -> None:
    """Of a report of `evaluate`: every label's error over azimuth, and how far the twin's reach."""
    rows = [row for row in result["labels"] if row["error_deg"] is not None]
    azimuth = np.array([row["azimuth_deg"] for row in rows])
    error = np.array([row["error_deg"] for row in rows])
    twin = np.array([row["twin_95_deg"] for row in rows])
    order = azimuth.argsort()
    axes.vlines(azimuth[order], -twin[order], twin[order], color="tab:cyan", alpha=0.5, linewidth=4.0,
                label="95 % of the twin's errors at the same SNR and azimuth")  # fmt: skip
    axes.plot(azimuth, error, "o", color="tab:red", markersize=4, label="field")
    bias = result["statistics"]["bias_deg"]
    axes.axhline(bias, color="tab:red", linestyle="--", linewidth=1, label=f"common turn, {bias:+.2f}°")
    axes.set(
        xlabel="true azimuth (degrees)",
        ylabel="estimate less truth (degrees)",
        xlim=(0, 360),
        title=f"{len(rows)} labels, estimator {result['estimator']}",
    )
    axes.set_xticks(range(0, 361, 45))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncol=3)


FIGURES: dict[str, tuple[str, Drawing, tuple[float, float]]] = {
    "histogram": ("distribution", histogram, (7, 4.2)),
    "cdf-48khz": ("distribution", cdf, (7, 4.5)),
    "mae-by-rate": ("by_rate", rates, (8.5, 5)),
    "from-waveforms": ("waveforms", from_waveforms, (8.5, 4.8)),
    "mae-by-spacing": ("by_spacing", spacings, (8.5, 4.5)),
    "offsets-position": ("offsets", offsets_position, (5.5, 4.5)),
    "offsets-azimuth": ("offsets", offsets_azimuth, (5.5, 4.5)),
    "time": ("times", times, (7, 3.8)),
    "learning": ("learning", learning, (7, 4.2)),
}
"""Name: the experiment it shows, drawing, size in inches."""
