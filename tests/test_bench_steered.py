"""The benchmark of the steered search runs and writes what it should; how fast is not asked here."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_quick_run_writes_its_report(tmp_path: Path) -> None:
    output = tmp_path / "steered.json"
    command = [sys.executable, str(ROOT / "bench" / "bench_steered.py"), "--quick", "--output", str(output)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text(encoding="utf-8"))
    assert {"date", "commit", "machine", "compiler", "results"} <= report.keys()
    results = report["results"]
    assert results["us_per_frame"].keys() == results["mean_error_deg"].keys()
    # Whoever is not measured is named.
    assert len(results["us_per_frame"]) + len(results["missing"]) == 4
    for values in (*results["us_per_frame"].values(), *results["ratios"].values()):
        assert 0 < values["min"] <= values["median"] <= values["p99"]
    assert str(output) in done.stdout
