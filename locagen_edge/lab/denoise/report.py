"""The evaluation as text and figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from locagen_edge.files import write
from locagen_edge.lab.denoise.bearings import wilson
from locagen_edge.lab.denoise.evaluate import CLASS_SNRS_DB, HELP, WORSE_DB
from locagen_edge.lab.denoise.peers import spectra_of
from locagen_edge.lab.plots import draw
from locagen_edge.stages.denoise import RATE_HZ


def markdown(result: dict[str, Any]) -> str:
    """All tables."""
    ours = result["ours"]
    lines = [
        "# Denoisers",
        "",
        f"{result['cases']} calls by {len(result['classes'])} classes under {len(result['drones'])} drones "
        f"({', '.join(result['drones'])}), each at every SNR; recordings that no training heard, and "
        f"synthesised calls "
        "of other seeds. SNR over the clip, everything above 80 Hz, at 10 kHz; 2.5 s of noise alone "
        "first. Medians.",
        "",
        "SI-SDRi: improvement of the scale-invariant signal-to-distortion ratio. NR = 1 - 10^(-SI-SDRi / "
        "10): the share "
        "of the noise's power removed, with the caller as loud as before. *Gain*: what of the caller is "
        "left; NR without "
        "it means nothing, because a network that deletes the caller removes all of the noise too.",
        "",
        *(f"Never trained on, as a class: {kind}." for kind in result["unheard"]),
        *(f"Not installed here: {name}: {why}" for name, why in result["missing"].items()),
        "",
        "## SI-SDRi in dB, and gain, by SNR",
        "",
        *_table(result["by_snr"], lambda x: f"{_db(x)} ({x['gain']:.2f})", " dB"),
        "",
        "## NR by SNR",
        "",
        *_table(result["by_snr"], lambda x: f"{x['nr']:.1%}", " dB"),
        "",
        f"## NR, and gain, by SNR, of calls for help alone ({', '.join(HELP)})",
        "",
        *_table(result["help_by_snr"], lambda x: f"{x['nr']:.1%} ({x['gain']:.2f})", " dB"),
        "",
        "## In the paper's terms",
        "",
        "The paper reports 68.80 % of the unwanted noise removed and does not define it. Share of the "
        "noise's power, and "
        "of its amplitude, missing in output - a clean, with a left as it is:",
        "",
        *_table(
            {name: result["by_snr"][name] for name in ours},
            lambda x: f"{x['paper_power']:.0%} / {x['paper_amplitude']:.0%}", " dB",
        ),
        "",
        f"## SI-SDRi in dB, and gain, by class (over {', '.join(f'{x:g}' for x in CLASS_SNRS_DB)} dB)",
        "",
        *_table(result["by_class"], lambda x: f"{_db(x)} ({x['gain']:.2f})", ""),
        "",
        "## SI-SDRi at 0 dB by drone",
        "",
        *_table({n: result["by_drone"][n] for n in ours}, lambda x: f"{_db(x)}", ""),
    ]  # fmt: skip
    for name in ours:
        data = result["by_class_and_snr"][name]
        worse = [
            f"{kind} at {snr} dB"
            for kind, row in data.items()
            for snr, x in row.items()
            if x["improvement_db"] < WORSE_DB
        ]
        lines += [
            "", f"## {name}: SI-SDRi in dB by class and SNR", "",
            *_table(data, lambda x: f"{_db(x)}", " dB"), "",
            f"Worse than its input: {', '.join(worse) if worse else 'nowhere'}.",
        ]  # fmt: skip
    lines += ["", "![waveforms](waveforms.png)", "", "![spectra](spectra.png)", "", "![by SNR](by-snr.png)"]
    return "\n".join(lines) + "\n"


def _db(x: dict[str, float]) -> str:
    """Without the sign of what rounds to nothing."""
    return f"{round(x['improvement_db'], 1) + 0.0:.1f}"


def _table(data: dict[str, dict[str, Any]], cell: Any, unit: str) -> list[str]:
    columns = list(next(iter(data.values())))
    lines = [
        "| | " + " | ".join(f"{column}{unit}" for column in columns) + " |",
        "| --- |" + " --- |" * len(columns),
    ]
    for name, row in data.items():
        lines.append(f"| {name} | " + " | ".join(cell(row[c]) if c in row else "" for c in columns) + " |")
    return lines


def bearings_markdown(result: dict[str, Any]) -> str:
    """All tables of `bearings.evaluate`."""
    lines = [
        "# Bearings",
        "",
        f"{result['events']} calls ({', '.join(result['kinds'])}) from random directions, 20 degrees below, "
        f"under {len(result['drones'])} drones ({', '.join(result['drones'])}): calls and drones that no "
        "training heard. Share whose direction the whole pipeline tells within 10 degrees at the end, or "
        "after its first second, with 10 s of noise before; in brackets the share that was taken for a call. "
        "In-band SNR (300-4700 Hz) over 2.25 s. A guess is right in 6 %.",
        "",
        f"Every share is known to +-{_widest(result):.0%} or better (95 % confidence).",
    ]
    for field, lengths in result["fields"].items():
        for length_s, table in lengths.items():
            lines += ["", f"## {field}, call of {length_s} s", ""]
            lines += _table(table, lambda x: f"{x['right']:.0%} ({x['called']:.0%})", " dB")
    lines += ["", "## All fields and lengths together", ""]
    lines += _table(_together(result), lambda x: f"{x['right']:.0%} ({x['called']:.0%})", " dB")
    lines += ["", "![bearings](bearings.png)"]
    if "repeated" in result:
        lines += ["", *_repeated(result["repeated"])]
    return "\n".join(lines) + "\n"


def _repeated(result: dict[str, Any]) -> list[str]:
    """The tables of `repeats.evaluate`."""
    lines = [
        "# One caller, five calls in a minute",
        "",
        f"{result['events']} callers, each of whom calls five times (2.25 s) in a minute. Share whose "
        "direction is told within 10 degrees at the end of the last call; in brackets the share for which "
        "any is told. "
        f"Known to +-{_widest(result):.0%} or better (95 % confidence).",
    ]
    for field, lengths in result["fields"].items():
        for table in lengths.values():
            lines += ["", f"## {field}", ""]
            lines += _table(table, lambda x: f"{x['right']:.0%} ({x['called']:.0%})", " dB")
    return lines


def _widest(result: dict[str, Any]) -> float:
    low, high = wilson(result["events"] // 2, result["events"])
    return (high - low) / 2.0


def _together(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Means over fields and lengths, by method and SNR."""
    tables = [table for lengths in result["fields"].values() for table in lengths.values()]
    return {
        method: {
            snr: {
                key: float(np.mean([table[method][snr][key] for table in tables]))
                for key in ("right", "called")
            }
            for snr in row
        }
        for method, row in tables[0].items()
    }


