"""``beags bench paper`` from small trees to the paper's tables: runs, marks, the plan, and truth drawn later."""

from __future__ import annotations

import json
import shutil

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import scene as trial_scene
from paper_trees import write_tree

from beags_benchmarks.experiments import run as bench_run
from beags_benchmarks.experiments.experiment import Variant
from beags_benchmarks.experiments.forecast import TEMPORARY_BYTES
from beags_benchmarks.experiments.paper import run as paper_run
from beags_benchmarks.experiments.paper.data_sets import read_data_sets
from beags_benchmarks.experiments.paper.on_disk import SceneOnDisk
from beags_benchmarks.experiments.paper.options import PaperOptions
from beags_benchmarks.experiments.paper.run import forecast_of, run_paper
from beags_benchmarks.experiments.paper.tables import Outcomes, paper_tables
from beags_benchmarks.experiments.plan_table import plan_lines
from beags_benchmarks.experiments.results import FIGURES, ResultRow
from beags_benchmarks.experiments.scenes import SceneSize
from beags_benchmarks.experiments.trials import Trial, VariantTrial
from beags_plugin.commands import cli
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of two methods on a scene of LLFF and on one of LeRF, some steps long: data root and options."""
    root = tmp_path_factory.mktemp("paper")
    for name in ("llff", "lerf"):
        write_tree(root / "data", name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_run, "QUICK_BASE", {"base_steps": 60, "densify.start": 20, "densify.stop": 50})
        patch.setattr(bench_run, "QUICK_REFINE", {"refine_steps": 3})
        options = PaperOptions(root / "data", methods=("assignment alone", "bea-gs"), quick=True, output=root / "out")
        outcomes = run_paper(options)
        yield options, outcomes


def printed(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.slow("an experiment on scenes of a paper is trained for it")
def test_what_is_on_disk_is_run_and_scored(finished):
    options, outcomes = finished
    assert [(row.scene, row.variant.name, row.failed) for row in outcomes.rows] == [
        (scene, method, None) for scene in ("llff/fern", "lerf/figurines") for method in options.methods
    ]
    for row in outcomes.rows:
        assert 0 < row.figures["extracted_iou_after"] <= 1 and 0 < row.figures["rendered_iou_after"] <= 1
        assert 5 < row.figures["psnr_after"] < 50 and row.figures["steps"] == (3 if row.variant.name == "bea-gs" else 0)
    assert set(outcomes.truths.values()) == {"silhouette"}
    report = json.loads((options.output / "paper.json").read_text())
    assert report["protocol"].startswith("Protocol: extracted masks against whole occlusion-free silhouettes; ")
    llff, ovs = report["data_sets"]["llff"], report["data_sets"]["3dovs"]
    assert llff["scenes"] == ["fern"] and llff["paper"]["extracted"]["bea-gs"] == [93.0, 80.7]
    ours = next(row for row in outcomes.rows if row.scene == "llff/fern" and row.variant.name == "bea-gs")
    assert llff["ours"]["extracted"]["bea-gs"] == [ours.figures[f"extracted_{m}_after"] for m in ("acc", "iou", "biou")]
    assert ovs["scenes"] == [] and ovs["ours"]["extracted"] == {} and len(ovs["missing"]) == 1
    assert (options.output / "paper.csv").read_text().count("\n") > 8


@pytest.mark.slow("an experiment on scenes of a paper is trained for it")
def test_each_scene_is_trained_as_its_data_set_says(finished):
    options, _ = finished
    requests = [json.loads(path.read_text()) for path in options.output.glob("trials/*/trial.json")]
    assert len(requests) == 6
    by_layout = {request["options"]["layout"]: request["options"] for request in requests}
    assert by_layout == {
        "llff": {
            "layout": "llff",
            "images_path": "images",
            "masks_path": "masks",
            "eval_interval": 8,
            "held_out": ["IMG_4027"],
        },
        "lerf-mask": {"layout": "lerf-mask", "images_path": "images", "masks_path": "masks"},
    }


@pytest.mark.slow("an experiment on scenes of a paper is trained for it")
def test_truth_drawn_later_is_scored_without_training_again(finished, capsys):
    options, before = finished
    trainings = {path: path.stat().st_mtime_ns for path in options.output.glob("trials/*/run/training.json")}
    silhouettes = options.data_root / "llff/fern/ground_truth/silhouettes"
    kept = options.output / "kept"
    shutil.move(silhouettes, kept)
    again = run_paper(options)
    text = printed(capsys)
    assert "2 trials are scored again, without training" in text and "silhouettes of fern belong in" in text
    assert "Protocol: extracted masks against whole occlusion-free silhouettes, else visible masks" in text
    assert again.truths["llff/fern", "bea-gs"] == "visible" and again.truths["lerf/figurines", "bea-gs"] == "silhouette"
    ious = [[row.figures["extracted_iou_after"] for row in found.rows] for found in (before, again)]
    assert ious[0][:2] != ious[1][:2] and ious[0][2:] == ious[1][2:]
    shutil.move(kept, silhouettes)
    back = run_paper(options)
    assert [row.figures for row in back.rows] == [row.figures for row in before.rows]
    capsys.readouterr()
    assert "scored again" not in (run_paper(options) and printed(capsys))
    assert {path: path.stat().st_mtime_ns for path in trainings} == trainings and len(trainings) == 6


@pytest.mark.slow("an experiment on scenes of a paper is trained for it")
def test_a_drawing_that_is_refused_is_a_row_with_the_reason(finished, capsys):
    options, before = finished
    drawing = next((options.data_root / "llff/fern/ground_truth/silhouettes").rglob("*.png"))
    kept = drawing.read_bytes()
    drawing.write_bytes(b"no picture")
    again = run_paper(options)
    failed = [row.failed for row in again.rows if row.failed]
    assert failed and all(str(drawing) in reason for reason in failed) and len(again.rows) == len(before.rows)
    assert "failed: " in printed(capsys)
    drawing.write_bytes(kept)
    assert [row.figures for row in run_paper(options).rows] == [row.figures for row in before.rows], "and still trained"


@pytest.mark.slow("an experiment on scenes of a paper is trained for it")
def test_the_plan_starts_nothing_and_knows_what_is_done(finished, tmp_path, monkeypatch, capsys):
    options, _ = finished
    monkeypatch.setattr(paper_run, "trained", None)
    for name in ("llff", "lerf"):
        shutil.copytree(options.data_root / name, tmp_path / "data" / name)
    arguments = ["bench", "paper", "--data-root", str(tmp_path / "data"), "--quick", "--methods", "bea-gs", "--plan"]
    cli.main([*arguments, "--output", str(tmp_path / "out")])
    text = printed(capsys)
    assert "LLFF, fern 2 0 7 0.0" in text and "4 trials, 4 of them not done." in text
    assert "Hours, memory and disk of base, bea-gs are known once one of each has finished here" in text
    assert not (tmp_path / "out" / "trials").exists()
    paper_run.run_paper(
        PaperOptions(options.data_root, methods=("bea-gs",), quick=True, plan=True, output=options.output)
    )
    assert "LLFF, fern 2 2 7 0.0 0.00" in printed(capsys)


def result_of(seconds: float, memory: float) -> str:
    return json.dumps({"seconds": {"a": seconds, "b": 1.0}, "peak_memory_mb": memory})


def test_the_plan_scales_what_finished_trials_took(tmp_path):
    (data_set,) = read_data_sets(["mip360"])
    variant, other = Variant("trace3d"), Variant("cob-gs")
    scenes, runs = [], []
    for name, pixels in (("room", 1_000_000), ("garden", 3_000_000)):
        scene = trial_scene(f"mip360/{name}", name)
        scenes.append(SceneOnDisk(data_set, name, tmp_path / name, scene, size=SceneSize(10, pixels)))
        base = Trial(scene, "beags-paper", {}, 1, "code")
        for each in (variant, other):
            trial = Trial(scene, "beags-paper", {"method": each.name}, 1, "code", base=base)
            runs.append(VariantTrial(each, scene, 1, (trial,)))
    folder = tmp_path / "trials"
    for trial, seconds, memory in ((runs[0].trial.base, 99.0, 900.0), (runs[0].trial, 359.0, 700.0)):
        (folder / trial.folder_name).mkdir(parents=True)
        (folder / trial.folder_name / "result.json").write_text(result_of(seconds, memory))
        (folder / trial.folder_name / "scene").write_bytes(bytes(2_000_000))
    room, garden = forecast_of(scenes, runs, folder)[0].scenes()
    assert (room.trials, room.done, room.unknown, room.hours) == (3, 2, ("cob-gs",), 0.0)
    assert (garden.trials, garden.done, garden.unknown) == (3, 0, ("cob-gs",))
    assert garden.hours == pytest.approx(3 * (100 + 360) / 3600) and garden.memory_mb == 900.0
    assert garden.temporary_mb == TEMPORARY_BYTES * 3 and garden.disk_mb == pytest.approx(54 + 3 * 4, rel=1e-3)
    assert "of cob-gs are known once" in plan_lines([room, garden], "--scenes")[1]
    known = forecast_of(scenes, [run for run in runs if run.variant is variant], folder)[0].scenes()
    assert plan_lines(known, "")[1].startswith("Some 0.38 hours, 900 MB of memory and 0.01 GB of disk")
    assert plan_lines(known[:1], "") == ["2 trials, 0 of them not done."]


def row(scene: str, method: str, **figures: float) -> ResultRow:
    return ResultRow(Variant(method), scene, 42, {**dict.fromkeys(FIGURES), **figures}, {})


def tables_text(outcomes: Outcomes, capsys, names=("lerf",), methods=("bea-gs", "trace3d")) -> str:
    from rich.console import Console

    for table in paper_tables(read_data_sets(names), methods, outcomes):
        Console(width=200).print(table)
    return printed(capsys)


def lerf(iou: float, **more: float) -> dict[str, float]:
    names = [f"{kind}_{metric}_after" for kind in ("extracted", "rendered") for metric in ("iou", "biou")]
    return {**dict.fromkeys(names, iou), "psnr_before": 25.0, "psnr_after": 24.0, **more}


def test_ours_stand_beside_the_papers(capsys):
    scenes = ["lerf/figurines", "lerf/ramen", "lerf/teatime"]
    rows = [row(scene, "bea-gs", **lerf(0.5 + 0.1 * index)) for index, scene in enumerate(scenes)]
    text = tables_text(Outcomes(rows, {(scene, "bea-gs"): "silhouette" for scene in scenes}), capsys)
    assert "bea-gs 60.0 / 60.0 89.4 / 83.6 trace3d – 85.9 / 80.1" in text
    assert "bea-gs 60.0 / 60.0 92.0 / 88.5 trace3d – 88.3 / 83.1" in text and "instascene – 76.1 / 67.1" in text
    assert "bea-gs 25.0 / 24.0 25.2 / 25.0 trace3d – –" in text
    assert "* fewer" not in text and "+ some" not in text


def test_means_that_are_not_the_papers_are_marked(capsys):
    rows = [row("lerf/ramen", "bea-gs", **lerf(0.5)), row("lerf/ramen", "trace3d", extracted_iou_after=None)]
    text = tables_text(Outcomes(rows, {("lerf/ramen", "bea-gs"): "both"}), capsys)
    assert "bea-gs 50.0 / 50.0*+ 89.4 / 83.6" in text and "bea-gs 50.0 / 50.0* 92.0 / 88.5" in text
    assert "bea-gs 25.0 / 24.0* 25.2" in text and "trace3d – 85.9" in text
    assert "* fewer scenes than" in text and "+ some or all extracted objects" in text
    failed = [ResultRow(Variant("bea-gs"), "lerf/ramen", 42, dict.fromkeys(FIGURES), {}, "it broke")]
    assert "bea-gs failed 89.4 / 83.6" in tables_text(Outcomes(failed, {}), capsys)


MISTAKES = {
    "no scene is complete": ({}, "no scene in .* is complete: the lines above say what belongs where."),
    "data set": ({"data_set": ("mip361",)}, r"there is no data set 'mip361' of the paper \(did you mean mip360\?\)"),
    "method": ({"methods": ("trace4d",)}, r"there is no variant 'trace4d' of methods \(did you mean trace3d\?\)"),
    "preset": ({"preset": "beags-papier"}, r"there is no preset 'beags-papier' \(did you mean beags-paper\?\)"),
    "downscale": ({"downscale": 0.5}, "downscale is 0.5: give 1"),
    "no number": ({"downscale": float("nan")}, "downscale is nan: give 1"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence(mistake, tmp_path):
    options, sentence = MISTAKES[mistake]
    with pytest.raises(UserError, match=sentence) as raised:
        run_paper(PaperOptions(tmp_path, output=tmp_path / "out", **options))
    assert "\n" not in str(raised.value) and not (tmp_path / "out").exists()
