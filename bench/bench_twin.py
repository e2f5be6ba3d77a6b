"""Speed of the twin on one core.

    python bench/bench_twin.py [--samples 2000000] [--sound-s 30] [--repeats 5] [--quick] [--output FILE]

Arrivals: samples a second, for each way of rounding. Waveforms: times real time, for plain scenes (white
noise from somewhere in the disc, three microphones with noise of their own, 10 kHz) and for each thing that
can be added; `features` are the same through the flight's correlation and peak picking.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import report

from locagen_edge.geometry import equilateral
from locagen_edge.lab.columns import columns
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import from_table
from locagen_edge.sim import arrivals, waveforms
from locagen_edge.sim.arrivals import TwinSettings
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.waveforms import SceneSettings

SPEED_M_S = 343.0
RATE_HZ = 10_000.0
FRAME = 1024

CASES = {
    "default": TwinSettings(),
    "aligned, floor": TwinSettings(phase="aligned", rounding="floor"),
    "each phase, clocks, noise": TwinSettings(phase="each", clock_ppm=20.0, noise="fixed"),
    "no rounding": TwinSettings(rounding="none"),
    "sweep": TwinSettings(source="sweep"),
}

SCENES: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
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


def rates(work: Callable[[int], None], amount: float, repeats: int) -> dict[str, float]:
    """`amount` over the seconds that `work` takes, for as many seeds as repeats."""
    found = []
    for seed in range(repeats):
        start = time.perf_counter()
        work(seed)
        found.append(amount / (time.perf_counter() - start))
    return report.summary(found)


def of_arrivals(samples: int, repeats: int) -> dict[str, dict[str, float]]:
    """Samples a second."""
    array, found = equilateral(), {}
    for name, twin in CASES.items():
        noise_s = 1e-6 * twin.noise_us if twin.noise == "fixed" else 0.0

        def work(seed: int, twin: TwinSettings = twin, noise_s: float = noise_s) -> None:
            arrivals.draw(array, SPEED_M_S, RATE_HZ, twin, noise_s, samples, seed)

        found[name] = rates(work, samples, repeats)
    return found


def of_waveforms(seconds: float, repeats: int) -> dict[str, dict[str, float]]:
    """Times real time, `seconds` of sound per repeat."""
    array, found = equilateral(), {}
    for name, (n, twin, scene) in SCENES.items():
        count = max(1, round(seconds * RATE_HZ / n))
        settings = (TwinSettings(noise="snr", **twin), SceneSettings(**scene))

        def work(seed: int, n: int = n, count: int = count, settings: Any = settings) -> None:
            waveforms.draw(array, SPEED_M_S, RATE_HZ, n, *settings, count, seed)

        found[name] = rates(work, count * n / RATE_HZ, repeats)
    flown = from_table({"dataset": {"level": "waveforms"}, "twin": {"noise": "snr"}}, LabSettings)
    count = max(1, round(seconds * RATE_HZ / FRAME))

    def features(seed: int) -> None:
        columns(flown, count, seed)

    found["plain, a frame, features"] = rates(features, count * FRAME / RATE_HZ, repeats)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the twin on one core.")
    parser.add_argument("--samples", type=int, default=2_000_000, help="arrivals per repeat")
    parser.add_argument("--sound-s", type=float, default=30.0, help="sound per repeat and scene")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="only show that it works")
    parser.add_argument("--output", type=Path, default=report.default("twin"))
    arguments = parser.parse_args()
    samples, sound_s, repeats = (
        (20_000, 0.5, 2) if arguments.quick else (arguments.samples, arguments.sound_s, arguments.repeats)
    )
    per_s = of_arrivals(samples, repeats)
    real_time = of_waveforms(sound_s, repeats)
    report.write(arguments.output, arrivals_per_s=per_s, times_real_time=real_time)
    print("| arrivals | million samples a second |\n| --- | --- |")
    for name, values in per_s.items():
        print(f"| {name} | {values['median'] / 1e6:.1f} |")
    print("\n| waveforms | times real time |\n| --- | --- |")
    for name, values in real_time.items():
        print(f"| {name} | {values['median']:.0f} |")


if __name__ == "__main__":
    main()
