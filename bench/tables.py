"""docs/accuracy.md and its picture, from the results of the accuracy and detection benchmarks.

    python bench/tables.py

Writes nothing but what stands in bench/results/: run `bench_accuracy.py` and `bench_detection.py` first.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import report
from matplotlib.ticker import FuncFormatter

from locagen_edge.files import replacing, write

DOCS = report.ROOT / "docs"
SHOWN = ("steered", "far-field", "pyroomacoustics SRP", "pyroomacoustics NormMUSIC")
TABLED = (
    "steered", "far-field", "hyperbolic", "model:tdoa-mlp", "pyroomacoustics SRP", "pyroomacoustics MUSIC",
    "pyroomacoustics NormMUSIC", "pyroomacoustics TOPS",
)  # fmt: skip
SNRS_DB = (0, 5, 10, 20, 30)
KINDS = ("white", "scream", "speech")

Cells = dict[str, dict[str, Any]]


def degrees(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def percent(value: float | None) -> str:
    return "" if value is None else f"{value:.0%}".replace("%", " %")


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return [*lines, *(f"| {' | '.join(row)} |" for row in rows), ""]


def plain(cells: Cells) -> list[str]:
    """Mean |error| over the bound, cell by cell."""
    rows = []
    for kind in KINDS:
        for snr in SNRS_DB:
            cell = cells[f"{kind} {snr:+d} dB"]
            bound = cell["bound_deg"]
            found = [f"{cell[name]['mean_deg'] / bound:.2f}" for name in TABLED if name in cell]
            sigma = [percent(cell["steered"][f"within_{n}_sigma"]) for n in (1, 2)]
            rows.append([f"{kind}, {snr} dB", degrees(bound) + "°", *found, *sigma])
    names = [name for name in TABLED if name in cells["white +0 dB"]]
    return table(["", "bound", *names, "within 1 sigma", "2 sigma"], rows)


def rotors(cells: Cells) -> list[str]:
    """Median |error| and share beyond 15 degrees."""
    names = ("steered", "steered, told", "far-field", "pyroomacoustics SRP", "pyroomacoustics NormMUSIC")
    rows = []
    for name, cell in cells.items():
        if cell["bound_deg"] is not None:
            continue
        found = [
            f"{degrees(cell[m]['median_deg'])}°, {percent(cell[m]['beyond_15_deg'])}"
            for m in names
            if m in cell
        ]
        told = percent(1.0 - cell["steered, told"]["no_bearing"])
        sigma = [percent(cell["steered"][f"within_{n}_sigma"]) for n in (1, 2)]
        rows.append([name, *found, told, *sigma])
    return table(["", *names, "told", "within 1 sigma", "2 sigma"], rows)


def detection(results: dict[str, Any]) -> list[str]:
    alone = [
        [
            name,
            f"{r['hours']:.2f} h",
            str(r["false_calls"]),
            f"{r['false_calls_while_learning_per_start']:.1f}",
        ]
        for name, r in results["noise_alone"].items()
    ]
    calls = [
        [
            name,
            percent(r["found"]),
            percent(r["onset_within_0.2_s"]),
            degrees(r["median_track_error_deg"]) + ("°" if r["median_track_error_deg"] is not None else ""),
            percent(r["within_1_sigma"]),
            percent(r["within_2_sigma"]),
        ]
        for name, r in results["calls"].items()
        if r["found"] > 0
    ]
    return [
        *table(["noise alone", "heard", "false calls", "while learning, each start"], alone),
        *table(
            ["call of 1 s", "found", "onset within 0.2 s", "median error of the track", "1 sigma", "2 sigma"],
            calls,
        ),
    ]


def draw(cells: Cells) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), sharey=True, layout="constrained")
    for axis, kind in zip(axes, KINDS, strict=True):
        here = [cells[f"{kind} {snr:+d} dB"] for snr in SNRS_DB]
        bound = [cell["bound_deg"] for cell in here]
        axis.plot(SNRS_DB, bound, color="black", linewidth=5, alpha=0.3, label="Cramer-Rao bound")
        for name, marker in zip(SHOWN, "o^sD", strict=True):
            if name in here[0]:
                axis.plot(SNRS_DB, [cell[name]["mean_deg"] for cell in here], marker=marker, label=name)
        axis.set(title=kind, xlabel="SNR, dB", yscale="log")
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}°"))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean |azimuth error|, one frame of 0.1 s")
    axes[0].legend(fontsize=8)
    with replacing(DOCS / "accuracy.png") as path:
        figure.savefig(path, dpi=110, format="png")


PAGE = """\
# Accuracy and detection, measured

Written by `bench/tables.py` from `bench/results/`; to measure anew: `make bench`. Three microphones 10 cm
apart, 10 kHz; {trials} trials a cell; {cpu}, {date}, commits {commits}.

![Mean error beside the bound](accuracy.png)

## One frame in plain noise

Mean |azimuth error| over the Cramer-Rao bound; frames of 0.1 s, noise of each microphone's own, SNR over 0
to 5 kHz, a caller on the horizon. `steered` answers always here, as the peers do; for this project's other
estimators "no bearing" counts as 90 degrees.

{plain}
## Under rotors

Median |azimuth error| and the share beyond 15 degrees; in-band SNR (300 to 4700 Hz). `steered` answers
always, by the frame or, where a call of 1 s is judged, by its average of 0.8 s; `steered, told` is what the
pipeline says (after a second its track, if it has one), where "no bearing" counts as 90 degrees. *Hunting*:
every rotor's speed goes up and down by 10 % a second. *Recorded*: propellers on a flying frame, with the
frame's own microphones, of which three are used.

{rotors}
## False calls, and calls found

The pipeline as it flies, with its defaults; calls of one second from anywhere below after 14 s of noise;
in-band SNR while it calls. What is not found at all is left out of the second table.

{detection}"""


def page(accuracy: dict[str, Any], detected: dict[str, Any]) -> str:
    return PAGE.format(
        trials=accuracy["trials"],
        cpu=accuracy["machine"]["cpu"],
        date=accuracy["date"][:10],
        commits=" and ".join(sorted({accuracy["commit"], detected["commit"]})),
        plain="\n".join(plain(accuracy["cells"])),
        rotors="\n".join(rotors(accuracy["cells"])),
        detection="\n".join(detection(detected)),
    )


def main() -> None:
    found = []
    for name in ("accuracy", "detection"):
        path = report.default(name)
        if not path.exists():
            sys.exit(f"{path} is not there: run bench/bench_{name}.py first")
        found.append(json.loads(path.read_text(encoding="utf-8")))
    accuracy, detected = found
    draw(accuracy["cells"])
    write(DOCS / "accuracy.md", page(accuracy, detected))
    print(f"wrote {DOCS / 'accuracy.md'} and its picture")


if __name__ == "__main__":
    main()
