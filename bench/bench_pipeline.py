"""The whole chain, frame to track: time of a hop for each estimator, with the `mask` too, and memory.

    python bench/bench_pipeline.py [--quick] [--output FILE]

The sound is the default scene, rendered beforehand. The peer, in turns in the same process, is the kernel
alone: what a hop costs beyond it is Python's.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import report

from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import from_table
from locagen_edge.sim.scene import frames
from locagen_edge.types import Frame

ESTIMATORS = ("steered", "far-field", "two-mic", "model:tdoa-mlp", "hyperbolic")
CHAINS = {
    **{name: from_table({"bearing": {"estimator": name}}) for name in ESTIMATORS},
    "steered, mask": from_table({"bearing": {"estimator": "steered"}, "denoise": {"kind": "mask"}}),
}


def measure(rounds: int) -> dict[str, Any]:
    """Seconds per hop of the kernel and of each chain, taken in turns on the same frames."""
    sound: list[Frame] = list(itertools.islice(frames(from_table({})), rounds))
    chains = {name: Pipeline(settings) for name, settings in CHAINS.items()}
    correlate = chains["far-field"]._correlate
    times: dict[str, list[float]] = {name: [] for name in ("kernel", *chains)}
    for frame in sound:
        start = time.perf_counter()
        correlate(frame)
        times["kernel"].append(time.perf_counter() - start)
        for name, chain in chains.items():
            start = time.perf_counter()
            chain.process(frame)
            times[name].append(time.perf_counter() - start)
    kernel = float(np.median(times["kernel"]))
    hop_s = from_table({}).hop_s
    return {
        name: {
            **report.summary(values),
            "max": max(values),
            "over_kernel": float(np.median(values)) / kernel,
            "share_of_hop": float(np.median(values)) / hop_s,
        }
        for name, values in times.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="200 hops instead of 4,000")
    parser.add_argument("--output", type=Path, default=report.default("pipeline"))
    arguments = parser.parse_args()
    results = measure(200 if arguments.quick else 4000)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    report.write(arguments.output, seconds_per_hop=results, peak_rss_mib=round(peak_mib, 1))
    print(f"{'':16}{'median':>10}{'p99':>10}{'max':>10}{'over kernel':>13}{'of a hop':>10}")
    for name, t in results.items():
        print(
            f"{name:16}{t['median'] * 1e6:7.0f} us{t['p99'] * 1e6:7.0f} us{t['max'] * 1e6:7.0f} us"
            f"{t['over_kernel']:12.1f}x{t['share_of_hop']:10.2%}"
        )
    print(f"peak memory {peak_mib:.0f} MiB; written to {arguments.output}")


if __name__ == "__main__":
    main()
