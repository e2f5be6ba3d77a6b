"""Accuracy of a bearing: every estimator of this project, pyroomacoustics', and the bound.

    python bench/bench_accuracy.py [--trials 200] [--processes N] [--quick] [--only NAME ...] [--output FILE]

Plain noise: a far caller on the horizon in the free field, exact fractional delays, noise of each
microphone's own, SNR over 0 to half the rate, one frame of 0.1 s. Rotor noise: a caller below, in-band SNR,
four simulated rotors and sensor noise 20 dB below them, or recorded ones; one frame, or one second.

Each trial is a stream: noise alone for twelve seconds, then the call that is judged. `steered` hears all of
it, as it does in flight, estimators from delays the end of it; the peers get the call, which is all they
take. `steered` answers always, as its peers do: the direction of greatest likelihood. `steered, told` is what
the pipeline says, which knows "no bearing"; each of those counts as the mean error of a guess.

The bound is Cramer and Rao's for an unknown sound (Hahn & Tretter 1973), from each trial's own spectrum.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import noises
import numpy as np
import report
from tqdm import tqdm

from locagen_edge.geometry import direction, wrap
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.levels import band_power, from_db
from locagen_edge.sim.propagation import place, plane_wave
from locagen_edge.sim.rotors import hubs_m
from locagen_edge.stages.bearing.steered import SteeredLocator
from locagen_edge.types import F64, Frame, Tdoa

ESTIMATORS = ("far-field", "hyperbolic", "two-mic", "model:tdoa-mlp")
PEERS = ("SRP", "MUSIC", "NormMUSIC", "TOPS")
LEAD = 240  # frames of noise before the call: 12.3 s
LEAD_OF_LEVELS = 20  # for estimators that learn no more of the noise than its level
SETTINGS: Settings = from_table({"array": {"tolerance_m": 0.0}})
RATE = SETTINGS.audio.rate_hz
FRAME, HOP = SETTINGS.audio.frame, SETTINGS.audio.hop
SECOND = FRAME + 18 * HOP  # 1.02 s in whole frames
POSITIONS = SETTINGS.mic_array.positions_m
NOTHING = Tdoa(np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Trial:
    sound: F64
    """(mics, LEAD * HOP + call)"""
    call: int
    """samples at the end that hold the call: FRAME or SECOND"""
    azimuth: float
    bound_deg: float
    """the smallest mean |error|"""
    positions: F64


class Answer(NamedTuple):
    azimuth: float | None
    sigma: float | None = None


Method = Callable[[Trial], Answer]


def excerpt(kind: str, call: int, rng: np.random.Generator) -> F64:
    """(call + 256,) of a call, where it sounds; white is that of the published table, 300-4000 Hz."""
    n = call + 256
    if kind == "white":
        spectrum = np.fft.rfft(rng.standard_normal(4 * n))
        frequency = np.fft.rfftfreq(4 * n, 1 / RATE)
        return np.fft.irfft(spectrum * ((frequency >= 300) & (frequency <= 4000)))[:n]
    sound = CALLS[kind](max(RATE, n), RATE, 0.48 * RATE, rng)
    starts = range(0, len(sound) - n + 1, 256)
    loud = sorted(starts, key=lambda at: -float(np.sum(sound[at : at + n] ** 2)))
    at = loud[rng.integers(max(len(loud) // 2, 1))]
    return sound[at : at + n]


def heard(
    kind: str, call: int, positions: F64, azimuth: float, elevation: float, rng: np.random.Generator
) -> F64:
    """(mics, call) without noise."""
    u = direction(azimuth, elevation)
    return plane_wave(excerpt(kind, call, rng), RATE, positions, u, SETTINGS.speed_m_s)[:, 128:-128]


def bound_deg(clean: F64, noise_power: float) -> float:
    """Mean |error| at the bound: J = sum_f 2 M s^2 / (1 + M s) (2 pi f)^2 d^2 / (2 c^2) for the triangle."""
    power = np.mean(np.abs(np.fft.rfft(clean)) ** 2, axis=0) / FRAME
    s = np.convolve(power, np.ones(3) / 3, "same") / noise_power
    frequency = np.fft.rfftfreq(FRAME, 1 / RATE)
    low, high = SETTINGS.correlation.band_hz
    band = (frequency >= low) & (frequency <= high)
    mics = len(POSITIONS)
    gain = (2 * mics * s**2 / (1 + mics * s) * (2 * np.pi * frequency) ** 2)[band].sum()
    information = gain * SETTINGS.mic_array.spacing_m[0] ** 2 / (2 * SETTINGS.speed_m_s**2)
    return math.degrees(math.sqrt(2 / (math.pi * information)))


def plain(kind: str, snr_db: float, rng: np.random.Generator) -> Trial:
    azimuth = rng.uniform(-math.pi, math.pi)
    clean = heard(kind, FRAME, POSITIONS, azimuth, 0.0, rng)
    clean *= 0.02 / np.sqrt(np.mean(clean**2))
    power = 0.02**2 / from_db(snr_db)
    sound = math.sqrt(power) * rng.standard_normal((len(POSITIONS), LEAD * HOP + FRAME))
    sound[:, -FRAME:] += clean
    return Trial(sound, FRAME, azimuth, bound_deg(clean, power), POSITIONS)


def hover(seconds: float, positions: F64, _: int, rng: np.random.Generator) -> F64:
    """(mics, samples): four rotors at half throttle, in-band power 1, sensor noise 20 dB below."""
    samples = math.ceil(seconds * RATE)
    noise = np.zeros((len(positions), samples))
    for hub in hubs_m(4, noises.ARM_M):
        noise += place(noises.rotor_of(samples, 0.5, rng), RATE, positions, hub, SETTINGS.speed_m_s)
    noise /= math.sqrt(np.mean([band_power(row, RATE) for row in noise]))
    return noise + 0.1 * rng.standard_normal(noise.shape)


def under_rotors(kind: str, snr_db: float, call: int, name: str, rng: np.random.Generator) -> Trial:
    make, positions = NOISES[name], noises.positions_of(name, POSITIONS)
    azimuth = rng.uniform(-math.pi, math.pi)
    clean = heard(kind, call, positions, azimuth, math.radians(rng.uniform(-45, -10)), rng)
    clean *= math.sqrt(from_db(snr_db) / np.mean([band_power(row, RATE) for row in clean]))
    samples = LEAD * HOP + call
    sound = make(samples / RATE, positions, int(rng.integers(3)), rng)[:, :samples]
    sound[:, -call:] += clean
    return Trial(0.02 * sound, call, azimuth, math.nan, positions)


# --- who is judged ------------------------------------------------------------------------------------


def frames(trial: Trial, lead: int = LEAD) -> Iterator[Frame]:
    """With so many frames of noise before the call."""
    for start in range((LEAD - lead) * HOP, trial.sound.shape[1] - FRAME + 1, HOP):
        samples = trial.sound[:, start : start + FRAME].astype(np.float32)
        yield Frame(samples, float(RATE), round(start / RATE * 1e9), start)


def settings_of(trial: Trial, estimator: str) -> Settings:
    array = {"positions_m": trial.positions.tolist(), "tolerance_m": 0.0}
    settings: Settings = from_table({"array": array, "bearing": {"estimator": estimator}})
    return settings


def steered(trial: Trial) -> Answer:
    """The likeliest direction, by the frame or by the second; nothing is taken for a call, all is learnt."""
    settings = settings_of(trial, "steered")
    locate = SteeredLocator(settings)
    *before, last = frames(trial)
    for frame in before:
        locate(frame, NOTHING, settings.hop_s)
        locate.settle(False)
    locate(last, NOTHING, settings.hop_s)
    found = locate.likeliest(0 if trial.call == FRAME else 1)
    return Answer(found.azimuth_rad, found.azimuth_sigma_rad)


def chain(name: str, trial: Trial) -> Answer:
    """What this project's pipeline with a named estimator says at the end of the stream."""
    pipeline = Pipeline(settings_of(trial, name))
    for frame in frames(trial, LEAD if name == "steered" else LEAD_OF_LEVELS):
        said = pipeline.process(frame)
    followed = said.track if trial.call > FRAME else None
    if followed is not None:
        return Answer(followed.azimuth_rad, followed.azimuth_sigma_rad)
    return Answer(said.bearing.azimuth_rad, said.bearing.azimuth_sigma_rad)


