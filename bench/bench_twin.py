"""Speed of the twin's arrivals on one core: samples a second, for each way of rounding. Prints JSON.

python bench/bench_twin.py [--samples 2000000] [--repeats 5]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time

import numpy as np

from locagen_edge.geometry import equilateral
from locagen_edge.sim.arrivals import TwinSettings, draw

CASES = {
    "default": TwinSettings(),
    "aligned, floor": TwinSettings(phase="aligned", rounding="floor"),
    "each phase, clocks, noise": TwinSettings(phase="each", clock_ppm=20.0, noise="fixed"),
    "no rounding": TwinSettings(rounding="none"),
    "sweep": TwinSettings(source="sweep"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Samples a second of the twin's arrivals on one core.")
    parser.add_argument("--samples", type=int, default=2_000_000, help="per repeat (default 2,000,000)")
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
            "per_s": {"median": statistics.median(rates), "least": min(rates), "most": max(rates)},
        })  # fmt: skip
    machine = {"machine": platform.machine(), "python": platform.python_version(), "numpy": np.__version__}
    print(json.dumps({"bench": "twin", "machine": machine, "results": results}, indent=2))


if __name__ == "__main__":
    main()
