"""False calls in an hour of rotors alone, and how many calls are found, when and where.

    python bench/bench_detection.py [--minutes N] [--trials N] [--quick] [--output FILE]

The pipeline as it flies, with the default settings. Noise alone: streams of 5 minutes, of which the first
10 s (of learning) are told apart; a false call is one that begins. Calls: one of 1 s, after 14 s of noise,
found when a frame of it is taken for a call; the onset as told with the last such frame; the error of the
track then, and of the last bearing of all calls (a guess, 90 degrees, where there is none); sigma: share of
the bearings in calls within 1 and 2 of their sigmas. The microphones stand where the settings say to within
`array.tolerance_m`, as those sigmas suppose.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
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
from locagen_edge.sim.propagation import plane_wave
from locagen_edge.types import F64, Estimate, Frame

RATE = noises.RATE
STREAM_S = 300.0
LEARNING_S = 10.0
CALL_AT_S, CALL_S, AFTER_S = 14.0, 1.0, 2.0
FADE = round(0.01 * RATE)
KINDS = ("scream", "speech", "whistle")
SNRS_DB = (-5, -10, -15, -20)
DEFAULT: Settings = from_table({})


def estimates(sound: F64, positions: F64) -> Iterator[tuple[float, Estimate]]:
    """Time of each frame's end, and what the pipeline says."""
    settings: Settings = from_table({"array": {"positions_m": positions.tolist()}})
    pipeline, audio = Pipeline(settings), settings.audio
    samples = (0.02 * sound).astype(np.float32)
    for start in range(0, samples.shape[1] - audio.frame + 1, audio.hop):
        frame = Frame(
            samples[:, start : start + audio.frame].copy(), float(RATE), round(start / RATE * 1e9), start
        )
        yield (start + audio.frame) / RATE, pipeline.process(frame)


def false_calls(name: str, minutes: float, usual: F64) -> dict[str, float]:
    """Calls that begin in noise alone."""
    positions = noises.positions_of(name, usual)
    begun = {"learning": 0, "later": 0}
    confirmed = 0
    streams = max(1, round(minutes * 60.0 / STREAM_S))
    seconds = min(STREAM_S, minutes * 60.0)
    for number in tqdm(range(streams), desc=f"{name}, alone", leave=False, disable=not sys.stderr.isatty()):
        rng = np.random.default_rng([5, number, len(name)])
        sound = noises.NOISES[name](seconds, positions, number, rng)
        calling, heard = False, set()
        for time_s, estimate in estimates(sound, positions):
            late = time_s > LEARNING_S
            if estimate.detection.call and not calling:
                begun["later" if late else "learning"] += 1
            calling = estimate.detection.call
            heard |= {track.id for track in estimate.tracks if track.confirmed and late}
        confirmed += len(heard)
    hours = streams * (seconds - LEARNING_S) / 3600.0
    return {
        "hours": hours,
        "false_calls": begun["later"],
        "false_calls_per_hour": begun["later"] / hours,
        "confirmed_tracks": confirmed,
        "false_calls_while_learning_per_start": begun["learning"] / streams,
    }


def called(kind: str, positions: F64, rng: np.random.Generator) -> tuple[F64, float]:
    """(mics, samples) of a call from somewhere below, and its azimuth."""
    call = CALLS[kind](round(CALL_S * RATE), RATE, 0.48 * RATE, rng)
    positions = positions + rng.normal(0.0, DEFAULT.array.tolerance_m, positions.shape)
    call[:FADE] *= np.linspace(0.0, 1.0, FADE)
    call[-FADE:] *= np.linspace(1.0, 0.0, FADE)
    azimuth, elevation = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(-60.0, -10.0))
    guarded = np.pad(call, 128)
    u = direction(azimuth, elevation)
    return plane_wave(guarded, RATE, positions, u, DEFAULT.speed_m_s)[:, 128:-128], azimuth


