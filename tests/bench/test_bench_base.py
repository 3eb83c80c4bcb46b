"""The report of the study of base training."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed

from benchmarks.base_training import CurveRow, cells, plot, report_lines


def record(step, psnr):
    return {
        "step": step, "gaussians": 10 * step, "psnr": psnr, "ssim": 0.5, "train_psnr": psnr + 2, "seconds": 0.6 * step,
        "cpu_seconds": 1.2 * step,
    }  # fmt: skip


@pytest.fixture
def rows():
    long, short = [record(100, 20.0), record(900, 25.0)], [record(50, 19.0), record(300, 24.5)]
    return [
        CurveRow("a", 42, "long", long, 300.0), CurveRow("a", 42, "short", short, 200.0),
        CurveRow("a", 42, "none", (), failed="it broke"),
        CurveRow("b", 42, "long", short, 300.0), CurveRow("b", 42, "short", long, 200.0),
    ]  # fmt: skip


def test_lines_report_the_end_of_each_run_and_how_far_it_is_behind_the_reference(rows, tmp_path):
    lines = report_lines(rows, "long")
    assert [line["behind"] for line in lines] == [0.0, 0.5, None, 0.0, -0.5]
    assert (lines[0]["steps"], lines[0]["gaussians"], lines[0]["train_psnr"]) == (900, 9000, 27.0)
    assert lines[0]["minutes"] == pytest.approx(9.0) and lines[0]["cpu_minutes"] == pytest.approx(18.0)
    assert cells(lines[1]) == ["a", "short", "300", "3000", "24.50", "0.500", "0.50", "26.50", "3.0", "6.0", "200"]
    assert cells(lines[2])[1] == "none failed: it broke"
    assert [line["behind"] for line in report_lines(rows, None)] == [None] * 5
    plot(tmp_path / "there" / "base.png", rows)
    assert (tmp_path / "there" / "base.png").read_bytes().startswith(b"\x89PNG")
