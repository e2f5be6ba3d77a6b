"""Own array, own twin: from settings to a model that flies, with a report on what it is worth.

data       shards of the twin in OUT/data, kept and gone on with; or a data set that is there already
model      trained with early stopping, exported, compared with itself, installed with its card
report     on seeds that were not trained on, beside least squares and the best possible
flight     OUT/flight.toml: the settings that fly it, as they are
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from locagen_edge.errors import ModelError, SettingsError
from locagen_edge.files import write
from locagen_edge.lab.dataset import make, open_dataset
from locagen_edge.lab.export import answers_of, install
from locagen_edge.lab.features import normalised
from locagen_edge.lab.methods import METHODS, Trained, train
from locagen_edge.lab.samples import NAMES, at_snr, best_deg, draw, heard, mean_error_deg, of_columns
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.shards import plain_toml
from locagen_edge.lab.triangulation import least_squares
from locagen_edge.settings import Settings, sample
from locagen_edge.sim.arrivals import Arrivals
from locagen_edge.stages.bearing import make_estimator
from locagen_edge.types import F32, Tdoa

HELD_OUT = 5000
SNRS_DB = (-5.0, 0.0, 5.0, 10.0, 20.0, 30.0)
AT_EACH = 2000
"""samples at each SNR of the report"""
PARITY = 1e-5
"""Largest difference between the trained model and its file, in cosine and sine."""
CALLS = 300


@dataclass(frozen=True)
class Order:
    """What is asked for."""

    method: str
    name: str
    """of the model"""
    settings: LabSettings
    out: Path
    data: Path | None
    """an existing data set; None: it is made in out/data"""
    models: Path
    """directory to install into"""
    workers: int
    made_by: str
    """the command, for the card"""


def fulfil(order: Order) -> dict[str, Any]:
    """Does all of it and returns the report's numbers.

    Raises `ModelError` for an unknown method, or a file that does not answer as what was trained;
    `SettingsError` for a name that cannot be one; `DatasetError` for a data set of other settings.
    """
    s, began = order.settings, time.perf_counter()
    if order.method not in METHODS:
        raise ModelError(f"method {order.method}: is unknown; there are {', '.join(METHODS)}")
    flown = flight_settings(order)
    for folder in (order.out, order.models):
        folder.mkdir(parents=True, exist_ok=True)
    data, samples = _data(order)
    with _bar() as bar:
        trained = train(order.method, s, data, _tell(bar))
    content = trained.onnx()
    held_out = draw(s, HELD_OUT, s.data.seed + 1)
    parity = difference(s, trained, content, held_out.delay_s)
    result: dict[str, Any] = {
        "name": order.name,
        "method": order.method,
        "level": s.dataset.level,
        "samples": samples,
        "trained_on": len(data.azimuth_rad),
        "held_out": len(held_out.azimuth_rad),
        "bytes": len(content),
        "parity": parity,
        "device": "CUDA" if torch.cuda.is_available() else "CPU",
        "passes": len(trained.history.validation_deg) if trained.history else None,
        "validation_deg": trained.history.validation_deg if trained.history else None,
        "mae_deg": mean_error_deg(trained.azimuths, held_out),
        "least_squares_deg": mean_error_deg(least_squares(s), held_out),
        "by_snr": _by_snr(s, trained) if _has_snr(s) else {},
        "settings": plain_toml(s),
    }
    install(order.name, content, s.mic_array.positions_m, card(order, result), order.models)
    result["call_us"] = call_us(flown, held_out)
    write(order.out / "flight.toml", flight_toml(order, flown))
    result["seconds"] = round(time.perf_counter() - began, 1)
    return result


# --- data ---------------------------------------------------------------------------------------------


def _data(order: Order) -> tuple[Arrivals, int]:
    """What is trained on, and how many samples the data set has."""
    s, folder = order.settings, order.data
    if folder is None:
        folder = order.out / "data"
        make(folder, s, order.workers)
    found = open_dataset(folder, s)
    names = (*NAMES, "calling") if s.dataset.level == "waveforms" else NAMES
    data = heard(of_columns(found.columns(*names)))
    if len(data.azimuth_rad) < 100:
        raise ModelError(f"{folder}: only {len(data.azimuth_rad)} of its frames can be learned from")
    return data, found.samples


def _bar() -> tqdm:
    return tqdm(desc="training", unit=" passes", disable=None, leave=False)


def _tell(bar: tqdm) -> Callable[[int, int, float], None]:
    def tell(number: int, most: int, validation_deg: float) -> None:
        bar.total = most
        bar.set_postfix_str(f"{validation_deg:.3f}° on validation", refresh=False)
        bar.update(number - bar.n)

    return tell


# --- what it is worth ---------------------------------------------------------------------------------


def difference(s: LabSettings, trained: Trained, content: bytes, delay_s: F32) -> float:
    """Largest difference of the file's answers from the trained model's, in cosine and sine.

    Raises `ModelError` where it is more than `PARITY`; a median's equally good angles are let off.
    """
    some = delay_s[:, np.isfinite(delay_s).all(axis=0)][:, :300]
    y = answers_of(content, normalised(some, s.mic_array, s.speed_m_s)).astype(np.float64)
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(y[:, 1], y[:, 0]) - trained.azimuths(some)))))
    off *= np.minimum(np.hypot(*y.T), 1.0)  # to the error of the components, which an angle magnifies
    worst = float(np.quantile(off, 0.99)) if trained.ties else float(off.max())
    if worst > PARITY:
        raise ModelError(
            f"the ONNX file answers otherwise than the trained model, by {worst:.2g}: not installed"
        )
    return worst


def _has_snr(s: LabSettings) -> bool:
    return s.twin.noise == "snr"


def _by_snr(s: LabSettings, trained: Trained) -> dict[str, dict[str, float]]:
    rows = {}
    for number, snr_db in enumerate(SNRS_DB):
        here = at_snr(s, snr_db)
        data = draw(here, AT_EACH, s.data.seed + 10 + number)
        rows[f"{snr_db:g}"] = {
            "model": mean_error_deg(trained.azimuths, data),
            "least squares": mean_error_deg(least_squares(here), data),
            "best possible": best_deg(here, data),
        }
    return rows


def call_us(flown: Settings, data: Arrivals) -> float:
    """Median time of a call as it flies, microseconds."""
    estimate = make_estimator(flown)
    pairs = len(flown.mic_array.pairs)
    taken = []
    for delay in heard(data).delay_s.T[:CALLS].astype(np.float64):
        tdoa = Tdoa(delay, np.full(pairs, 1e-5), np.ones(pairs))
        begin = time.perf_counter()
        estimate(tdoa)
        taken.append(time.perf_counter() - begin)
    return 1e6 * float(np.median(taken))


# --- what comes out -----------------------------------------------------------------------------------


def flight_settings(order: Order) -> Settings:
    """The flight's part of the settings, with the model as the estimator. Raises `SettingsError`."""
    s, directory = order.settings, str(order.models.resolve())
    if '"' in directory or "\\" in directory:
        raise SettingsError(f"models.directory: {directory}: a path with quotation marks or backslashes")
    sections = {field.name: getattr(s, field.name) for field in dataclasses.fields(Settings)}
    sections["bearing"] = dataclasses.replace(s.bearing, estimator=f"model:{order.name}")
    sections["models"] = dataclasses.replace(s.models, directory=directory)
    return Settings(**sections)


