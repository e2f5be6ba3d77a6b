"""The kernel's speed beside numpy, pyroomacoustics and FFTW's bare transforms, taken in turns in one process.

    python bench/bench_kernel.py [--quick] [--output FILE]

Goals, on the frame that flies (3 microphones, 1024 samples): from C at most 0.8 of the time of FFTW's six
bare transforms, through Python at most 1.0; at least 8 times faster than numpy and 30 times faster than
pyroomacoustics. Peers that are not installed are left out, and named.
"""

import argparse
import ctypes
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import report

from locagen_edge.kernel import GccPhat

CSRC = report.ROOT / "csrc"
sys.path.insert(0, str(CSRC))
from build_kernel import CFLAGS, SOURCES  # noqa: E402  (reads the header, builds nothing)

Samples = npt.NDArray[np.float32]
Peers = dict[str, Callable[[], float]]


@dataclass(frozen=True)
class Case:
    """One configuration: what the kernel is asked, in its own words."""

    mics: int
    frame: int
    lags: int
    oversample: int
    rate_hz: float
    band_hz: tuple[float, float]
    floor: float = 1e-12
    relative_floor: float = 1e-3

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return list(itertools.combinations(range(self.mics), 2))


CASES = {
    # 10 cm: 2.9 samples at 10 kHz, and one more each side.
    "triangle": Case(3, 1024, 63, 16, 10_000.0, (300.0, 4700.0)),
    # Eight microphones over a metre, at 48 kHz: 140 samples.
    "wide": Case(8, 4096, 2240, 16, 48_000.0, (300.0, 4700.0)),
}
GOALS = {  # name: (numerator, denominator, limit); a ratio of times
    "kernel from C / FFTW": ("kernel, C", "FFTW, bare transforms", 0.8),
    "kernel from Python / FFTW": ("kernel, Python", "FFTW, bare transforms", 1.0),
    "kernel from Python / numpy": ("kernel, Python", "numpy", 1 / 8),
    "kernel from Python / pyroomacoustics": ("kernel, Python", "pyroomacoustics", 1 / 30),
}


