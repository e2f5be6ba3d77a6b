"""The whole flight side on aarch64: the package's files replay recordings, with the bearings of this machine.

    python tests/arm/replay.py PACKAGE.deb

Debian's Python for arm64, PyPI's aarch64 wheels and the cross-built kernel run under qemu-user, without root
rights; beside it the same recordings go through this checkout. Exit code 0: equal within TOLERANCE, or
skipped where a tool is missing, saying so.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import soundfile

from locagen_edge.settings import from_table
from locagen_edge.sim.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "vm"))
import debian  # noqa: E402

EMULATOR = "qemu-aarch64-static"
SETTINGS = {
    "steered": "",
    "mask": '[denoise]\nkind = "mask"\n',
    "wave": '[denoise]\nkind = "wave"\n',
    "far-field": '[bearing]\nestimator = "far-field"\n',
    "hyperbolic": '[bearing]\nestimator = "hyperbolic"\n',
    "learned": '[bearing]\nestimator = "model:tdoa-mlp"\n',
}
TOLERANCE = {
    "azimuth_deg": 0.01, "elevation_deg": 0.02, "sigma_deg": 0.01, "snr_db": 0.01,
}  # fmt: skip
"""Sums of float32 are made in another order (NEON's four lanes, AVX2's eight), some 1e-6 of what is summed;
a hundredth of a degree is a fiftieth of what a millimetre of a microphone's place costs. Where a frame's best
two directions are alike, the one or the other may win: that may be in OTHERWISE of the frames."""
OTHERWISE = 0.02
NETWORK = 10.0
"""How much more a network between sound and bearing may bring: onnxruntime's kernels differ too."""
ARRAY = "[array]\npositions_m = [[0.055, -0.055, 0.0], [0.055, 0.055, 0.0], [-0.055, 0.055, 0.0]]\n"
"""of the shared recordings of four microphones: the first three"""
SECONDS = 4.0


def recordings(folder: Path) -> dict[str, tuple[Path, str]]:
    """Files by name, and what settings they need: a simulated scene; a recorded motor where it is at hand."""
    made = folder / "scene.wav"
    settings = from_table({"sim": {"call": "speech", "snr_db": 5.0, "turn_deg_s": 30.0}})
    scene = Scene(settings)
    count = round(SECONDS * settings.audio.rate_hz / 1000)
    rows = np.concatenate([scene.render(1000) for _ in range(count)], axis=1).T
    soundfile.write(made, rows, settings.audio.rate_hz, subtype="PCM_16")
    found = {"simulated": (made, "")}
    shared = Path(os.environ.get("LOCAGEN_RECORDINGS", ROOT.parent / "shared" / "data" / "audio"))
    for path in sorted((shared / "array").glob("*.flac"))[:1]:
        piece = folder / f"{path.stem}.wav"
        with soundfile.SoundFile(path) as file:
            file.seek(file.samplerate)
            soundfile.write(
                piece, file.read(round(SECONDS * file.samplerate)), file.samplerate, subtype="PCM_16"
            )
        found["recorded"] = (piece, ARRAY)
    if "recorded" not in found:
        print(f"no recordings in {shared / 'array'} (LOCAGEN_RECORDINGS): only a simulated scene is replayed")
    return found


def replay(command: list[str | Path], environment: dict[str, str], recording: Path) -> list[dict]:
    """The lines of `locagen-edge replay`."""
    done = subprocess.run(
        [*command, "-m", "locagen_edge", "replay", recording, "--settings", recording.with_suffix(".toml")],
        env=environment, cwd=recording.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stderr}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def differences(here: list[dict], there: list[dict], network: bool) -> tuple[dict[str, float], int]:
    """The largest difference of each value in frames that agree, and how many frames do not."""
    if len(here) != len(there):
        raise SystemExit(f"{len(here)} frames here, {len(there)} there")
    bounds = {name: bound * (NETWORK if network else 1.0) for name, bound in TOLERANCE.items()}
    largest = dict.fromkeys(TOLERANCE, 0.0)
    otherwise = 0
    for one, other in zip(here, there, strict=True):
        of_frame = {name: difference(name, one[name], other[name]) for name in TOLERANCE}
        same = one["call"] == other["call"] and all(of_frame[n] <= bounds[n] for n in bounds)
        otherwise += not same
        if same:
            largest = {name: max(largest[name], value) for name, value in of_frame.items()}
    return largest, otherwise


def difference(name: str, one: float | None, other: float | None) -> float:
    """Angles the short way; infinite where one side knows and the other does not."""
    if one is None or other is None:
        return 0.0 if one is other else math.inf
    if name == "azimuth_deg":
        return abs((one - other + 180) % 360 - 180)
    if name.endswith("sigma_deg"):
        return abs(one - other) / one  # relative: an uncertain one is far off in degrees
    return abs(one - other)


def compare(package: Path) -> int:
    system, failed = debian.root(), 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        subprocess.run(["dpkg-deb", "-x", package, folder / "package"], check=True)
        home = folder / "package/opt/locagen-edge"
        (packages,) = home.glob("lib/python3*/site-packages")
        python = system / "usr/bin" / packages.parent.name
        common = {"ORT_DISABLE_TELEMETRY": "1", "OMP_NUM_THREADS": "1", "HOME": scratch, "PATH": os.defpath}
        models = f'[models]\ndirectory = "{home}/share/locagen-edge/models"\n'
        print(f"{'recording':10} {'settings':11} frames other  largest difference otherwise")
        for kind, (recording, array) in recordings(folder).items():
            for name, text in SETTINGS.items():
                if array and name == "learned":
                    continue  # it knows only the array that it was trained for
                recording.with_suffix(".toml").write_text(array + text + models, "utf-8")
                here = replay([sys.executable], common | {"PYTHONPATH": str(ROOT)}, recording)
                there = replay(
                    [EMULATOR, "-cpu", "cortex-a72", "-L", system, python],
                    common | {"PYTHONPATH": str(packages)}, recording,
                )  # fmt: skip
                largest, otherwise = differences(here, there, name in ("mask", "wave"))
                fine = otherwise <= OTHERWISE * len(here)
                failed += not fine
                told = ", ".join(f"{key} {value:.2g}" for key, value in largest.items())
                verdict = "pass" if fine else "FAIL"
                print(f"{kind:10} {name:11} {len(here):6} {otherwise:5}  {told}  {verdict}", flush=True)
    return int(failed > 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("package", type=Path, metavar="PACKAGE.deb", help="the package for arm64")
    package = parser.parse_args().package
    if lacking := debian.missing(EMULATOR, "mmdebstrap", "dpkg-deb"):
        print(f"skipped: {lacking} (sudo apt install qemu-user-static mmdebstrap)")
        return
    sys.exit(compare(package))


if __name__ == "__main__":
    main()