@functools.cache
def peer_for(name: str, positions: tuple[tuple[float, ...], ...]) -> Any:
    """pyroomacoustics' method of that name: its own grid of 1 degree, frames of 256 by 128."""
    import pyroomacoustics

    # warnings about its own deprecated imports and a window that does not matter here
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pyroomacoustics.doa.algorithms[name](
            np.array(positions)[:, :2].T, RATE, 256, c=SETTINGS.speed_m_s, num_src=1
        )


def peer(name: str, trial: Trial) -> Answer:
    method = peer_for(name, tuple(map(tuple, trial.positions.tolist())))
    low, high = SETTINGS.correlation.band_hz
    sound = trial.sound[:, -trial.call :]
    window = np.hanning(256)
    starts = range(0, trial.call - 255, 128)
    spectra = np.stack([np.fft.rfft(sound[:, s : s + 256] * window, axis=1) for s in starts], axis=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        method.locate_sources(spectra, freq_range=[low, high])
    return Answer(float(method.azimuth_recon[0]))


@functools.cache
def judges() -> tuple[dict[str, Method], list[str]]:
    found: dict[str, Method] = {"steered": steered, "steered, told": partial(chain, "steered")}
    found |= {name: partial(chain, name) for name in ESTIMATORS}
    if not report.version("pyroomacoustics"):
        return found, list(PEERS)
    return found | {f"pyroomacoustics {name}": partial(peer, name) for name in PEERS}, []


# --- cells --------------------------------------------------------------------------------------------

NOISES: dict[str, noises.Maker] = {"hover": hover, **noises.NOISES}
RECORDED = "recorded, four microphones"

CELLS: dict[str, tuple[Callable[..., Trial], tuple[Any, ...]]] = {
    **{
        f"{kind} {snr:+d} dB": (plain, (kind, snr))
        for kind in ("white", "speech", "scream")
        for snr in (0, 5, 10, 20, 30)
    },
    **{
        f"{kind} {snr:+d} dB under {text}": (under_rotors, (kind, snr, FRAME, noise))
        for noise, text in (("hover", "rotors"), ("hunting", "hunting rotors"))
        for kind, snr in (("speech", -10), ("speech", 0), ("scream", -15), ("scream", -5))
    },
    **{
        f"{kind} {snr:+d} dB under {text}, 1 s": (under_rotors, (kind, snr, SECOND, noise))
        for noise, text, snrs in (
            ("hover", "rotors", (-15, -20)),
            ("hunting", "hunting rotors", (-15,)),
            (RECORDED, "recorded rotors", (-10, -20, -30)),
        )
        for kind in ("speech", "scream")
        for snr in snrs
    },
}


LEFT_OUT = {
    "pyroomacoustics TOPS": "rotors",  # takes longer than all others together, and is behind them
    "model:tdoa-mlp": RECORDED.partition(",")[0],  # trained for another array
}
"""Methods that do not take part in cells of a name with this in it."""


def one(cell: str, names: tuple[str, ...], seed: int) -> tuple[float, dict[str, tuple[float, float | None]]]:
    """Bound, and each method's |error| with its ratio to the sigma; all in degrees; a guess's for none."""
    make, arguments = CELLS[cell]
    trial = make(*arguments, np.random.default_rng([seed, len(cell)]))
    found = {}
    methods, _ = judges()
    for name in judged(cell, names):
        answer = methods[name](trial)
        if answer.azimuth is None:
            found[name] = (math.nan, None)
            continue
        error = abs(wrap(answer.azimuth - trial.azimuth))
        found[name] = (math.degrees(error), error / answer.sigma if answer.sigma else None)
    return trial.bound_deg, found


def judged(cell: str, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if LEFT_OUT.get(name, cell + "!") not in cell]


def summary(said: list[tuple[float, float | None]]) -> dict[str, float | None]:
    told = np.array([error for error, _ in said])
    silent = np.isnan(told)
    # no bearing is an answer, told apart, and counts as the mean error of a guess
    errors = np.where(silent, 90.0, told)
    ratios = np.array([ratio for _, ratio in said if ratio is not None])
    return {
        "mean_deg": float(errors.mean()),
        "median_deg": float(np.median(errors)),
        "beyond_15_deg": float(np.mean(errors > 15)),
        "no_bearing": float(silent.mean()),
        "within_1_sigma": float(np.mean(ratios < 1)) if len(ratios) else None,
        "within_2_sigma": float(np.mean(ratios < 2)) if len(ratios) else None,
    }


def run(
    trials: int, cells: list[str], only: list[str], processes: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    names = tuple(name for name in judges()[0] if not only or name in only)
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for cell in cells:
            bar = tqdm(
                pool.map(partial(one, cell, names), range(trials), chunksize=4),
                total=trials, desc=cell, leave=False, disable=not sys.stderr.isatty(),
            )  # fmt: skip
            done = list(bar)
            bound = float(np.mean([found[0] for found in done]))
            yield (
                cell,
                {
                    "bound_deg": None if math.isnan(bound) else bound,
                    **{name: summary([found[1][name] for found in done]) for name in judged(cell, names)},
                },
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=200, help="per cell (default 200)")
    parser.add_argument("--processes", type=int, default=1, help="side by side (default 1)")
    parser.add_argument("--quick", action="store_true", help="10 trials of three cells")
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME", help="of the estimators, not all")
    parser.add_argument("--output", type=Path, default=report.default("accuracy"))
    arguments = parser.parse_args()
    recorded = {cell for cell, (_, wanted) in CELLS.items() if wanted[-1] == RECORDED}
    cells = [cell for cell in CELLS if cell not in recorded or noises.recordings() is not None]
    if arguments.quick:
        cells = ["white +10 dB", "speech +0 dB", "scream -5 dB under rotors"]
    results = {}
    trials = 10 if arguments.quick else arguments.trials
    for cell, result in run(trials, cells, arguments.only, max(arguments.processes, 1)):
        results[cell] = result
        bound = result["bound_deg"]
        print(f"{cell}" + (f": bound {bound:.3f} degrees" if bound else ""))
        for name, r in result.items():
            if name != "bound_deg":
                times = f"{r['mean_deg'] / bound:8.2f} x" if bound else " " * 10
                print(
                    f"    {name:28}mean {r['mean_deg']:7.3f}  median {r['median_deg']:7.3f}  "
                    f"beyond 15 deg {r['beyond_15_deg']:6.1%} none {r['no_bearing']:6.1%}{times}"
                    + (
                        "  sigma {within_1_sigma:.0%} / {within_2_sigma:.0%}".format(**r)
                        if r["within_1_sigma"]
                        else ""
                    )
                )
        sys.stdout.flush()
    left_out = [] if arguments.quick else [cell for cell in CELLS if cell not in cells]
    report.write(arguments.output, missing=judges()[1], left_out=left_out, trials=trials, cells=results)


if __name__ == "__main__":
    main()
