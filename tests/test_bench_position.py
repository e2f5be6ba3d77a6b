"""The benchmark of positions runs and writes what it should; how fast is not asked here."""

import json
import os
import subprocess
import sys

from conftest import ROOT


def test_quick_run_writes_its_report_and_its_figure(tmp_path):
    output, figure = tmp_path / "position.json", tmp_path / "position.png"
    command = [sys.executable, str(ROOT / "bench" / "bench_position.py"), "--quick"]
    done = subprocess.run(
        [*command, "--output", str(output), "--figure", str(figure)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(output.read_text(encoding="utf-8"))["results"]
    assert results.pop("us_per_look")["median"] > 0
    for values in results.values():
        assert values["no_place"] < values["flights"] / 2
        assert 0 < values["median_error_m"] < 20
    assert figure.read_bytes().startswith(b"\x89PNG")
