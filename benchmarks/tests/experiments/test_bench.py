"""``beags bench``: a miniature experiment from its file to the figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from places import ROOT

pytest.importorskip("nerfstudio")

from experiment_files import written

from beags_benchmarks.experiments.engines import trial_folder
from beags_benchmarks.experiments.engines.ray_cluster import RayEngine
from beags_benchmarks.experiments.experiment import load_experiment
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.results import STAGES
from beags_benchmarks.experiments.run import run_experiment
from beags_plugin.commands.cli import main

MINIATURE = """
description = "a miniature"
preset = "beags-tiny"
confidence = true
[sample]
seeds = [5]
width = 48
height = 36
num_train = 8
num_test = 2
num_points = 300
antialias = 1
[base]
"pipeline.model.base_steps" = 25
[refine]
"pipeline.model.refine_steps" = 3
[[variant]]
name = "alone"
[variant.refine]
"pipeline.model.refiner" = "none"
[[variant]]
name = "broken"
[variant.refine]
"pipeline.model.prepare.k" = 0
[[sweep]]
name = "damage"
key = "damage"
values = [0.0, 2.0]
"""


@pytest.fixture(scope="module")
def miniature(tmp_path_factory):
    """ExperimentOptions of a finished miniature experiment, its file and its rows."""
    folder = tmp_path_factory.mktemp("bench")
    options = ExperimentOptions(output=folder / "out", json=folder / "figures.json", csv=folder / "figures.csv")
    path = written(folder, MINIATURE)
    return path, options, run_experiment(path, options)


@pytest.mark.slow("an experiment is trained for it")
def test_trials_are_trained_measured_and_reported(miniature):
    _, options, rows = miniature
    by_name = {row.variant.name: row for row in rows}
    assert list(by_name) == ["alone", "broken", "damage = 0", "damage = 2"]
    assert by_name["broken"].failed == "k is 0: the voxel size needs at least 1 neighbour."
    alone, exact, damaged = (by_name[name].figures for name in ("alone", "damage = 0", "damage = 2"))
    for figures in (alone, exact, damaged):
        assert figures["steps"] == (0 if figures is alone else 3)
        assert figures["gaussians"] > 100 and figures["seconds base training"] > 0
        assert 0 <= figures["extracted_iou_after"] <= 1 and 5 < figures["psnr_after"] < 50
        assert 0 < figures["own_memory_mb"] < figures["peak_memory_mb"] and figures["cpu_seconds"] > 0
        assert figures["training_pixels"] == 8 * 48 * 36
    for metric in ("psnr", "ssim", "extracted_biou", "rendered_iou"):  # it only assigns
        assert alone[f"{metric}_after"] == alone[f"{metric}_before"]
    assert exact["psnr_before"] == alone["psnr_before"] and exact["psnr_after"] != exact["psnr_before"]
    assert exact["mask_error_given"] == 0.0 < damaged["mask_error_given"]
    report = json.loads(options.json.read_text())
    assert report["commit"] and report["machine"]["cpu"] and report["experiment"] == "mine"
    assert report["protocol"].startswith("Protocol: extracted masks against whole occlusion-free silhouettes; ")
    assert " PSNR shown: " in report["protocol"]
    assert [row["failed"] is None for row in report["means"]] == [True, False, True, True]
    assert options.csv.read_text().count("\n") == 1 + len(report["rows"]) + len(report["means"])
    for name in ("mine.png", "mine-confidence.png"):
        assert (options.output / name).stat().st_size > 10_000


@pytest.mark.slow("an experiment is trained for it")
def test_the_plan_runs_nothing_and_knows_what_is_done(miniature, tmp_path, monkeypatch, capsys):
    path, options, _ = miniature
    monkeypatch.setattr(trial_folder.Worker, "run", None)
    plan = ExperimentOptions(output=tmp_path / "out", plan=True, engine="ray", address="127.0.0.1:1")
    monkeypatch.setattr(RayEngine, "unavailable", lambda: None)
    assert run_experiment(path, plan) == []
    text = " ".join(capsys.readouterr().out.split())
    assert "tabletop 5 5 0 8 0.0 – – –" in text and "5 trials, 5 of them not done." in text
    assert "of base, alone, broken, damage = 0, damage = 2 are known once one of each has finished here" in text
    assert not (tmp_path / "out").exists(), "not even the scene is written"
    assert run_experiment(path, ExperimentOptions(output=options.output, plan=True)) == []
    text = " ".join(capsys.readouterr().out.split())
    assert "tabletop 5 5 4 8" in text and "5 trials, 1 of them not done." in text and "disk of broken are" in text


def test_methods_of_the_comparison_are_its_variants(tmp_path, capsys):
    printed = []
    for words in (["--methods", "flashsplat"], ["--variants", "flashsplat"], []):
        main(["bench", "compare", *words, "--scenes", "1", "--plan", "--output", str(tmp_path / "out")])
        # The part before it tells the load of the machine.
        printed.append(" ".join(capsys.readouterr().out.split()).rpartition("Trials and what is left of them")[2])
    assert printed[0] == printed[1] and "4 trials, 4 of them not done." in printed[0]
    assert "of base, assignment alone, flashsplat, flashsplat, gamma 0 are known" in printed[0]
    assert "4 trials" not in printed[2], "without the option all of them"


@pytest.mark.slow("an experiment is trained for it")
def test_a_second_call_trains_only_what_failed(miniature, monkeypatch):
    path, options, rows = miniature
    ran = []

    def fail_again(self, folder: Path, until: str) -> int:
        ran.append(json.loads((folder / "trial.json").read_text())["overrides"])
        return 1

    monkeypatch.setattr(trial_folder.Worker, "run", fail_again)
    again = run_experiment(path, options)
    assert [overrides["pipeline.model.prepare.k"] for overrides in ran] == [0]
    assert [row.figures for row in again] == [row.figures for row in rows]


@pytest.mark.slow("an experiment is trained for it")
def test_what_an_interruption_left_is_not_trained_again(miniature):
    """One trial was killed before its scores, one in its last step: both end with the same figures."""
    path, options, rows = miniature
    lost = {"damage = 0": ("result",), "damage = 2": ("result", "trained", "run/training")}
    files = options.output.glob("trials/*-refined-*/result.json")
    results = {file.parent: json.loads(file.read_text()) for file in files}
    for row in (row for row in rows if row.variant.name in lost):
        psnr = row.figures["psnr_after"]
        (folder,) = [each for each, result in results.items() if result["evaluation"]["psnr"]["after"] == psnr]
        for name in lost[row.variant.name]:
            (folder / f"{name}.json").unlink()
    again = run_experiment(path, options)
    clocks = {"cpu_seconds", "cpu_seconds total", "peak_memory_mb", "own_memory_mb", *map("seconds {}".format, STAGES)}
    for before, after in zip(rows, again, strict=True):
        interrupted = after.variant.name == "damage = 2"
        changed = {name for name, value in before.figures.items() if value != after.figures[name]}
        assert changed <= (clocks if interrupted else set()), after.variant.name
        assert after.failed or (after.figures["cpu_seconds"] is None) == interrupted


def test_the_file_in_the_documentation_is_an_experiment(tmp_path):
    text = (ROOT / "benchmarks/README.md").read_text()
    block = text.split("## The file of an experiment")[1].split("Keys are")[0]
    path = written(tmp_path, "\n".join(line.strip() for line in block.splitlines()))
    found = load_experiment(path)
    assert [variant.name for variant in found.variants][:2] == ["as it is", "worse masks"]
    assert found.variants[1].damage == 2.0 and found.confidence and len(found.variants) == 5
