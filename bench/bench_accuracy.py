"""Accuracy of one frame's bearing: every estimator of this project, pyroomacoustics', and the bound.

    python bench/bench_accuracy.py [--trials 500] [--quick] [--output FILE]

Plain noise: a far caller on the horizon in the free field, exact fractional delays, noise of each
microphone's own, SNR over 0 to half the rate, one frame of 0.1 s. Rotor noise: a caller below, in-band SNR,
four simulated rotors and sensor noise 20 dB below them.

Each trial is a stream: noise alone for two seconds, then the frame that is judged. This project's chain hears
all of it, as it does in flight; its peers get the frame, which is all that they take.

The bound is Cramer and Rao's for an unknown sound (Hahn & Tretter 1973), from each trial's own spectrum.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

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
from locagen_edge.sim.rotors import hubs_m, rotor
from locagen_edge.types import F64, Frame

ESTIMATORS = ("steered", "far-field", "hyperbolic", "two-mic", "model:tdoa-mlp")
PEERS = ("SRP", "MUSIC", "NormMUSIC", "TOPS")
LEAD = 40  # frames of noise before the call: 2.1 s
SETTINGS = from_table({"array": {"tolerance_m": 0.0}})
RATE = SETTINGS.audio.rate_hz
FRAME, HOP = SETTINGS.audio.frame, SETTINGS.audio.hop
POSITIONS = SETTINGS.mic_array.positions_m
LENGTH = FRAME + LEAD * HOP


@dataclass(frozen=True)
class Trial:
    sound: F64
    """(mics, LENGTH), the call in the last FRAME samples"""
    azimuth: float
    bound_deg: float
    """the smallest mean |error|"""


def excerpt(kind: str, rng: np.random.Generator) -> F64:
    """(FRAME + 256,) of a call, where it sounds; white is that of the published table, 300-4000 Hz."""
    n = FRAME + 256
    if kind == "white":
        spectrum = np.fft.rfft(rng.standard_normal(4 * n))
        frequency = np.fft.rfftfreq(4 * n, 1 / RATE)
        return np.fft.irfft(spectrum * ((frequency >= 300) & (frequency <= 4000)))[:n]
    sound = CALLS[kind](RATE, RATE, 0.48 * RATE, rng)
    starts = range(0, len(sound) - n, 256)
    loud = sorted(starts, key=lambda at: -float(np.sum(sound[at : at + n] ** 2)))
    at = loud[rng.integers(max(len(loud) // 2, 1))]
    return sound[at : at + n]


def heard(kind: str, azimuth: float, elevation: float, rng: np.random.Generator) -> F64:
    """(mics, FRAME) without noise."""
    call = excerpt(kind, rng)
    u = direction(azimuth, elevation)
    return plane_wave(call, RATE, POSITIONS, u, SETTINGS.speed_m_s)[:, 128:-128]


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
    clean = heard(kind, azimuth, 0.0, rng)
    clean *= 0.02 / np.sqrt(np.mean(clean**2))
    power = 0.02**2 / from_db(snr_db)
    sound = math.sqrt(power) * rng.standard_normal((len(POSITIONS), LENGTH))
    sound[:, -FRAME:] += clean
    return Trial(sound, azimuth, bound_deg(clean, power))


def rotor_noise(rng: np.random.Generator) -> F64:
    """(mics, LENGTH): four rotors at 0.3 m, in-band power 1, sensor noise 20 dB below."""
    noise = np.zeros((len(POSITIONS), LENGTH))
    for hub in hubs_m(4, 0.3):
        pieces, made = [], 0
        for piece in rotor(0.5, RATE, 0.48 * RATE, rng):
            pieces.append(piece)
            made += len(piece)
            if made >= LENGTH:
                break
        noise += place(np.concatenate(pieces)[:LENGTH], RATE, POSITIONS, hub, SETTINGS.speed_m_s)
    noise /= math.sqrt(np.mean([band_power(row, RATE) for row in noise]))
    return noise + 0.1 * rng.standard_normal(noise.shape)


def hunting_noise(rng: np.random.Generator) -> F64:
    """The same from rotors whose speeds change by 10 % in a second, sensor noise 10 dB below."""
    return noises.hunting(LENGTH / RATE, POSITIONS, int(rng.integers(3)), rng)


def under_rotors(
    kind: str,
    snr_db: float,
    rng: np.random.Generator,
    noise: Callable[[np.random.Generator], F64] = rotor_noise,
) -> Trial:
    azimuth = rng.uniform(-math.pi, math.pi)
    clean = heard(kind, azimuth, math.radians(rng.uniform(-45, -10)), rng)
    clean *= math.sqrt(from_db(snr_db) / np.mean([band_power(row, RATE) for row in clean]))
    sound = noise(rng)
    sound[:, -FRAME:] += clean
    return Trial(0.02 * sound, azimuth, math.nan)


# --- who is judged ------------------------------------------------------------------------------------


def chain(name: str) -> Callable[[Trial], float | None]:
    """This project's pipeline with a named estimator, fed with the whole stream."""
    settings: Settings = from_table({"array": {"tolerance_m": 0.0}, "bearing": {"estimator": name}})

    def estimate(trial: Trial) -> float | None:
        pipeline = Pipeline(settings)
        for start in range(0, LENGTH - FRAME + 1, HOP):
            samples = trial.sound[:, start : start + FRAME].astype(np.float32)
            last = pipeline.process(Frame(samples, float(RATE), round(start / RATE * 1e9), start))
        return last.bearing.azimuth_rad

    return estimate


