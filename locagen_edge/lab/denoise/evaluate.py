"""Denoisers judged on recordings and drones that no training heard, beside their peers, in one run.

The measure: output = a clean + residual, a the least-squares gain on the target. SI-SDR = |a clean|^2 /
|residual|^2; NR = 1 - 10^(-SI-SDRi / 10) is the share of the noise removed at the caller's level, and means
nothing without a: a method that deletes the caller has a = 0. The paper's own figure is not defined there;
`paper` is the share of the noise's power that is missing in the residual when a is left alone, and the same
of its amplitude.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from locagen_edge.lab.denoise.cases import Case, cases
from locagen_edge.lab.denoise.peers import Method, peers, wiener, wiener_plain
from locagen_edge.lab.settings import LabSettings
from locagen_edge.models import load_network
from locagen_edge.stages.denoise import CHUNK, MASK_DELAY, WAVE_DELAY, MaskStream, WaveStream
from locagen_edge.types import F32

SNRS_DB = (-30.0, -20.0, -10.0, -5.0, 0.0, 5.0, 10.0)
HELP = ("crying_baby", "door_knock", "scream", "speech", "whistle")
"""classes that call for help; music and clapping are judged, but apart"""
CLASS_SNRS_DB = (-5.0, 0.0, 5.0)
TUNED = "mask, tuned on the own drone"
WORSE_DB = -0.05
"""What rounds to 0.0 dB is not worse than its input: where nothing is found, the output is the input."""
SETTLE = 1024
"""samples at both ends of the call's clip that do not count: filters and delays begin and end there"""


@dataclass(frozen=True)
class Score:
    """One method on one mix."""

    method: str
    kind: str
    drone: str
    snr_db: float
    si_sdr_db: float
    improvement_db: float
    gain: float
    removed_power: float
    """1 - residual power / noise power, the target's gain left as it is"""


def score(mixture: F32, output: F32, clean: F32) -> tuple[float, float, float, float]:
    """SI-SDR of the output and its improvement (dB), target gain, removed share of power. All (n,)."""
    clean64 = clean.astype(np.float64)
    after, gain, residual = _si_sdr_db(output, clean64)
    before, _, noise = _si_sdr_db(mixture, clean64)
    return after, after - before, gain, 1.0 - residual / noise


def _si_sdr_db(sound: F32, clean: Any) -> tuple[float, float, float]:
    power = float(clean @ clean)
    gain = float(sound @ clean) / power
    residual = float(np.sum((sound - gain * clean) ** 2))
    # an output of nothing at all is no better than the noise alone: -100 dB
    return (
        10.0 * math.log10((gain * gain * power + 1e-10 * power) / (residual + 1e-10 * power)),
        gain,
        residual,
    )


# --- methods ------------------------------------------------------------------------------------------


def wave_method(model: str, s: LabSettings) -> Method:
    """The waveform network as it flies, its delay taken out."""
    network = load_network(model, s)

    def run(sound: F32, _: int) -> F32:
        late = WaveStream(network, 1)(_chunks(sound, WAVE_DELAY)[np.newaxis])[0]
        clean: F32 = late[WAVE_DELAY : WAVE_DELAY + len(sound)]
        return clean

    return run


def mask_method(model: str, s: LabSettings) -> Method:
    """The mask as it flies, told that all but the last part is noise; its delay taken out."""
    network = load_network(model, s)

    def run(sound: F32, before: int) -> F32:
        stream = MaskStream(network, 1)
        out = []
        for first in range(0, len(sound) + MASK_DELAY, CHUNK):
            piece = (
                _chunks(sound[first : first + CHUNK], 0)
                if first < len(sound)
                else np.zeros(CHUNK, np.float32)
            )
            spectra, mask = stream(piece[np.newaxis])
            out.append(stream.cleaned(spectra, mask)[0])
            if first + CHUNK <= before:
                stream.learn()
        return np.concatenate(out)[MASK_DELAY : MASK_DELAY + len(sound)]

    return run


def _chunks(sound: F32, more: int) -> F32:
    """With zeros behind: `more`, and up to a whole chunk."""
    return np.pad(sound, (0, more + -(len(sound) + more) % CHUNK))


# --- the run ------------------------------------------------------------------------------------------


