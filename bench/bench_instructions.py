"""The kernel beside FFTW's bare transforms in instructions of the board's processor, counted without a board.

    python bench/bench_instructions.py [--output FILE]

An emulator (qemu-user, with count_insns.c as its plugin) knows how many aarch64 instructions a program takes:
the same number on every machine. It tells of work, not of time: not what waits for memory, nor how many
instructions go at once; four floats in one NEON instruction count as one. Per frame: the difference between
10 and 110 frames, so start and planning drop out. FFTW plans by estimate (fewest operations): what is fastest
in the emulator is not what is fastest on the board.

Goal, on the frame that flies: at most as many instructions as FFTW's six bare transforms. What is needed
(cross compiler, qemu-user, mmdebstrap for FFTW's library) is named where it is missing.
"""

import argparse
import subprocess
import sys
import tempfile
from dataclasses import asdict, astuple
from pathlib import Path

import report
from bench_kernel import CASES, CFLAGS, CSRC, SOURCES, Case

sys.path.insert(0, str(report.ROOT / "tests" / "vm"))
import debian

HERE = Path(__file__).parent
COMPILER = "aarch64-linux-gnu-gcc"
GOAL = 1.0
FEW, MANY = 10, 110


def plugin(folder: Path) -> Path:
    library = folder / "libcount.so"
    subprocess.run(["cc", "-O2", "-fPIC", "-shared", "-o", library, HERE / "count_insns.c"], check=True)
    return library


def program(folder: Path, system: Path) -> Path:
    """The kernel and FFTW for aarch64, with the product's own flags."""
    built = folder / "count_main"
    sources = [HERE / "count_main.c", HERE / "kernel_vs_fftw.c", *(CSRC / name for name in SOURCES)]
    subprocess.run(
        [COMPILER, *CFLAGS, "-static", "-DWITH_FFTW", "-DPLANNING=FFTW_ESTIMATE", f"-I{CSRC}", "-idirafter",
         system / "usr/include", *sources, system / "usr/lib/aarch64-linux-gnu/libfftw3f.a", "-lm",
         "-o", built],
        check=True,
    )  # fmt: skip
    return built


def per_frame(counter: Path, built: Path, what: str, case: Case) -> float:
    """Instructions for one frame."""
    mics, frame, lags, oversample, rate_hz, band_hz, floor, relative_floor = astuple(case)
    values = [mics, frame, lags, oversample, rate_hz, *band_hz, floor, relative_floor]
    counts = []
    for frames in (FEW, MANY):
        log = counter.with_name("count")
        subprocess.run(
            ["qemu-aarch64", "-cpu", "cortex-a72", "-plugin", counter, "-d", "plugin", "-D", log,
             built, what, str(frames), *map(str, values)],
            check=True,
        )  # fmt: skip
        counts.append(int(log.read_text()))
    return (counts[1] - counts[0]) / (MANY - FEW)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=report.RESULTS / "instructions-aarch64.json",
        help="where the numbers go (default: %(default)s)",
    )
    arguments = parser.parse_args()
    if lacking := debian.missing(COMPILER, "qemu-aarch64", "mmdebstrap"):
        print(f"skipped: {lacking} (sudo apt install gcc-aarch64-linux-gnu qemu-user mmdebstrap)")
        return
    system = debian.root()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        counter = plugin(folder)
        built = program(folder, system)
        kernel, fftw = (per_frame(counter, built, what, CASES["triangle"]) for what in ("kernel", "fftw"))
    report.write(
        arguments.output,
        compiler=report.compiler(COMPILER),
        flags=CFLAGS,
        emulator=report.compiler("qemu-aarch64"),
        case=asdict(CASES["triangle"]),
        instructions_per_frame={"kernel": kernel, "FFTW, bare transforms": fftw},
        ratio={"kernel / FFTW": kernel / fftw, "goal": GOAL},
    )
    print(f"aarch64 instructions per frame: kernel {kernel:.0f}, FFTW's bare transforms {fftw:.0f}")
    print(f"ratio {kernel / fftw:.2f}, goal {GOAL:g}; written: {arguments.output}")


if __name__ == "__main__":
    main()
