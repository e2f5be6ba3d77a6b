"""Field recordings beside the twin: by how much do angle and distance differ, and does the twin say so too?

Every recording runs through the pipeline that flies, from its beginning, as in `replay`; a label is compared
with the frame whose middle is nearest to it. Beside it stands what the twin predicts for the same array, the
same estimator, the same SNR and nearly the same azimuth: frames of the settings' scene, measured by the same
stages. Distance is the hyperbolic solver's, and is compared where it says itself that it can be known.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from locagen_edge.errors import DatasetError
from locagen_edge.geometry import compass_deg, wrap
from locagen_edge.lab.columns import columns
from locagen_edge.lab.labels import Label, read_labels
from locagen_edge.lab.settings import LabSettings
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import BearingSettings
from locagen_edge.stages.bearing import make_estimator
from locagen_edge.stages.bearing.hyperbolic import hyperbolic
from locagen_edge.stages.mic import wav_duration_s, wav_frames
from locagen_edge.types import F64, Estimate, Tdoa

STEP_DB = 5.0
"""The twin is asked at these SNRs, as far as the field has them."""
SNR_RANGE_DB = (-10.0, 40.0)
SWEEP_STEP_DEG = 1.0
NEAR_DEG = 20.0
"""A label is held against the twin's samples within this of its azimuth: 41 of them."""


def evaluate(folder: Path, s: LabSettings) -> dict[str, Any]:
    """Every label's differences and their statistics, ready for JSON.

    Raises `DatasetError` for labels that cannot be used, all at once, and `SourceError` for a recording.
    """
    labels = read_labels(folder)
    _check_times(folder, s, labels)
    by_file: dict[str, list[Label]] = defaultdict(list)
    for label in labels:
        by_file[label.file].append(label)
    rows = []
    for file, own in tqdm(by_file.items(), desc="recordings", unit=" files", disable=None):
        rows += [_row(label, estimate, fix) for label, estimate, fix in _heard(folder / file, s, own)]
    _predict(s, rows)
    return {
        "folder": str(folder),
        "estimator": s.bearing.estimator,
        "recordings": len(by_file),
        "labels": rows,
        "statistics": statistics(rows),
    }


def _check_times(folder: Path, s: LabSettings, labels: Iterable[Label]) -> None:
    lengths = {file: wav_duration_s(folder / file, s) for file in {label.file for label in labels}}
    faults = [
        f"{label.place}: time_s: {label.time_s:g} is after the end of {label.file}, "
        f"{lengths[label.file]:.2f} s long"
        for label in labels
        if label.time_s > lengths[label.file]
    ]
    if faults:
        raise DatasetError("\n".join(faults))


# --- the field ----------------------------------------------------------------------------------------


def _heard(path: Path, s: LabSettings, labels: list[Label]) -> Iterator[tuple[Label, Estimate, Any]]:
    """Each label with the estimate of the frame nearest to it, and the hyperbolic solver's bearing there."""
    pipeline, locate = Pipeline(s), hyperbolic(s)
    nearest: dict[Label, tuple[float, Estimate]] = {}
    for frame in wav_frames(path, s):
        estimate = pipeline.process(frame)
        middle_s = (frame.start + 0.5 * s.audio.frame) / s.audio.rate_hz
        for label in labels:
            off = abs(middle_s - label.time_s)
            if label not in nearest or off < nearest[label][0]:
                nearest[label] = (off, estimate)
    for label, (_, estimate) in nearest.items():
        yield label, estimate, locate(estimate.tdoa).fix


def _row(label: Label, estimate: Estimate, fix: Any) -> dict[str, Any]:
    found, track = estimate.bearing.azimuth_rad, estimate.track
    known = fix is not None and bool(fix.range_observable)
    return {
        "label": label.place,
        "file": label.file,
        "time_s": label.time_s,
        "azimuth_deg": compass_deg(label.azimuth_rad),
        "range_m": label.range_m,
        "estimate_deg": None if found is None else compass_deg(found),
        "error_deg": None if found is None else math.degrees(wrap(found - label.azimuth_rad)),
        "sigma_deg": None if found is None else math.degrees(estimate.bearing.azimuth_sigma_rad),
        "track_error_deg": (
            None if track is None else math.degrees(wrap(track.azimuth_rad - label.azimuth_rad))
        ),
        "snr_db": estimate.detection.snr_db if label.snr_db is None else label.snr_db,
        "call": estimate.detection.call,
        "range_observable": known,
        "estimate_m": fix.range_m if known else None,
        "error_m": fix.range_m - label.range_m if known and label.range_m is not None else None,
    }