def evaluate(
    s: LabSettings, methods: dict[str, Method], tuned: dict[str, Method], each: int
) -> dict[str, Any]:
    """Scores of all methods and peers on `each` cases per class at SNRS_DB. `tuned`: by drone."""
    found, missing = peers()
    every = {**methods, "Wiener, noise before": wiener, "Wiener, noise before, plain": wiener_plain, **found}
    result = run_cases(list(cases(s, each)), every, SNRS_DB, tuned)
    return {
        "missing": missing,
        "unheard": list(s.mixes.unheard),
        "tuned_drones": sorted(tuned),
        "ours": [*methods, *([TUNED] if tuned else [])],
        **result,
    }


def run_cases(
    chosen: list[Case],
    methods: dict[str, Method],
    snrs_db: tuple[float, ...],
    tuned: dict[str, Method] | None = None,
) -> dict[str, Any]:
    """Every method on every case at every SNR, summed up."""
    scores: list[Score] = []
    for c in tqdm(chosen, unit="case", desc="evaluate"):
        own = {TUNED: tuned[c.drone]} if tuned and c.drone in tuned else {}
        for snr_db in snrs_db:
            scores += _scores(c, snr_db, {**methods, **own})
    names = [*methods, *([TUNED] if tuned else [])]
    return {
        "cases": len(chosen),
        "drones": sorted({c.drone for c in chosen}),
        "classes": sorted({c.kind for c in chosen}),
        "by_snr": {name: _by_snr(scores, name) for name in names},
        "help_by_snr": {name: _by_snr([x for x in scores if x.kind in HELP], name) for name in names},
        "by_class": {name: _by_class(scores, name) for name in names},
        "by_class_and_snr": {name: _by_class_and_snr(scores, name) for name in names},
        "by_drone": {name: _by_drone(scores, name) for name in names},
    }


def _scores(c: Case, snr_db: float, methods: dict[str, Method]) -> Iterator[Score]:
    sound, clean = c.mixture(snr_db)
    before = len(sound) - len(clean)
    inner = slice(SETTLE, len(clean) - SETTLE)
    for name, method in methods.items():
        output = method(sound, before)[before:]
        yield Score(name, c.kind, c.drone, snr_db, *score(sound[before:][inner], output[inner], clean[inner]))


def _summary(scores: list[Score]) -> dict[str, float]:
    improvement = np.array([x.improvement_db for x in scores])
    removed = np.array([x.removed_power for x in scores])
    return {
        "improvement_db": float(np.median(improvement)),
        "improvement_mean_db": float(improvement.mean()),
        "nr": 1.0 - 10.0 ** (-float(np.median(improvement)) / 10.0),
        "gain": float(np.median([x.gain for x in scores])),
        "paper_power": float(np.median(removed)),
        "paper_amplitude": float(np.median(1.0 - np.sqrt(1.0 - np.minimum(removed, 1.0)))),
        "worse": float((improvement < WORSE_DB).mean()),
        "mixes": len(scores),
    }


def _group(scores: list[Score], key: Callable[[Score], Any]) -> dict[Any, dict[str, float]]:
    groups: dict[Any, list[Score]] = {}
    for one in scores:
        groups.setdefault(key(one), []).append(one)
    return {name: _summary(group) for name, group in groups.items()}


def _by_snr(scores: list[Score], method: str) -> dict[str, dict[str, float]]:
    return _group([x for x in scores if x.method == method], lambda x: f"{x.snr_db:g}")


def _by_class(scores: list[Score], method: str) -> dict[str, dict[str, float]]:
    return _group([x for x in scores if x.method == method and x.snr_db in CLASS_SNRS_DB], lambda x: x.kind)


def _by_class_and_snr(scores: list[Score], method: str) -> dict[str, dict[str, dict[str, float]]]:
    mine = [x for x in scores if x.method == method]
    kinds = sorted({x.kind for x in mine})
    return {kind: _group([x for x in mine if x.kind == kind], lambda x: f"{x.snr_db:g}") for kind in kinds}


def _by_drone(scores: list[Score], method: str) -> dict[str, dict[str, float]]:
    return _group([x for x in scores if x.method == method and x.snr_db == 0.0], lambda x: x.drone)


def examples(s: LabSettings, method: Method, snr_db: float = 0.0) -> list[dict[str, Any]]:
    """One case of each class before and after, for the figures."""
    shown = []
    for c in cases(s, 1):
        sound, clean = c.mixture(snr_db)
        before = len(sound) - len(clean)
        shown.append({
            "kind": c.kind, "drone": c.drone, "before": before, "mixture": sound,
            "output": method(sound, before), "clean": np.concatenate([np.zeros(before, np.float32), clean]),
        })  # fmt: skip
    return shown
