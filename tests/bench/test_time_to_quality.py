"""The report of the time that a base takes to a quality."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

sys.path.append(str(Path(__file__).parent.parent))  # benchmarks/ is not installed

from beags_plugin.bench.options import ExperimentOptions
from beags_plugin.system.errors import UserError
from benchmarks.base_training import CurveRow
from benchmarks.time_to_quality import cells, plot, report_lines, run, seconds_to


def curve(*points, gaussians=100):
    """A curve through (CPU seconds, PSNR)."""
    return [
        {"step": index, "gaussians": gaussians, "psnr": psnr, "ssim": 0.5, "train_psnr": 30.0, "seconds": 9.0,
         "cpu_seconds": seconds}
        for index, (seconds, psnr) in enumerate(points, 1)
    ]  # fmt: skip


def test_the_time_to_a_quality_lies_between_two_measurements():
    found = curve((10.0, 20.0), (20.0, 24.0), (30.0, 23.0), (40.0, 25.0))
    assert seconds_to(found, 22.0) == pytest.approx(15.0)
    assert seconds_to(found, 19.0) == 10.0  # it was reached before the first measurement
    assert seconds_to(found, 24.5) == pytest.approx(37.5)
    assert seconds_to(found, 25.1) is None and seconds_to((), 1.0) is None


@pytest.fixture
def rows():
    official = curve((100.0, 24.0), (1000.0, 25.0))
    return [
        CurveRow("a", 42, "official", official, 300.0),
        CurveRow("a", 42, "short", curve((50.0, 24.0), (100.0, 25.0), gaussians=40), 200.0),
        CurveRow("b", 42, "official", official, 300.0),
        CurveRow("b", 42, "short", curve((50.0, 23.0), (100.0, 24.6), gaussians=60), 100.0),
        CurveRow("c", 42, "official", (), failed="it broke"),
        CurveRow("c", 42, "short", curve((50.0, 23.0)), 100.0),
    ]


def test_lines_compare_with_the_end_of_the_reference_on_the_same_scene(rows, tmp_path):
    lines = report_lines(rows, "official")
    first, second, alone = lines[1], lines[3], lines[5]
    assert first["cpu_to_-0.2"] == pytest.approx(90.0) and first["share_to_-0.2"] == pytest.approx(0.09)
    assert first["behind"] == 0.0 and first["cpu_share"] == 0.1 and first["gaussians_share"] == 0.4
    assert second["cpu_to_-0.2"] is None and second["share_to_-0.5"] == pytest.approx(0.09375 + 0.0, abs=0.004)
    assert alone["behind"] is None and alone["cpu_to_-0.5"] is None and lines[4]["failed"] == "it broke"
    official, short = lines[6:]
    assert official["scene"] == short["scene"] == "mean" and short["count"] == 3
    assert short["reached_-0.2"] == 1 and short["reached_-0.5"] == 2
    assert short["behind"] == pytest.approx(0.2) and short["gaussians_share"] == pytest.approx(0.5)
    assert cells(first)[:9] == ["a", "short", "2", "40", "40", "25.00", "0.500", "0.00", "100"]
    assert cells(first)[9:] == ["10", "90 (9)", "75 (8)", "200"]
    assert cells(short)[10] == "90 (9, 1 of 3 scenes)"
    assert cells(lines[4])[1] == "official failed: it broke"
    plot(tmp_path / "there" / "curves.png", rows, "official")
    assert (tmp_path / "there" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_an_experiment_without_a_reference_is_refused(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('description = "x"\npreset = "beags-tiny"\n[[variant]]\nname = "one"\n')
    with pytest.raises(UserError, match="mine has no reference"):
        run(str(file), ExperimentOptions())
