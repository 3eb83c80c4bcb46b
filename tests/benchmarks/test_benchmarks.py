"""The benchmark of rasterizers runs end to end."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from places import ROOT

from beags_plugin.system.child_processes import bound

SCRIPT = ROOT / "benchmarks" / "rasterizer.py"


def test_a_quick_benchmark_measures_rows_and_judges_goals(tmp_path):
    target = tmp_path / "result.json"
    done = subprocess.run(
        bound([sys.executable, SCRIPT, "--quick", "--no-gsplat", "--json", target]),
        capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(target.read_text())
    assert result["machine"]["cpu"] and result["commit"] and result["torch"]
    assert "torch" in {row["backend"] for row in result["rows"]}
    for row in result["rows"]:
        assert row["forward_ms"] > 0 and row["backward_ms"] > 0 and row["ratio_to_torch"] > 0
    lines = [line for line in done.stdout.splitlines() if line.startswith("goal ")]
    assert len(lines) == len(result["goals"]) >= 15