def flight_toml(order: Order, flown: Settings) -> str:
    """The settings file that flies the model."""
    manual = sample(flown).splitlines()[2:]  # its head is that of the defaults
    head = [f"# Settings of locagen-edge that fly the model {order.name}.", f"# Made by: {order.made_by}"]
    return "\n".join([*head, *manual]) + "\n"


CARD = """# {name}

{kind} from the delays of all pairs to the azimuth ({bytes:,} bytes).

- **Input** `delays` (1, {pairs}) float32: c (t_j - t_i) / d_ij for the pairs (0,1), (0,2), ...
- **Output** `direction` (1, 2) float32: cosine and sine of the azimuth (0 ahead, positive clockwise seen
  from above); not normalised.
- **Array** (metres, x forward, y right, z down): {positions}
- **Trained** on {trained_on:,} samples of the digital twin, {level}, at {rate:g} Hz, with {twin}{scene}.
- **Held-out seed** ({held_out:,} samples): mean |error| {mae_deg:.2f} degrees, least squares
  {least_squares_deg:.2f}{at_10}.
- **File** and trained model agree within {parity:.1g} in cosine and sine.
- **Made by** `{made_by}`.
{sounds}
- **Not for** other arrays (refused), or for sources and rates unlike those above.
"""


def card(order: Order, result: dict[str, Any]) -> str:
    """The model's card."""
    s = order.settings
    waveforms = s.dataset.level == "waveforms"
    at_10 = result["by_snr"].get("10")
    kinds = {"forest": "A random forest", "mlp": "A multilayer perceptron", "siren": "A SIREN"}
    return CARD.format(
        kind=f"{kinds[order.method.partition('-')[0]]} (`{order.method}`)",
        pairs=len(s.mic_array.pairs),
        positions=np.round(s.mic_array.positions_m, 6).tolist(),
        rate=s.audio.rate_hz,
        twin=_stated(s.twin),
        scene=", " + _stated(s.scene) if waveforms else "",
        at_10=(
            f"; at 10 dB {at_10['model']:.2f}, the best possible {at_10['best possible']:.2f}"
            if at_10
            else ""
        ),
        made_by=order.made_by,
        sounds=(
            f"- **Recorded sounds**: those of the folder {s.scene.recordings}; name their authors here."
            if waveforms and "recorded" in s.scene.sounds
            else "- **Recorded sounds**: none."
        ),
        **{k: v for k, v in result.items() if k not in ("method", "settings")},
    )