# --- the twin -----------------------------------------------------------------------------------------


def _predict(s: LabSettings, rows: list[dict[str, Any]]) -> None:
    """Adds to every row what the twin does at its SNR and azimuth: mean |error|, its 95th percentile.

    Of labels with a range it stands at that range, to half an octave, and its distance counts too.
    """
    least, most = SNR_RANGE_DB
    at = [round(min(max(row["snr_db"], least), most) / STEP_DB) * STEP_DB for row in rows]
    ranges = [None if row["range_m"] is None else 2.0 ** round(math.log2(row["range_m"])) for row in rows]
    places = list(zip(at, ranges, strict=True))
    bar = tqdm(set(places), desc="twin", unit=" sweeps", disable=None)
    swept = {place: _swept(s, *place) for place in bar}
    for row, place in zip(rows, places, strict=True):
        azimuth_deg, off_deg, off_m = swept[place]
        near = np.abs((azimuth_deg - row["azimuth_deg"] + 180.0) % 360.0 - 180.0) <= NEAR_DEG
        row["twin_snr_db"], row["twin_range_m"] = place
        row["twin_deg"] = float(off_deg[near].mean())
        row["twin_95_deg"] = float(np.percentile(off_deg[near], 95))
        known = off_m[near][np.isfinite(off_m[near])]
        row["twin_range_share"] = len(known) / int(near.sum())
        row["twin_m"] = float(known.mean()) if len(known) else None


def _swept(s: LabSettings, snr_db: float, range_m: float | None) -> tuple[F64, F64, F64]:
    """Azimuths (n,) all round, the estimator's |errors| (n,) on the twin's frames, both in degrees, and
    those of the hyperbolic solver's range (n,) in metres, NaN where it cannot be known."""
    keys = {"noise": "snr", "snr_db": snr_db, "source": "sweep", "step_deg": SWEEP_STEP_DEG}
    here = dataclasses.replace(
        s,
        twin=dataclasses.replace(s.twin, **keys, range_m=max(range_m or s.twin.range_m, 0.5)),  # type: ignore[arg-type]
        scene=dataclasses.replace(s.scene, frames=1, lead_s=0.0, snr_span_db=0.0, snr_at_m=0.0),
        dataset=dataclasses.replace(s.dataset, level="waveforms", keep=()),
    )
    drawn = columns(here, round(360.0 / SWEEP_STEP_DEG), s.data.seed)
    # the steered search needs sound, and there are only delays here: least squares is what stands for it
    flown = (
        dataclasses.replace(s, bearing=BearingSettings("far-field"))
        if s.bearing.estimator == "steered"
        else s
    )
    estimate, locate = make_estimator(flown), hyperbolic(s)
    off, off_m = [], []
    for delay, sigma, peak, true in zip(
        drawn["delay_s"], drawn["sigma_s"], drawn["peak"], drawn["azimuth_rad"], strict=True
    ):
        tdoa = Tdoa(delay.astype(np.float64), sigma.astype(np.float64), peak.astype(np.float64))
        found = estimate(tdoa).azimuth_rad
        off.append(90.0 if found is None else abs(math.degrees(wrap(found - float(true)))))
        fix = locate(tdoa).fix if range_m is not None else None
        known = fix is not None and bool(fix.range_observable)
        off_m.append(abs(fix.range_m - here.twin.range_m) if fix is not None and known else math.nan)
    return np.degrees(drawn["azimuth_rad"].astype(np.float64)) % 360.0, np.array(off), np.array(off_m)


# --- statistics ---------------------------------------------------------------------------------------


