"""The study of base training: what it trains, reads and tells."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from beags_plugin.bench.base_training import Row, cells, draw, plan, read_row, report_lines
from beags_plugin.bench.experiment import load_experiment
from beags_plugin.bench.runner import Outcome
from beags_plugin.bench.scenes import Scene

SCENE = Scene("table", Path("table"), 4.0, "abc")


def record(step, psnr):
    return {
        "step": step, "gaussians": 10 * step, "psnr": psnr, "ssim": 0.5, "train_psnr": psnr + 2, "seconds": 0.6 * step,
        "cpu_seconds": 1.2 * step,
    }  # fmt: skip


@pytest.fixture
def experiment():
    return load_experiment("base")


def test_each_variant_is_a_base_of_its_length_measured_on_the_way(experiment):
    trials = plan(experiment, [SCENE], "code")
    steps = {variant.name: trial.overrides for variant, trial in trials}
    assert steps["30,000 steps"]["steps_per_held_out"] == 1500
    assert steps["3,000 steps"]["steps_per_held_out"] == 150
    assert all(overrides["pipeline.model.refine_steps"] == 0 for overrides in steps.values())
    assert len({trial.digest for _, trial in trials}) == len(trials)
    seeds = dataclasses.replace(experiment, seeds=(1, 2))
    assert len(plan(seeds, [SCENE, SCENE], "code")) == 4 * len(trials)


def test_a_row_holds_the_curve_that_the_run_left_behind(experiment, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "held_out.json").write_text(json.dumps([record(100, 20.0), record(200, 21.0)]))
    variant, trial = plan(experiment, [SCENE], "code")[0]
    row = read_row(variant, trial, Outcome(tmp_path, {"peak_memory_mb": 300.0}))
    assert (row.scene, row.variant, row.failed) == ("table", variant.name, None)
    assert [point["psnr"] for point in row.curve] == [20.0, 21.0]
    failed = read_row(variant, trial, Outcome(tmp_path, None, "it broke"))
    assert failed.curve == () and failed.failed == "it broke"


@pytest.fixture
def rows():
    long, short = [record(100, 20.0), record(900, 25.0)], [record(50, 19.0), record(300, 24.5)]
    return [
        Row("a", 42, "long", long, 300.0), Row("a", 42, "short", short, 200.0),
        Row("a", 42, "none", (), failed="it broke"),
        Row("b", 42, "long", short, 300.0), Row("b", 42, "short", long, 200.0),
    ]  # fmt: skip


def test_lines_tell_the_end_of_each_run_and_how_far_it_is_behind_the_reference(rows):
    lines = report_lines(rows, "long")
    assert [line["behind"] for line in lines] == [0.0, 0.5, None, 0.0, -0.5]
    assert (lines[0]["steps"], lines[0]["gaussians"], lines[0]["train_psnr"]) == (900, 9000, 27.0)
    assert lines[0]["minutes"] == pytest.approx(9.0) and lines[0]["cpu_minutes"] == pytest.approx(18.0)
    assert cells(lines[1]) == ["a", "short", "300", "3000", "24.50", "0.500", "0.50", "26.50", "3.0", "6.0", "200"]
    assert cells(lines[2])[1] == "none failed: it broke"
    assert [line["behind"] for line in report_lines(rows, None)] == [None] * 5


def test_the_picture_is_drawn_with_failures(rows, tmp_path):
    draw(tmp_path / "there" / "base.png", rows)
    assert (tmp_path / "there" / "base.png").read_bytes().startswith(b"\x89PNG")
