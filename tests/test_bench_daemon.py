"""The benchmark of the daemon runs and writes what it should; how fast is not asked here."""

import json
import os
import subprocess
import sys

from conftest import ROOT


def test_quick_run_writes_its_report(tmp_path):
    output = tmp_path / "daemon.json"
    done = subprocess.run(
        [sys.executable, str(ROOT / "bench" / "bench_daemon.py"), "--quick", "--output", str(output)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text(encoding="utf-8"))
    daemons = report["daemons"]
    assert {"paper", "plain", "nothing"} <= daemons.keys()
    for found in daemons.values():
        assert 0 < found["cpu_percent_least"] <= found["cpu_percent"]
        assert 0 < found["private_mib"] <= found["pss_mib"] <= found["rss_mib"]
        assert found["files_outside_state"] == []
    assert daemons["paper"]["files_opened_for_writing"] in ([], None)  # None: no strace here
    assert daemons["paper"]["delay_ms"]["bearings"] > 0
    assert daemons["paper"]["delay_ms"]["min"] > 0
    assert report["growth"]["frames"] == 1000
    assert report["growth"]["messages"] > 50  # a heartbeat a second at least
