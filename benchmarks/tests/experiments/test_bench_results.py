"""Reports of an experiment: means, tables, files, pictures."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, masks_of, scene, written

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.experiment import Variant, load_experiment
from beags_benchmarks.experiments.pictures import plot_experiment
from beags_benchmarks.experiments.report import write_csv, write_json
from beags_benchmarks.experiments.results import (
    COLUMNS,
    FIGURES,
    ResultRow,
    error_left,
    make_row,
    means,
    protocol_of,
    report_json,
    table_rows,
)
from beags_benchmarks.experiments.run import TABLE_WIDTH, rows_of
from beags_benchmarks.experiments.tables import memory_line, per_million_pixels, tables
from beags_benchmarks.experiments.trials import VariantTrial, plan
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import FIGURES as METRICS
from beags_plugin.evaluation.records import ObjectMetrics, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.table import protocol_line


@pytest.fixture
def experiment(tmp_path):
    return load_experiment(written(tmp_path, GOOD))


def masks(value: float) -> dict:
    return {
        kind: {moment: dict.fromkeys(names, value + 0.1 * (moment == "after")) for moment in ("before", "after")}
        for kind, names in METRICS.items()
    }


def result(value: float, psnr: float | None = 30.0) -> dict:
    return {
        "evaluation": {
            "protocol": dataclasses.asdict(Protocol(band_share=0.03)),
            "extracted_truth": "silhouette",
            "mean": masks(value),
            "psnr": {"before": 29.0, "after": psnr},
            "psnr_fit": {"before": 29.5, "after": 30.25},
            "psnr_shown": {"before": 31.0, "after": 31.25},
            "psnr_objects": {"before": 29.0, "after": 30.5},
            "shown": {"before": 0.75, "after": 0.75},
            "ssim": {"before": 0.8, "after": 0.9},
            "objects": {"cup": masks(value / 2), "box": masks(value)},
        },
        "seconds": {"reprojection": 1.0, "assignment": 2.0, "voxel grids": 3.0, "refinement": 10 * value},
        "cpu_seconds": 20.0,
        "peak_memory_mb": 900.0,
        "own_memory_mb": 100.0,
        "steps": 400,
        "gaussians": 1000,
        "mask_error_given": 0.02,
        "mask_error_used": None,
        "voxel_size": 0.5,
        "training_pixels": 4_000_000,
    }


BASE = {"seconds": {"base training": 60.0}, "cpu_seconds": 50.0}


@pytest.fixture
def rows():
    none, every = Variant("none"), Variant("k = 8", sweep="k", x=8.0)
    return [
        make_row(none, "a", 0, BASE, result(0.5), None),
        make_row(every, "a", 0, BASE, {**result(0.8), "labelled_share": 0.875}, None),
        make_row(none, "b", 0, BASE, result(0.3, psnr=None), None),
        make_row(every, "b", 0, BASE, None, "k is 0."),
    ]


def test_means_are_over_the_scenes_that_finished(rows):
    none, every = means(rows)
    assert (none.count, none.failures, every.count, every.failures) == (2, 0, 1, 1)
    values = np.array([0.5, 0.3])
    assert none.figures["extracted_biou_before"] == pytest.approx(values.mean())
    assert none.figures["extracted_biou_after"] == pytest.approx((values + 0.1).mean())
    assert none.figures["seconds refinement"] == pytest.approx((10 * values).mean())
    assert none.figures["seconds base training"] == 60.0
    assert none.figures["cpu_seconds total"] == 70.0
    assert none.figures["psnr_after"] == 30.0 and none.figures["mask_error_used"] is None
    assert none.figures["labelled_share"] is None and every.figures["labelled_share"] == 0.875
    assert every.figures["rendered_iou_after"] == pytest.approx(0.9)
    left = error_left(every, none)
    assert left == pytest.approx((1 - 0.9) / (1 - 0.5))
    assert error_left(every, None) is None
    lost = means([rows[3]])[0]
    assert lost.failed == "k is 0." and lost.figures == dict.fromkeys(FIGURES)


def test_json_and_csv_hold_every_row_and_the_same_figures(rows, tmp_path, experiment):
    experiment = dataclasses.replace(experiment, variants=(Variant("none"), Variant("k = 8", sweep="k", x=8.0)))
    report = report_json(experiment, rows, {"commit": "abc", "quick": False})
    write_json(tmp_path / "deep/r.json", report)
    write_csv(tmp_path / "deep/r.csv", table_rows(rows))
    text = (tmp_path / "deep/r.json").read_text()
    read = json.loads(text)
    assert [json.loads(line.rstrip(",")) for line in text.splitlines() if line.startswith("  {")] == [
        *read["rows"],
        *read["means"],
    ]
    assert read["experiment"] == "mine" and read["commit"] == "abc" and read["paper"] is None
    assert read["protocol"] == protocol_of(rows)
    assert all(set(row) == set(COLUMNS) for row in read["rows"])
    assert [(row["scene"], row["object"]) for row in read["rows"]] == [
        ("a", "mean"), ("a", "cup"), ("a", "box"), ("a", "mean"), ("a", "cup"), ("a", "box"),
        ("b", "mean"), ("b", "cup"), ("b", "box"), ("b", "mean"),
    ]  # fmt: skip
    assert read["rows"][1]["extracted_iou_after"] == pytest.approx(0.35)
    assert read["rows"][-1]["failed"] == "k is 0."
    assert [mean["error_left"] for mean in read["means"]] == [1.0, pytest.approx(0.2)]
    with open(tmp_path / "deep/r.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert tuple(lines[0]) == COLUMNS and len(lines) == len(read["rows"]) + len(read["means"])
    for line, row in zip(lines, read["rows"], strict=False):
        for name in COLUMNS:
            assert line[name] == ("" if row[name] is None else str(row[name]))


def test_the_protocol_is_worded_as_by_beags_eval(rows):
    scene = SceneMetrics(ObjectMetrics(None, None), {}, 30.0, "silhouette", shown=0.75)
    run = RunMetrics("a", "c", Protocol(band_share=0.03), {}, None, scene)
    assert protocol_of(rows) == protocol_line(run) and "3 % of the diagonal" in protocol_line(run)
    plain = [dataclasses.replace(row, figures={**row.figures, "shown_after": None}) for row in rows]
    assert protocol_of(plain) == protocol_line(dataclasses.replace(run, after=dataclasses.replace(scene, shown=None)))
    fitted = [dataclasses.replace(row, colors_fitted=row.scene == "a") for row in rows]
    exposed = dataclasses.replace(run, after=dataclasses.replace(scene, colors_fitted=True))
    assert protocol_of(fitted) == protocol_line(exposed) != protocol_line(run)
    mixed = [dataclasses.replace(row, truth="visible" if row.scene == "b" else row.truth) for row in rows]
    assert "against whole occlusion-free silhouettes, else visible masks" in protocol_of(mixed)
    assert protocol_of(rows[3:]) is None  # it failed


def test_tables_list_failures_and_mark_the_papers_figures(rows):
    from rich.console import Console

    console = Console(width=TABLE_WIDTH, file=io.StringIO())
    for table in tables(load_experiment("ablation"), rows):
        console.print(table)
    text = console.file.getvalue()
    assert "failed: k = 8 on b: k is 0." in text and "k = 8 (1 of 2 scenes)" in text
    assert protocol_of(rows) in " ".join(text.split())
    assert "29.00 30.00 29.50 30.25 31.00 31.25 75.0" in " ".join(text.split())  # PSNR, after the fit, shown, share
    assert text.index("spill,") < text.index("rendered") and "…" not in text
    assert " -10.0 40.0 50.0 50.0 50.0 29.00" in " ".join(text.split())  # lost, then spill before and after, rendered
    assert "the paper's figures, not ours" in text and "92.0 / 85.8 (52)" in text  # (100 - 85.8) / (100 - 72.8)


def test_a_sweep_has_a_sentence_of_its_memory_and_an_axis_per_pixels(rows, experiment):
    assert per_million_pixels(rows[1], experiment) == "2"  # 8 of 4 million
    assert per_million_pixels(rows[0], experiment) == "–"
    assert memory_line(means(rows), "k") == "Along k the peak memory moves from 900 to 900 MB (own: 100 to 100)."
    assert memory_line(means(rows[3:]), "k") is None


def test_the_plot_has_failures_or_none(rows, tmp_path):
    from PIL import Image

    variants = tuple({row.variant.name: row.variant for row in rows}.values())
    experiment = dataclasses.replace(load_experiment("ablation"), variants=variants)
    plot_experiment(tmp_path / "p.png", experiment, rows)
    plot_experiment(tmp_path / "failed.png", experiment, [rows[3]])
    for name in ("p.png", "failed.png"):
        with Image.open(tmp_path / name) as image:
            assert image.width > 1000 and len(image.convert("L").getcolors()) > 20


def test_the_plot_of_many_lines_has_no_empty_diagrams(tmp_path):
    """Masks of made-up objects have no quality: of five diagrams three are left, with the names beside them."""
    from PIL import Image

    experiment = load_experiment("classes")
    given = {"psnr_after": 30.0, "cpu_seconds": 9.0, "peak_memory_mb": 700.0}
    rows = [ResultRow(v, "a", 0, dict.fromkeys(FIGURES) | given, {}) for v in experiment.variants]
    plot_experiment(tmp_path / "p.png", experiment, rows)
    with Image.open(tmp_path / "p.png") as image:
        assert image.width == 3 * 484


def test_rows_come_from_outcomes_in_order(experiment):
    variant = experiment.variants[0]
    trial = plan(experiment, [scene()], masks_of(scene()), "code")[0].trial
    outcomes = {trial.base.digest: Outcome(Path("x"), BASE), trial.digest: Outcome(Path("y"), result(0.5))}
    (row,) = rows_of([VariantTrial(variant, scene(), 42, (trial,))], outcomes)
    assert row.scene == "a" and row.seed == 42 and row.figures["seconds base training"] == 60.0
    other = dataclasses.replace(trial, seed=43)
    outcomes[other.digest] = Outcome(Path("z"), None, "no memory")
    (row,) = rows_of([VariantTrial(variant, scene(), 42, (trial, other), ("cup", "box"))], outcomes)
    assert row.failed == "no memory" and row.figures["extracted_iou_after"] is None, "one object of two failed"