def peer(name: str) -> Callable[[Trial], float | None]:
    """pyroomacoustics' method of that name: its own grid of 1 degree, frames of 256 by 128."""
    import pyroomacoustics

    low, high = SETTINGS.correlation.band_hz
    # warnings about its own deprecated imports and a window that does not matter here
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        method = pyroomacoustics.doa.algorithms[name](
            POSITIONS[:, :2].T, RATE, 256, c=SETTINGS.speed_m_s, num_src=1
        )

    def estimate(trial: Trial) -> float | None:
        frame = trial.sound[:, -FRAME:]
        window = np.hanning(256)
        starts = range(0, FRAME - 255, 128)
        spectra = np.stack([np.fft.rfft(frame[:, s : s + 256] * window, axis=1) for s in starts], axis=2)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            method.locate_sources(spectra, freq_range=[low, high])
        return float(method.azimuth_recon[0])

    return estimate


def judges() -> tuple[dict[str, Callable[[Trial], float | None]], list[str]]:
    found = {name: chain(name) for name in ESTIMATORS}
    if not report.version("pyroomacoustics"):
        return found, list(PEERS)
    return found | {f"pyroomacoustics {name}": peer(name) for name in PEERS}, []


# --- cells --------------------------------------------------------------------------------------------

CELLS: dict[str, tuple[Callable[..., Trial], tuple[Any, ...]]] = {
    **{
        f"{kind} {snr:+d} dB": (plain, (kind, snr))
        for kind in ("white", "speech", "scream")
        for snr in (0, 5, 10, 20, 30)
    },
    **{
        f"{kind} {snr:+d} dB under rotors": (under_rotors, (kind, snr))
        for kind, snr in (("speech", -10), ("speech", 0), ("scream", -15), ("scream", -5))
    },
    **{
        f"{kind} {snr:+d} dB under hunting rotors": (partial(under_rotors, noise=hunting_noise), (kind, snr))
        for kind, snr in (("speech", 0), ("scream", -5))
    },
}


def run(trials: int, names: list[str], only: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    methods = {name: method for name, method in judges()[0].items() if not only or name in only}
    for cell in names:
        make, arguments = CELLS[cell]
        errors: dict[str, list[float]] = {name: [] for name in methods}
        silent = dict.fromkeys(methods, 0)
        bounds = []
        for seed in tqdm(range(trials), desc=cell, leave=False, disable=not sys.stderr.isatty()):
            trial = make(*arguments, np.random.default_rng([seed, len(cell)]))
            bounds.append(trial.bound_deg)
            for name, method in methods.items():
                azimuth = method(trial)
                # no bearing is an answer, told apart, and counts as the mean error of a guess
                silent[name] += azimuth is None
                error = math.pi / 2 if azimuth is None else abs(wrap(azimuth - trial.azimuth))
                errors[name].append(math.degrees(error))
        yield (
            cell,
            {
                "bound_deg": None if math.isnan(bounds[0]) else float(np.mean(bounds)),
                **{
                    name: {
                        "mean_deg": float(np.mean(values)),
                        "median_deg": float(np.median(values)),
                        "beyond_15_deg": float(np.mean(np.array(values) > 15)),
                        "no_bearing": silent[name] / trials,
                    }
                    for name, values in errors.items()
                },
            },
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=500, help="per cell (default 500)")
    parser.add_argument("--quick", action="store_true", help="10 trials of three cells")
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME", help="of the estimators, not all")
    parser.add_argument("--output", type=Path, default=report.default("accuracy"))
    arguments = parser.parse_args()
    names = ["white +10 dB", "speech +0 dB", "scream -5 dB under rotors"] if arguments.quick else list(CELLS)
    results = {}
    for cell, result in run(10 if arguments.quick else arguments.trials, names, arguments.only):
        results[cell] = result
        bound = result["bound_deg"]
        print(f"{cell}" + (f": bound {bound:.3f} degrees" if bound else ""))
        for name, r in result.items():
            if name != "bound_deg":
                times = f"{r['mean_deg'] / bound:8.2f} x" if bound else " " * 10
                print(
                    f"    {name:28}mean {r['mean_deg']:7.3f}  median {r['median_deg']:7.3f}  "
                    f"beyond 15 deg {r['beyond_15_deg']:6.1%} none {r['no_bearing']:6.1%}{times}"
                )
        sys.stdout.flush()
    report.write(arguments.output, missing=judges()[1], cells=results)


if __name__ == "__main__":
    main()
