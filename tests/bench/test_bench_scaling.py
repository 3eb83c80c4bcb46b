"""The measurement of scaling, at tiny sizes: its figures and files."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed

from benchmarks import scaling
from benchmarks.scaling import ScalingOptions, run_scaling
from benchmarks.scaling_stages import STAGES


@pytest.mark.slow("trains scenes of several sizes")
def test_files_and_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scaling.CONSOLE, "_width", 120)
    rows = run_scaling(ScalingOptions(quick=True, output=tmp_path, json=tmp_path / "deep" / "s.json"))
    report = json.loads((tmp_path / "deep" / "s.json").read_text())
    assert report["rows"] == [vars(row) for row in rows] and report["commit"] and report["machine"]
    assert {(row.axis, row.size) for row in rows} == {
        ("classes", 1), ("classes", 4), ("views", 2), ("views", 4),
        ("gaussians", 300), ("gaussians", 600), ("pixels", 768), ("pixels", 1728),
    }  # fmt: skip
    assert all(row.seconds > 0 for row in rows)
    assert {slope["stage"] for slope in report["slopes"]} == set(STAGES)
    with open(tmp_path / "scaling.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "Slope of time" in printed and "Milliseconds by number of classes" in printed