def _bearings(axes: Axes, result: dict[str, Any]) -> None:
    for method, row in _together(result).items():
        axes.plot([float(snr) for snr in row], [100.0 * x["right"] for x in row.values()], "o-", label=method)
    axes.axhline(100.0 / 18.0, color="0.7", linewidth=0.8)
    axes.set_xlabel("in-band SNR, dB")
    axes.set_ylabel("calls within 10 degrees, %")
    axes.legend(fontsize=7)


def save_bearings(result: dict[str, Any], folder: Path) -> None:
    """bearings.md, bearings.json and bearings.png."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(folder / "bearings.png", lambda axes: _bearings(axes, result), (7, 4.4))
    write(folder / "bearings.json", json.dumps(result, indent=1) + "\n")
    write(folder / "bearings.md", bearings_markdown(result))


def figures(result: dict[str, Any], shown: list[dict[str, Any]], folder: Path) -> None:
    """waveforms.png, spectra.png, by-snr.png."""
    draw(folder / "by-snr.png", lambda axes: _by_snr(axes, result), (8, 4.6))
    draw(folder / "waveforms.png", lambda axes: _waveforms(axes, shown), (9, 1.6 * len(shown)))
    draw(folder / "spectra.png", lambda axes: _spectra(axes, shown), (9, 1.8 * len(shown)))


def curve(history: list[dict[str, float]], path: Path) -> None:
    """The learning curve."""

    def lines(axes: Axes) -> None:
        steps = [row["step"] for row in history]
        axes.plot(steps, [row["training"] for row in history], label="training")
        axes.plot(steps, [row["validation"] for row in history], label="validation")
        axes.set_xlabel("step")
        axes.set_ylabel("loss")
        axes.legend()

    draw(path, lines, (7, 4.2))


def _by_snr(axes: Axes, result: dict[str, Any]) -> None:
    for name, row in result["by_snr"].items():
        mine = name in result["ours"]
        axes.plot(
            [float(snr) for snr in row], [max(x["improvement_db"], -12.0) for x in row.values()],
            label=name, linewidth=2.2 if mine else 1.0, linestyle="-" if mine else "--",
        )  # fmt: skip
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.set_xlabel("SNR of the input, dB")
    axes.set_ylabel("SI-SDR improvement, dB (cut at -12)")
    axes.legend(fontsize=7)


def _waveforms(axes: Axes, shown: list[dict[str, Any]]) -> None:
    """Mixture, output and clean call of every class, one above the other, each row to its own scale."""
    for k, case in enumerate(shown):
        at = np.arange(len(case["mixture"])) / RATE_HZ
        scale = 0.45 / max(float(np.abs(case["mixture"]).max()), 1e-9)
        for name, colour in (("mixture", "0.75"), ("output", "tab:blue"), ("clean", "tab:orange")):
            axes.plot(at, scale * case[name] - k, color=colour, linewidth=0.5, label=name if k == 0 else None)
        axes.text(0.02, 0.3 - k, f"{case['kind']} under {case['drone']}", fontsize=8)
    axes.set_yticks([])
    axes.set_xlabel("s")
    axes.legend(loc="upper right", fontsize=7)


def _spectra(axes: Axes, shown: list[dict[str, Any]]) -> None:
    """Mean spectra over the call, before and after, 60 dB a row."""
    for k, case in enumerate(shown):
        for name, colour in (("mixture", "0.6"), ("output", "tab:blue"), ("clean", "tab:orange")):
            power = (np.abs(spectra_of(case[name][case["before"] :])) ** 2).mean(axis=0)
            level = 10.0 * np.log10(power + 1e-9)
            top = 10.0 * np.log10((np.abs(spectra_of(case["mixture"])) ** 2).mean(axis=0).max())
            hertz = np.linspace(0.0, RATE_HZ / 2, len(power))
            axes.plot(
                hertz, np.maximum(level - top, -60.0) / 66.0 - k, color=colour, label=name if k == 0 else None
            )
        axes.text(3400, -0.1 - k, f"{case['kind']} under {case['drone']}", fontsize=8)
    axes.set_yticks([])
    axes.set_xlabel("Hz")
    axes.legend(loc="upper right", fontsize=7)


def save(result: dict[str, Any], shown: list[dict[str, Any]], folder: Path) -> None:
    """report.md, report.json and the figures."""
    folder.mkdir(parents=True, exist_ok=True)
    figures(result, shown, folder)
    write(folder / "report.json", json.dumps(result, indent=1) + "\n")
    write(folder / "report.md", markdown(result))
