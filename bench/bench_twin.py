"""Speed of the twin on one core, as JSON.

Arrivals: samples a second, for each way of rounding. Waveforms: times real time, for plain scenes (white
noise from somewhere in the disc, three microphones with noise of their own, 10 kHz) and for each thing that
can be added; `features` are the same through the flight's correlation and peak picking.

python bench/bench_twin.py [--samples 2000000] [--sound-s 30] [--repeats 5]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time

import numpy as np

from locagen_edge.geometry import equilateral
from locagen_edge.lab.columns import columns
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import from_table
from locagen_edge.sim import waveforms
from locagen_edge.sim.arrivals import TwinSettings, draw
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.waveforms import SceneSettings

CASES = {
    "default": TwinSettings(),
    "aligned, floor": TwinSettings(phase="aligned", rounding="floor"),
    "each phase, clocks, noise": TwinSettings(phase="each", clock_ppm=20.0, noise="fixed"),
    "no rounding": TwinSettings(rounding="none"),
    "sweep": TwinSettings(source="sweep"),
}


RATE_HZ = 10_000.0
FRAME = 1024

SCENES: dict[str, tuple[int, dict, dict]] = {
    "plain, a frame": (FRAME, {}, {}),
    "plain, 1 s": (10_000, {}, {}),
    "plain, 10 s": (100_000, {}, {}),
    **{f"{kind}, a frame": (FRAME, {}, {"sounds": (kind,)}) for kind in CALLS if kind != "white"},
    "ground": (FRAME, {}, {"ground": 0.5}),
    "clocks": (FRAME, {"clock_ppm": 20.0}, {}),
    "wind": (FRAME, {}, {"wind_m_s": 5.0}),
    "four rotors": (FRAME, {}, {"rotors": 4}),
}
"""length in samples, what differs in [twin], what differs in [scene]"""


def times_real_time(seconds: float, repeats: int) -> list[dict]:
    """Of every scene, `seconds` of sound per repeat."""
    array, results = equilateral(), []
    for name, (n, twin, scene) in SCENES.items():
        count = max(1, round(seconds * RATE_HZ / n))
        settings = (TwinSettings(noise="snr", **twin), SceneSettings(**scene))
        rates = []
        for seed in range(repeats):
            start = time.perf_counter()
            waveforms.draw(array, 343.0, RATE_HZ, n, *settings, count, seed)
            rates.append(count * n / RATE_HZ / (time.perf_counter() - start))
        results.append({"case": name, "samples_of": n, "times_real_time": spread(rates)})
    settings = from_table({"dataset": {"level": "waveforms"}, "twin": {"noise": "snr"}}, LabSettings)
    count, rates = max(1, round(seconds * RATE_HZ / FRAME)), []
    for seed in range(repeats):
        start = time.perf_counter()
        columns(settings, count, seed)
        rates.append(count * FRAME / RATE_HZ / (time.perf_counter() - start))
    results.append(
        {"case": "plain, a frame, features", "samples_of": FRAME, "times_real_time": spread(rates)}
    )
    return results


def spread(rates: list[float]) -> dict[str, float]:
    return {"median": statistics.median(rates), "least": min(rates), "most": max(rates)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the twin on one core.")
    parser.add_argument(
        "--samples", type=int, default=2_000_000, help="arrivals per repeat (default 2,000,000)"
    )
    parser.add_argument(
        "--sound-s", type=float, default=30.0, help="sound per repeat and scene (default 30 s)"
    )
    parser.add_argument("--repeats", type=int, default=5, help="(default 5)")
    arguments = parser.parse_args()
    array = equilateral()
    results = []
    for name, twin in CASES.items():
        noise_s = 1e-6 * twin.noise_us if twin.noise == "fixed" else 0.0
        seconds = []
        for seed in range(arguments.repeats):
            start = time.perf_counter()
            draw(array, 343.0, 10_000.0, twin, noise_s, arguments.samples, seed)
            seconds.append(time.perf_counter() - start)
        rates = [arguments.samples / s for s in seconds]
        results.append({
            "case": name,
            "samples": arguments.samples,
            "per_s": spread(rates),
        })  # fmt: skip
    sound = times_real_time(arguments.sound_s, arguments.repeats)
    machine = {"machine": platform.machine(), "python": platform.python_version(), "numpy": np.__version__}
    print(json.dumps({"bench": "twin", "machine": machine, "results": results, "waveforms": sound}, indent=2))


if __name__ == "__main__":
    main()