def _stated(section: Any) -> str:
    """What differs from the defaults, as `key value`."""
    plain = type(section)()
    values = {f.name: getattr(section, f.name) for f in dataclasses.fields(section)}
    stated = [f"{key} {value}" for key, value in values.items() if value != getattr(plain, key)]
    return (
        f"[{type(section).__name__.removesuffix('Settings').lower()}] {', '.join(stated) or 'as by default'}"
    )


def markdown(result: dict[str, Any]) -> str:
    """The report, from its numbers alone."""
    rows = [
        f"| {snr} dB | {row['model']:.2f}° | {row['least squares']:.2f}° | {row['best possible']:.2f}° |"
        for snr, row in result["by_snr"].items()
    ]
    table = [
        "| SNR | model | least squares | best possible |",
        "| --- | --- | --- | --- |",
        *rows,
        "",
        "Mean |azimuth error| of one frame on seeds that were not trained on. *Best possible*: for "
        "whole-sample arrivals the best answer for each combination of delays; else the Cramer-Rao bound "
        "with the microphones' displacement in it. Rotors, wind and echoes can only add to it.",
        "",
        "![error over SNR](error.png)",
        "",
    ]
    passes = f", {result['passes']} passes on the {result['device']}" if result["passes"] else ""
    return "\n".join([
        f"# The model {result['name']}",
        "",
        f"Method `{result['method']}`, {result['trained_on']:,} samples, {result['level']}{passes}; "
        f"{result['seconds']:.0f} s in all. Mean |azimuth error| on {result['held_out']:,} samples of "
        f"another seed: **{result['mae_deg']:.2f}°**, least squares {result['least_squares_deg']:.2f}°.",
        "",
        *(table if rows else []),
        f"The file has {result['bytes']:,} bytes, answers as the trained model does within "
        f"{result['parity']:.1g} in cosine and sine, and takes {result['call_us']:.0f} µs a call in flight.",
        "",
        "Fly it:",
        "",
        "    locagen-edge replay RECORDING.wav --settings flight.toml",
        "",
        "All settings:",
        "",
        "```toml",
        result["settings"].rstrip(),
        "```",
        "",
    ])  # fmt: skip


def line(result: dict[str, Any]) -> str:
    """The result in one line."""
    at_10 = result["by_snr"].get("10")
    more = f", {at_10['model']:.2f}° at 10 dB (best possible {at_10['best possible']:.2f}°)" if at_10 else ""
    return (
        f"{result['name']}: {result['bytes']:,} bytes, mean |error| {result['mae_deg']:.2f}° "
        f"(least squares {result['least_squares_deg']:.2f}°){more}"
    )