class Config(ctypes.Structure):
    """`locagen_gcc_config`."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("mics", "frame", "lags", "oversample")),
        *((name, ctypes.c_float) for name in ("rate", "band_low", "band_high", "floor", "relative_floor")),
    )


def build(folder: Path) -> tuple[ctypes.CDLL, bool]:
    """kernel_vs_fftw.c as a library, and whether FFTW is in it."""
    library = folder / "kernel_vs_fftw.so"
    sources = [report.ROOT / "bench" / "kernel_vs_fftw.c", *(CSRC / name for name in SOURCES)]
    command = ["cc", *CFLAGS, "-fPIC", "-shared", f"-I{CSRC}", *map(str, sources), "-o", str(library)]
    with_fftw = subprocess.run([*command, "-DWITH_FFTW", "-lfftw3f", "-lm"], capture_output=True, check=False)
    if with_fftw.returncode != 0:
        subprocess.run([*command, "-lm"], check=True)
    found = ctypes.CDLL(str(library))
    found.bench_kernel.restype = ctypes.c_double
    if with_fftw.returncode == 0:
        found.bench_fftw.restype = ctypes.c_double
    return found, with_fftw.returncode == 0


def mean_time(call: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        call()
    return (time.perf_counter() - start) / calls


def numpy_gcc_phat(case: Case) -> Callable[[Samples], npt.NDArray[np.floating]]:
    """GCC-PHAT as one writes it well in numpy: pairs in one batch, zero-padded to the finer grid."""
    window = np.hanning(case.frame + 1)[:-1].astype(np.float32)
    low, high = (edge * case.frame / case.rate_hz for edge in case.band_hz)
    band = slice(int(np.ceil(low)), int(np.floor(high)) + 1)
    first, second = (list(side) for side in zip(*case.pairs, strict=True))
    whole = case.frame * case.oversample
    gain = np.float32(2 / (case.frame * np.sum(window**2)))  # power of a bin, as mean square
    share = np.float32(whole / 2 / (band.stop - band.start))  # of one bin in a correlation that peaks at 1

    def process(samples: Samples) -> npt.NDArray[np.floating]:
        spectra = np.fft.rfft(samples * window)[:, band]
        power = gain * (spectra.real**2 + spectra.imag**2)
        floor = np.maximum(case.floor, case.relative_floor * power.mean(axis=1))
        unit = spectra * np.sqrt(gain / (power + floor[:, None]))
        padded = np.zeros((len(first), whole // 2 + 1), spectra.dtype)
        padded[:, band] = unit[second] * unit[first].conj()
        correlation = np.fft.irfft(padded, whole)
        return share * np.concatenate([correlation[:, -case.lags :], correlation[:, : case.lags + 1]], axis=1)

    return process


def pyroomacoustics_tdoa() -> Callable[..., float] | None:
    try:
        from pyroomacoustics.experimental.localization import tdoa  # type: ignore[import-untyped]
    except ImportError:
        return None
    found: Callable[..., float] = tdoa
    return found


def peers(
    case: Case, samples: Samples, library: ctypes.CDLL, with_fftw: bool, budget_s: float
) -> tuple[Peers, list[str]]:
    """Each peer as a function that takes `budget_s` or a little more and returns seconds per frame."""
    found: Peers = {}
    missing: list[str] = []
    pointer = samples.ctypes.data_as(ctypes.POINTER(ctypes.c_float))

    def add(name: str, timed: Callable[[int], float]) -> None:
        calls = max(1, int(budget_s / timed(2)))
        found[name] = lambda: timed(calls)

    fields = (case.mics, case.frame, case.lags, case.oversample, case.rate_hz, *case.band_hz)
    code = library.bench_kernel_init(ctypes.byref(Config(*fields, case.floor, case.relative_floor)), pointer)
    if code != 0:
        raise SystemExit(f"the kernel refuses {case}: {code}")
    add("kernel, C", library.bench_kernel)
    kernel = GccPhat(**asdict(case))
    add("kernel, Python", lambda calls: mean_time(partial(kernel.process, samples), calls))
    if with_fftw and library.bench_fftw_init(case.mics, case.frame, pointer) == 0:
        add("FFTW, bare transforms", library.bench_fftw)
    else:
        missing.append("FFTW, bare transforms: libfftw3f is not installed (Debian: libfftw3-dev)")
    plain = numpy_gcc_phat(case)
    # The same question has the same answer, or there is nothing to compare.
    np.testing.assert_allclose(plain(samples), kernel.process(samples)[0], atol=1e-3)
    add("numpy", lambda calls: mean_time(partial(plain, samples), calls))
    tdoa = pyroomacoustics_tdoa()
    if tdoa is None:
        missing.append("pyroomacoustics: not installed")
    else:

        def all_pairs() -> None:
            for i, j in case.pairs:
                tdoa(samples[j], samples[i], interp=case.oversample, fs=case.rate_hz)

        add("pyroomacoustics", lambda calls: mean_time(all_pairs, calls))
    return found, missing


def measure(found: Peers, rounds: int, seconds: float) -> dict[str, list[float]]:
    """Lets the peers take turns, `rounds` times, or until `seconds` have passed, but five times at least."""
    times: dict[str, list[float]] = {name: [] for name in found}
    end = time.perf_counter() + seconds
    for done in range(rounds):
        for name, timed in found.items():
            times[name].append(timed())
        if done >= 4 and time.perf_counter() > end:
            break
    return times


def bench(case: Case, library: ctypes.CDLL, with_fftw: bool, quick: bool) -> dict[str, Any]:
    samples = (0.1 * np.random.default_rng(0).standard_normal((case.mics, case.frame))).astype(np.float32)
    found, missing = peers(case, samples, library, with_fftw, 2e-4 if quick else 1e-3)
    times = measure(found, 5 if quick else 1000, 20.0)
    ratios = {
        name: report.summary(np.divide(times[above], times[below]).tolist())
        | ({"goal": limit} if case == CASES["triangle"] else {})
        for name, (above, below, limit) in GOALS.items()
        if above in times and below in times
    }
    return {
        "case": asdict(case),
        "rounds": len(times["kernel, C"]),
        "us_per_frame": {name: report.summary([1e6 * t for t in values]) for name, values in times.items()},
        "ratios": ratios,
        "missing": missing,
    }


def show(name: str, result: dict[str, Any], goals: bool) -> None:
    case = result["case"]
    print(f"\n{name}: {case['mics']} microphones, {case['frame']} samples, {2 * case['lags'] + 1} lags")
    print(f"  {'us per frame':38}{'median':>10}{'min':>10}{'p99':>10}")
    for peer, us in result["us_per_frame"].items():
        print(f"  {peer:38}{us['median']:10.2f}{us['min']:10.2f}{us['p99']:10.2f}")
    print(f"  {'ratio of times, within a round':38}{'median':>10}{'min':>10}{'p99':>10}")
    for pair, ratio in result["ratios"].items():
        words = f"   goal {ratio['goal']:.3f}" if goals else ""
        print(f"  {pair:38}{ratio['median']:10.3f}{ratio['min']:10.3f}{ratio['p99']:10.3f}{words}")
    for line in result["missing"]:
        print(f"  left out: {line}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a few rounds: whether it runs, not how fast")
    parser.add_argument(
        "--output",
        type=Path,
        default=report.default("kernel"),
        help="where the numbers go (default: %(default)s)",
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        library, with_fftw = build(Path(folder))
        results = {name: bench(case, library, with_fftw, arguments.quick) for name, case in CASES.items()}
    report.write(
        arguments.output,
        compiler=report.compiler(),
        flags=CFLAGS,
        pyroomacoustics=report.version("pyroomacoustics"),
        results=results,
    )
    for name, result in results.items():
        show(name, result, goals=name == "triangle")
    print(f"\nwritten: {arguments.output}")


if __name__ == "__main__":
    main()