def one_call(name: str, kind: str, snr_db: float, number: int, usual: F64) -> dict[str, Any]:
    positions = noises.positions_of(name, usual)
    rng = np.random.default_rng([9, number, len(name)])
    noise = noises.NOISES[name](CALL_AT_S + CALL_S + AFTER_S, positions, number, rng)
    call, azimuth = called(kind, positions, rng)
    found: dict[str, Any] = {"onset_s": None, "error_deg": None, "last_deg": 90.0, "over_sigma": []}
    for time_s, estimate in estimates(noises.mixed(noise, call, CALL_AT_S, snr_db), positions):
        if not CALL_AT_S < time_s < CALL_AT_S + CALL_S + 0.15:
            continue
        bearing, track = estimate.bearing, estimate.track
        if bearing.azimuth_rad is not None:
            found["last_deg"] = math.degrees(abs(wrap(bearing.azimuth_rad - azimuth)))
        if estimate.detection.call:
            found["onset_s"] = time_s - estimate.detection.since_s - CALL_AT_S
            if bearing.azimuth_rad is not None:
                error = abs(wrap(bearing.azimuth_rad - azimuth))
                found["over_sigma"].append(error / bearing.azimuth_sigma_rad)
            if track is not None:
                found["error_deg"] = math.degrees(abs(wrap(track.azimuth_rad - azimuth)))
    return found


def calls(name: str, kind: str, snr_db: float, trials: int, usual: F64) -> dict[str, Any]:
    what = f"{name}, {kind} {snr_db:+d} dB"
    progress = tqdm(range(trials), desc=what, leave=False, disable=not sys.stderr.isatty())
    found = [one_call(name, kind, snr_db, number, usual) for number in progress]
    onsets = [f["onset_s"] for f in found if f["onset_s"] is not None]
    errors = [f["error_deg"] for f in found if f["error_deg"] is not None]
    ratios = np.array([ratio for f in found for ratio in f["over_sigma"]])
    return {
        "found": len(onsets) / trials,
        "onset_within_0.2_s": float(np.mean(np.abs(onsets) < 0.2)) if onsets else None,
        "median_track_error_deg": float(np.median(errors)) if errors else None,
        "beyond_15_deg": float(np.mean(np.array(errors) > 15.0)) if errors else None,
        "median_last_bearing_error_deg": float(np.median([f["last_deg"] for f in found])),
        "within_1_sigma": float(np.mean(ratios < 1.0)) if len(ratios) else None,
        "within_2_sigma": float(np.mean(ratios < 2.0)) if len(ratios) else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of each noise alone (default 60)")
    parser.add_argument("--trials", type=int, default=40, help="calls of each kind and SNR (default 40)")
    parser.add_argument("--quick", action="store_true", help="half a minute and 2 trials, simulated only")
    parser.add_argument("--output", type=Path, default=report.default("detection"))
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.minutes, arguments.trials = 0.5, 2
    usual = DEFAULT.mic_array.positions_m
    silent = arguments.quick or noises.recordings() is None
    names = [name for name in noises.NOISES if not (silent and name in noises.RECORDED)]
    alone, with_call = {}, {}
    for name in names:
        alone[name] = false_calls(name, arguments.minutes, usual)
        print(
            f"{name}: {alone[name]['false_calls']} false calls in {alone[name]['hours']:.2f} h, "
            f"{alone[name]['false_calls_while_learning_per_start']:.2f} while learning",
            flush=True,
        )
        for kind in KINDS[:1] if arguments.quick else KINDS:
            for snr_db in SNRS_DB[:1] if arguments.quick else SNRS_DB:
                result = calls(name, kind, snr_db, arguments.trials, usual)
                with_call[f"{name}, {kind} {snr_db:+d} dB"] = result
                told = ", ".join(
                    f"{key} {value:.2f}" if value is not None else f"{key} -" for key, value in result.items()
                )
                print(f"    {kind} {snr_db:+d} dB: {told}", flush=True)
    report.write(
        arguments.output,
        noise_alone=alone,
        calls=with_call,
        missing=[n for n in noises.NOISES if n not in names],
    )


if __name__ == "__main__":
    main()
