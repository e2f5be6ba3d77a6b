"""The steered search's speed and accuracy beside pyroomacoustics, on the same frames, in turns.

    python bench/bench_steered.py [--quick] [--output FILE]

Peers get what they need for the same answer: pyroomacoustics' NormMUSIC and SRP the same band, the frame as
seven overlapping pieces of 256 samples and a grid of one degree of azimuth on the horizon, where the sources
are (the search here has elevation free). Goals on the frame that flies: listen, learn, hear and search
together at most a tenth of NormMUSIC's time, and the mean error no greater.
"""

import argparse
import math
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import report

from locagen_edge.geometry import direction, equilateral, wrap
from locagen_edge.kernel import Steered

RATE_HZ, FRAME, SPEED_M_S = 10_000.0, 1024, 343.0
BAND_HZ = (300.0, 4700.0)
SNR_DB = 10.0
PIECE = 256

Samples = npt.NDArray[np.float32]
Finder = Callable[[Samples], float]


def frames(count: int, positions: npt.NDArray[np.float64]) -> list[tuple[Samples, float]]:
    """White noise in 300-4000 Hz from random azimuths, in white noise; with the truth."""
    rng = np.random.default_rng(0)
    f = np.fft.rfftfreq(4 * FRAME, 1 / RATE_HZ)
    made = []
    for _ in range(count):
        azimuth = rng.uniform(-math.pi, math.pi)
        spectrum = np.fft.rfft(rng.standard_normal(4 * FRAME)) * ((f >= 300) & (f <= 4000))
        early = positions @ direction(azimuth) / SPEED_M_S
        heard = np.fft.irfft(spectrum * np.exp(2j * np.pi * f * early[:, None]))[:, FRAME : 2 * FRAME]
        heard *= 0.1 / np.sqrt(np.mean(heard**2))
        heard += 0.1 * 10 ** (-SNR_DB / 20) * rng.standard_normal(heard.shape)
        made.append((heard.astype(np.float32), azimuth))
    return made


def steered(positions: npt.NDArray[np.float64], learn: bool) -> Finder:
    """Whole frame's work: with `learn` the noise's matrix of 100 frames, moved on with every frame."""
    found = Steered(positions, frame=FRAME, rate_hz=RATE_HZ, speed_m_s=SPEED_M_S, band_hz=BAND_HZ)
    rng = np.random.default_rng(1)
    noise = (0.1 * 10 ** (-SNR_DB / 20) * rng.standard_normal((100, len(positions), FRAME))).astype(
        np.float32
    )
    for n, samples in enumerate(noise if learn else ()):
        found.listen(samples)
        found.learn(1 / (n + 1))

    def find(samples: Samples) -> float:
        found.listen(samples)
        if learn:
            found.learn(1e-6)  # as much work as any share, and the call stays out of the noise
        found.hear()
        (source,) = found.search()
        return source.azimuth_rad

    return find


def pyroom(positions: npt.NDArray[np.float64], name: str) -> Finder | None:
    try:
        from pyroomacoustics import doa  # type: ignore[import-untyped]
    except ImportError:
        return None
    # Its azimuth is counter-clockwise: y changes sign.
    finder = doa.algorithms[name](
        (positions[:, :2] * [1, -1]).T,
        RATE_HZ,
        PIECE,
        c=SPEED_M_S,
        num_src=1,
        dim=2,
        azimuth=np.radians(np.arange(360.0)),
    )
    window = np.hanning(PIECE + 1)[:-1]

    def find(samples: Samples) -> float:
        pieces = np.lib.stride_tricks.sliding_window_view(samples, PIECE, axis=1)[:, :: PIECE // 2]
        finder.locate_sources(np.fft.rfft(pieces * window).transpose(0, 2, 1), freq_range=list(BAND_HZ))
        return -float(finder.azimuth_recon[0])

    return find


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--quick", action="store_true", help="few frames: a test that it runs")
    arguments.add_argument(
        "--output", type=Path, default=report.RESULTS / f"steered-{platform.machine()}.json"
    )
    options = arguments.parse_args()

    positions = equilateral().positions_m
    peers: dict[str, Finder] = {
        "steered, noise learnt": steered(positions, True),
        "steered, noise unknown": steered(positions, False),
    }
    missing = []
    for name in ("NormMUSIC", "SRP"):
        finder = pyroom(positions, name)
        if finder is None:
            missing.append(f"pyroomacoustics {name}: not installed")
        else:
            peers[f"pyroomacoustics {name}"] = finder
    times: dict[str, list[float]] = {name: [] for name in peers}
    errors: dict[str, list[float]] = {name: [] for name in peers}
    for samples, azimuth in frames(10 if options.quick else 300, positions):
        for name, find in peers.items():
            find(samples)  # warm caches, as a peer that runs alone would have
            start = time.perf_counter()
            found = find(samples)
            times[name].append(time.perf_counter() - start)
            errors[name].append(abs(math.degrees(wrap(found - azimuth))))

    ratios: dict[str, Any] = {}
    for ours in list(peers)[:2]:
        for other in list(peers)[2:]:
            values = report.summary(np.divide(times[ours], times[other]).tolist())
            ratios[f"{ours} / {other}"] = values | ({"goal": 0.1} if other.endswith("MUSIC") else {})
    results = {
        "us_per_frame": {name: report.summary([1e6 * t for t in values]) for name, values in times.items()},
        "mean_error_deg": {name: float(np.mean(values)) for name, values in errors.items()},
        "snr_db": SNR_DB,
        "ratios": ratios,
        "missing": missing,
    }
    pyroomacoustics = report.version("pyroomacoustics")
    report.write(options.output, compiler=report.compiler(), pyroomacoustics=pyroomacoustics, results=results)
    for name, values in results["us_per_frame"].items():
        print(f"{name:28} {values['median']:9.1f} us   mean error {results['mean_error_deg'][name]:.2f} deg")
    for name, values in ratios.items():
        goal = f"   goal {values['goal']:g}" if "goal" in values else ""
        print(f"{name:60} {values['median']:.4f}{goal}")
    print("\n".join(missing), f"\nwritten: {options.output}", sep="")


if __name__ == "__main__":
    main()
