"""Every benchmark runs and writes what it should; how fast and how well is not asked here."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from conftest import ROOT


def run(name: str, tmp_path) -> dict:
    output = tmp_path / "report.json"
    done = subprocess.run(
        [sys.executable, str(ROOT / "bench" / name), "--quick", "--output", str(output)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text(encoding="utf-8"))
    assert {"date", "commit", "machine"} <= report.keys()
    assert {"cpu", "architecture", "python", "numpy"} <= report["machine"].keys()
    return report


def test_kernel(tmp_path):
    report = run("bench_kernel.py", tmp_path)
    assert {"compiler", "flags"} <= report.keys()
    assert set(report["results"]) == {"triangle", "wide"}
    for result in report["results"].values():
        measured = result["us_per_frame"]
        assert {"kernel, C", "kernel, Python", "numpy"} <= measured.keys()
        # whoever is not measured is named
        assert len(measured) + len(result["missing"]) == 5
        for values in (*measured.values(), *result["ratios"].values()):
            assert 0 < values["min"] <= values["median"] <= values["p99"]


def test_pipeline(tmp_path):
    report = run("bench_pipeline.py", tmp_path)
    times = report["seconds_per_hop"]
    assert {"kernel", "steered", "far-field", "hyperbolic", "steered, mask"} <= times.keys()
    for values in times.values():
        assert 0 < values["min"] <= values["median"] <= values["p99"] <= values["max"]
    assert report["peak_rss_mib"] > 10


def test_accuracy(tmp_path):
    """Ten trials tell nothing of degrees, but the bound is the bound, and whoever is missing is named."""
    report = run("bench_accuracy.py", tmp_path)
    cell = report["cells"]["white +10 dB"]
    assert cell["bound_deg"] == pytest.approx(0.147, rel=0.1)
    judged = [name for name in cell if name.startswith("pyroomacoustics")]
    assert len(judged) + len(report["missing"]) == 4
    assert cell["far-field"]["mean_deg"] < 1.5


def test_twin(tmp_path):
    found = run("bench_twin.py", tmp_path)
    assert {"default", "sweep"} <= found["arrivals_per_s"].keys()
    assert {"plain, 1 s", "four rotors", "plain, a frame, features"} <= found["times_real_time"].keys()
    for values in (*found["arrivals_per_s"].values(), *found["times_real_time"].values()):
        assert 0 < values["min"] <= values["median"] <= values["p99"]


def test_framer(tmp_path):
    found = run("bench_framer.py", tmp_path)
    assert set(found["results"]) == {"clean", "0-10 noise bytes", "0-100 noise bytes"}
    for result in found["results"].values():
        assert result["kept"]["framer"] >= found["goals"]["kept"]
        assert 0 < result["ratio"]["min"] <= result["ratio"]["median"]


def test_detection(tmp_path):
    report = run("bench_detection.py", tmp_path)
    assert set(report["noise_alone"]) == {"steady", "hunting"}
    assert all(noise["hours"] > 0 for noise in report["noise_alone"].values())
    assert all(0.0 <= cell["found"] <= 1.0 for cell in report["calls"].values())