def statistics(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the field, and of the twin for the same labels; None where there is nothing to tell."""
    error = np.array([row["error_deg"] for row in rows if row["error_deg"] is not None])
    twin = np.array([row["twin_deg"] for row in rows])
    reach = np.array([row["twin_95_deg"] for row in rows if row["error_deg"] is not None])
    ranged = [row for row in rows if row["range_m"] is not None]
    compared = [row for row in ranged if row["error_m"] is not None]
    twin_m = [row["twin_m"] for row in compared if row["twin_m"] is not None]
    metres = np.array([row["error_m"] for row in compared])
    told: dict[str, Any] = {
        "labels": len(rows),
        "without_bearing": len(rows) - len(error),
        "twin_mean_deg": float(twin.mean()),
        "within_twin_95": None,
        "range_labels": len(ranged),
        "range_compared": len(metres),
        "range_mean_m": float(np.abs(metres).mean()) if len(metres) else None,
        "twin_range_mean_m": float(np.mean(twin_m)) if twin_m else None,
        "twin_range_share": float(np.mean([row["twin_range_share"] for row in ranged])) if ranged else None,
    }
    if len(error):
        bias = math.degrees(math.atan2(np.sin(np.radians(error)).mean(), np.cos(np.radians(error)).mean()))
        left = np.abs((error - bias + 180.0) % 360.0 - 180.0)
        told |= {
            "mean_deg": float(np.abs(error).mean()),
            "median_deg": float(np.median(np.abs(error))),
            "p90_deg": float(np.percentile(np.abs(error), 90)),
            "bias_deg": bias,
            "mean_without_bias_deg": float(left.mean()),
            "within_twin_95": float(np.mean(np.abs(error) <= reach)),
        }
    return told


def markdown(result: dict[str, Any]) -> str:
    """The report, from its numbers alone."""
    told = result["statistics"]
    lines = [
        "# Field recordings beside the twin",
        "",
        f"{result['folder']}: {told['labels']} labels in {result['recordings']} recordings, estimator "
        f"`{result['estimator']}`; {told['without_bearing']} labels without a bearing.",
        "",
    ]
    if "mean_deg" in told:
        lines += [
            "| azimuth error | field | twin, same SNR and azimuth |",
            "| --- | --- | --- |",
            f"| mean \\|error\\| | {told['mean_deg']:.2f}° | {told['twin_mean_deg']:.2f}° |",
            f"| the same less the common turn | {told['mean_without_bias_deg']:.2f}° | |",
            f"| median \\|error\\| | {told['median_deg']:.2f}° | |",
            f"| 90th percentile | {told['p90_deg']:.2f}° | |",
            f"| common turn (mean error) | {told['bias_deg']:+.2f}° | 0° |",
            f"| share within the twin's 95 % | {told['within_twin_95']:.0%} | 95% |",
            "",
            "A common turn is one of the array on its frame, or of the heading in the labels: turn "
            "array.positions_m, or mend the labels. What is left beyond the twin's error is what the twin "
            "does not have: echoes, wind, rotors, a position or clock that is off (set them in [scene] and "
            "[twin]).",
            "",
            "![error over azimuth](error.png)",
            "",
        ]
    rows = [
        f"| {row['label'].rpartition('/')[2]} | {row['file']} | {row['time_s']:.2f} | "
        f"{row['azimuth_deg']:.1f} | {_number(row['estimate_deg'], '.1f')} | "
        f"{_number(row['error_deg'], '+.2f')} | {row['twin_deg']:.2f} | {row['snr_db']:.0f} | "
        f"{_number(row['range_m'], '.1f')} | {_number(row['estimate_m'], '.1f')} | "
        f"{_number(row['error_m'], '+.2f')} |"
        for row in result["labels"]
    ]
    lines += [
        *_distance(told),
        "",
        "| label | file | time, s | azimuth | estimate | error | twin's mean | SNR, dB | range, m | "
        "estimate | error |",
        "|" + " --- |" * 11,
        *rows,
        "",
    ]
    return "\n".join(lines)


def _distance(told: dict[str, Any]) -> list[str]:
    if not told["range_labels"]:
        return ["No label has a range, so distance is not compared."]
    return [
        "| distance, hyperbolic solver | field | twin, same labels |",
        "| --- | --- | --- |",
        f"| mean \\|difference\\| where it can be known, m | {_number(told['range_mean_m'], '.2f')} | "
        f"{_number(told['twin_range_mean_m'], '.2f')} |",
        f"| share of labels where it can be known | {told['range_compared'] / told['range_labels']:.0%} | "
        f"{told['twin_range_share']:.0%} |",
        "",
        "A small array cannot know the range beyond some tens of its own size, and says so.",
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def line(result: dict[str, Any]) -> str:
    """The result in one line."""
    told = result["statistics"]
    if "mean_deg" not in told:
        return f"{told['labels']} labels, none with a bearing"
    return (
        f"{told['labels']} labels: mean |error| {told['mean_deg']:.2f}° (twin {told['twin_mean_deg']:.2f}°), "
        f"common turn {told['bias_deg']:+.2f}°, {told['without_bearing']} without a bearing"
    )
