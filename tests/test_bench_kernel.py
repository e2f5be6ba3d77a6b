"""The kernel's benchmark runs and writes what it should; how fast is not asked here."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_quick_run_writes_its_report(tmp_path: Path) -> None:
    output = tmp_path / "kernel.json"
    command = [sys.executable, str(ROOT / "bench" / "bench_kernel.py"), "--quick", "--output", str(output)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text(encoding="utf-8"))
    assert {"date", "commit", "machine", "compiler", "flags", "results"} <= report.keys()
    assert {"cpu", "architecture", "python", "numpy"} <= report["machine"].keys()
    assert set(report["results"]) == {"triangle", "wide"}
    for result in report["results"].values():
        measured = result["us_per_frame"]
        assert {"kernel, C", "kernel, Python", "numpy"} <= measured.keys()
        # Whoever is not measured is named.
        assert len(measured) + len(result["missing"]) == 5
        for values in (*measured.values(), *result["ratios"].values()):
            assert values["min"] <= values["median"] <= values["p99"]
            assert values["min"] > 0
        assert result["ratios"]["kernel from Python / numpy"]["goal"] == 1 / 8
    assert str(output) in done.stdout
