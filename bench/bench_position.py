"""Positions: error, truth of the covariance, and time of a look, on simulated flights.

    python bench/bench_position.py [--quick] [--output FILE] [--figure FILE.png]

The mean normalised error squared is 2 where covariances are true. Beside the filter as it flies stand what it
would be without its parts: one filter instead of the bank along the first ray (at the middle of the logarithm
of ranges, as uncertain as all of them), and errors of compass and attitude taken for noise of each look
(added to its sigma). The figure shows one flight of bearings alone past a caller, with 95 % ellipses.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import report

from locagen_edge.settings import PositionSettings
from locagen_edge.sim.flights import Errors, Flight, drawn, fly, line, miss_m, normalised_error
from locagen_edge.stages import position
from locagen_edge.stages.position import Positioner
from locagen_edge.types import Sighting

SETTINGS = PositionSettings()
Maker = Callable[[np.random.Generator], Flight]
Change = Callable[[Sighting], Sighting]


def passing(rng: np.random.Generator) -> Flight:
    """50 m away, 20 m of path across, 1 degree, no elevations: every lasting error at its usual size."""
    path = line(4.0, 4.0, np.array([0.0, -10.0]), 5.0, math.pi / 2.0, 20.0)
    return fly(path, np.array([50.0, 0.0]), Errors(), rng, elevations=False)


def hovering(rng: np.random.Generator) -> Flight:
    """20 m high, 30 m out, 5 s, 1 degree of azimuth."""
    path = line(5.0, 4.0, np.zeros(2), 0.0, 0.0, 20.0)
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    caller = 30.0 * np.array([math.cos(azimuth), math.sin(azimuth)])
    return fly(path, caller, Errors(cosine_rad=math.radians(1.0) * 30.0 / math.hypot(20.0, 30.0)), rng)


def as_it_is(look: Sighting) -> Sighting:
    return look


def as_noise(look: Sighting) -> Sighting:
    """Errors of compass and attitude as if they were each look's own."""
    return replace(
        look,
        azimuth_sigma_rad=math.hypot(look.azimuth_sigma_rad, look.azimuth_bias_sigma_rad),
        elevation_sigma_rad=math.hypot(look.elevation_sigma_rad, look.elevation_bias_sigma_rad),
        azimuth_bias_sigma_rad=0.0,
        elevation_bias_sigma_rad=0.0,
    )


@contextmanager
def one_filter() -> Iterator[None]:
    """The bank as one filter over all ranges."""
    spacing = position.SPACING
    least, most = SETTINGS.range_m
    position.SPACING = 0.999 * math.log(most / least)
    try:
        yield
    finally:
        position.SPACING = spacing


def judged(make: Maker, flights: int, change: Change = as_it_is) -> dict[str, float]:
    """Errors and their truth over simulated flights."""
    rng = np.random.default_rng(0)
    errors, values, unknown = [], [], 0
    for _ in range(flights):
        flight = make(rng)
        positioner = Positioner(SETTINGS)
        for look in flight.sightings:
            positioner.see(change(look))
        told = positioner.position(1, flight.sightings[-1].t_ns)
        if told is None or told.latitude_deg is None or told.longitude_deg is None:
            unknown += 1
            continue
        errors.append(math.hypot(*miss_m(flight, told.latitude_deg, told.longitude_deg)))
        values.append(normalised_error(flight, told.latitude_deg, told.longitude_deg, told.covariance_m2))
    return {
        "flights": flights,
        "no_place": unknown,
        "median_error_m": round(float(np.median(errors)), 2),
        "mean_normalised_error": round(float(np.mean(values)), 2),
        "within_95": round(float(np.mean(np.array(values) < 5.991)), 3),
    }


def timed(flights: int) -> dict[str, float]:
    """Microseconds of one look with both angles, and of telling."""
    rng = np.random.default_rng(1)
    spent = []
    for _ in range(flights):
        flight = drawn(rng)
        positioner = Positioner(SETTINGS)
        for look in flight.sightings:
            before = time.perf_counter()
            positioner.see(look)
            positioner.position(1, look.t_ns)
            spent.append(1e6 * (time.perf_counter() - before))
    return report.summary(spent)


def figure(path: Path) -> None:
    """One flight of bearings alone: rays, 95 % ellipses as looks come in, and the caller."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from locagen_edge.export import ellipse, event

    rng = np.random.default_rng(3)
    track = line(8.0, 4.0, np.array([0.0, -20.0]), 5.0, math.pi / 2.0, 20.0)
    flight = fly(track, np.array([50.0, 5.0]), Errors(), rng, elevations=False)
    positioner = Positioner(SETTINGS)
    plot, axes = plt.subplots(figsize=(8, 6.5), layout="constrained")
    for k, look in enumerate(flight.sightings):
        positioner.see(look)
        north, east = miss_m(flight, look.latitude_deg, look.longitude_deg)
        reach = 90.0 * np.array([math.sin(look.azimuth_rad), math.cos(look.azimuth_rad)])
        axes.plot([east, east + reach[0]], [north, north + reach[1]], color="tab:blue", alpha=0.12, lw=0.8)
        told = positioner.position(1, look.t_ns)
        place = event(told, look.t_ns) if told is not None else None
        if place is None or k % 4 != 3:
            continue
        ring = np.array([miss_m(flight, lat, lon) for lon, lat in ellipse(place)])
        colour = plt.get_cmap("viridis")(k / len(flight.sightings))
        axes.plot(ring[:, 1], ring[:, 0], color=colour, label=f"after {k + 1} looks, {track.time_s[k]:.1f} s")
    path_m = track.place_m - flight.caller_m[-1]
    axes.plot(path_m[:, 1], path_m[:, 0], "k.-", label="vehicle, 5 m/s")
    axes.plot(0.0, 0.0, "r*", markersize=14, label="caller, true")
    axes.set(
        xlabel="east of the caller (m)", ylabel="north (m)", aspect="equal", xlim=(-60, 60), ylim=(-58, 45)
    )
    axes.set_title("Bearings alone, 1°, with 2° of compass and 1.5 m of GPS: 95 % ellipses")
    axes.legend(loc="lower left", fontsize=8)
    axes.grid(alpha=0.3)
    plot.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(plot)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few flights: only to see that it runs")
    parser.add_argument("--output", type=Path, default=report.default("position"))
    parser.add_argument("--figure", type=Path, help="draw one flight")
    arguments = parser.parse_args()
    flights = 20 if arguments.quick else 1000
    results: dict[str, Any] = {
        "50 m away, 20 m of path, bearings alone": judged(passing, flights),
        "hover 20 m high, 30 m out": judged(hovering, flights),
        "any flight": judged(drawn, flights),
        "any flight, compass and attitude as noise": judged(drawn, flights, as_noise),
    }
    with one_filter():
        results["any flight, one filter"] = judged(drawn, flights)
    results["us_per_look"] = timed(max(flights // 10, 2))
    report.write(arguments.output, results=results)
    for name, values in results.items():
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in values.items()))
    if arguments.figure:
        figure(arguments.figure)
        print(arguments.figure)
    print(arguments.output)


if __name__ == "__main__":
    main()
