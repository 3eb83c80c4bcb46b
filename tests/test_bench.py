"""``beags bench``: what an experiment's file may say, how trials are planned, run and resumed, and what is told."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from beags_plugin.bench import runner
from beags_plugin.bench.experiment import Variant, experiment_names, load_experiment
from beags_plugin.bench.report import write_csv, write_json
from beags_plugin.bench.results import (
    COLUMNS,
    FIGURES,
    Row,
    error_left,
    make_row,
    means,
    report_json,
    table_rows,
)
from beags_plugin.bench.run import Options, adapted, rows_of, run_experiment, scenes_of
from beags_plugin.bench.runner import Outcome, run_trials
from beags_plugin.bench.scenes import Scene, damaged_masks, given_scenes
from beags_plugin.bench.tables import memory_line, per_million_pixels, tables
from beags_plugin.bench.trials import MODEL, Run, Trial, plan, steps_of
from beags_plugin.errors import UserError
from beags_plugin.masks.classes import read_class_map
from beags_plugin.sample.writer import SampleConfig, write_sample

GOOD = """
description = "d"
preset = "beags-tiny"
reference = "none"
[both]
"pipeline.model.sh_degree" = 0
[refine]
"pipeline.model.refine_steps" = 7
[[variant]]
name = "none"
[variant.refine]
"pipeline.model.refiner" = "none"
"pipeline.model.refine_steps" = 1
[[variant]]
name = "noisy"
[variant.base]
"pipeline.model.losses.normal.weight" = 0.0
[[sweep]]
name = "k"
key = "pipeline.model.prepare.k"
values = [5, 10]
relative_to_pixels = true
[sweep.lines.plain]
[sweep.lines."no R"]
"pipeline.model.prepare.reprojection" = "none"
[[sweep]]
name = "damage"
key = "damage"
values = [0.0, 1.5]
"""


def written(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


@pytest.fixture
def experiment(tmp_path):
    return load_experiment(written(tmp_path, GOOD))


def scene(name: str = "a", digest: str = "1") -> Scene:
    return Scene(name, Path("/nowhere"), 1.0, digest)


# -- the file ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", experiment_names())
def test_every_experiment_that_ships_loads(name):
    assert load_experiment(name).variants


def test_the_experiments_of_the_paper_ship():
    assert {"ablation", "sensitivity", "depth", "masks"} <= set(experiment_names())


def test_a_file_says_variants_and_sweeps(experiment):
    variants = {variant.name: variant for variant in experiment.variants}
    assert list(variants) == [
        "none", "noisy", "k = 5, plain", "k = 10, plain", "k = 5, no R", "k = 10, no R", "damage = 0", "damage = 1.5",
    ]  # fmt: skip
    assert variants["none"].refine == {
        "pipeline.model.sh_degree": 0,
        "pipeline.model.refine_steps": 1,
        "pipeline.model.refiner": "none",
    }
    assert variants["noisy"].base == {"pipeline.model.sh_degree": 0, "pipeline.model.losses.normal.weight": 0.0}
    point = variants["k = 10, no R"]
    assert (point.sweep, point.line, point.x, point.damage) == ("k", "no R", 10.0, None)
    assert point.refine["pipeline.model.prepare.k"] == 10
    assert point.refine["pipeline.model.prepare.reprojection"] == "none"
    assert "pipeline.model.prepare.k" not in point.base
    assert (variants["damage = 1.5"].damage, variants["damage = 1.5"].x) == (1.5, 1.5)
    assert experiment.sample_seeds == (0,) and experiment.seeds == (42,) and experiment.sweeps == ("k", "damage")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('preset = "beags-tiny"', 'preset = "beags-huge"', "no preset 'beags-huge'"),
        ('preset = "beags-tiny"', "", "has no preset"),
        ('description = "d"', "description = 3", "description must be str"),
        ('reference = "none"', 'reference = "nobody"', "'nobody', which is no variant"),
        ('name = "noisy"', 'name = "none"', "two variants called 'none'"),
        ('"pipeline.model.refiner"', '"pipeline.model.refinery"', "no config key 'pipeline.model.refinery'"),
        ('"pipeline.model.refiner" = "none"', '"pipeline.model.refiner" = 3', "must be str"),
        ("values = [5, 10]", "values = 5", "sweep 'k': values must be"),
        ("values = [5, 10]", "values = []", "sweep 'k': values must be"),
        ('key = "pipeline.model.prepare.k"', 'key = "pipeline.model.prepare.kk"', "no config key"),
        ('key = "pipeline.model.prepare.k"', "", "sweep 'k': has no key"),
        ("relative_to_pixels = true", 'phase = "after"', "phase is 'after'"),
        ("relative_to_pixels = true", "absolute = true", "unknown entry 'absolute'"),
        ("[0.0, 1.5]", "[-1.0]", "degree of mask degradation is -1"),
        ("[0.0, 1.5]", "[99.0]", "number from 0 to 1"),
        ('name = "noisy"', 'name = "noisy"\nextra = 1', "variant 'noisy': has an unknown entry 'extra'"),
        ("[both]", "[neither]\n[both]", "unknown entry 'neither'"),
        ("[both]", "[sample]\nseeds = [-1]\n[both]", "sample.seeds must be"),
        ("[both]", "[sample]\nwidth = 2\n[both]", "sample: the sample's width is 2"),
        ("[both]", "[sample]\nwidht = 64\n[both]", "widht"),
        ("[both]", '[paper]\nsource = "p"\ncolumns = ["a", "b"]\n[paper.rows]\nx = [[1, 2]]\n[both]', "row 'x' must"),
        ("[[variant]]", "[variant]", "cannot be read"),
        ("description", "=", "cannot be read"),
    ],
)
def test_a_mistake_in_the_file_gets_one_sentence(tmp_path, old, new, words):
    assert old in GOOD
    with pytest.raises(UserError) as error:
        load_experiment(written(tmp_path, GOOD.replace(old, new, 1)))
    assert words in str(error.value)
    assert "mine.toml" in str(error.value)


def test_an_experiment_without_variants_or_name_is_refused(tmp_path):
    with pytest.raises(UserError, match="neither"):
        load_experiment(written(tmp_path, 'description = "d"\npreset = "beags-tiny"'))
    with pytest.raises(UserError, match="no experiment 'ablatoin': choose one of .*ablation"):
        load_experiment("ablatoin")
    with pytest.raises(UserError, match="cannot be read"):
        load_experiment(str(tmp_path / "absent.toml"))


# -- the plan ----------------------------------------------------------------------------------------------------------


def masks_of(*scenes: Scene) -> dict[tuple[str, float], Path]:
    return {(s.name, degree): Path(f"masks-{s.name}-{degree}") for s in scenes for degree in (0.0, 1.5)}


def test_variants_share_bases_and_nothing_else(experiment):
    first, second = scene("a", "1"), scene("b", "2")
    runs = plan(experiment, [first, second], masks_of(first, second), "code")
    assert len(runs) == 2 * len(experiment.variants)
    of_first = [run.trial for run in runs if run.scene is first]
    assert len({trial.digest for trial in of_first}) == len(of_first)
    bases = {run.variant.name: run.trial.base.digest for run in runs if run.scene is first}
    assert bases["noisy"] != bases["none"]
    assert {base for name, base in bases.items() if name != "noisy"} == {bases["none"]}  # damaged masks need no other
    assert not {trial.digest for trial in of_first} & {run.trial.digest for run in runs if run.scene is second}
    base = of_first[0].base
    assert base.overrides[MODEL + "refine_steps"] == 0 and of_first[0].overrides[MODEL + "base_steps"] == 0
    assert steps_of(of_first[1]) == 7 and steps_of(base) == 1500


@pytest.mark.parametrize(
    "change",
    [
        {"overrides": {"a": 2}},
        {"seed": 1},
        {"code": "newer"},
        {"preset": "beags"},
        {"masks": Path("other")},
        {"scene": Scene("a", Path("/nowhere"), 2.0, "1")},
        {"scene": Scene("a", Path("/nowhere"), 1.0, "2")},
    ],
)
def test_a_trial_is_another_when_anything_that_matters_changes(change):
    settings = {"scene": scene(), "preset": "beags-tiny", "overrides": {"a": 1}, "seed": 0, "code": "code"}
    former = Trial(**settings)
    assert Trial(**settings).digest == former.digest
    moved = Scene("renamed", Path("/elsewhere"), 1.0, "1")
    assert Trial(**{**settings, "scene": moved}).digest == former.digest
    assert Trial(**{**settings, **change}).digest != former.digest


# -- running -----------------------------------------------------------------------------------------------------------


class FakeWorker:
    """Writes what the real one would, without training; fails for overrides that say so."""

    def __init__(self) -> None:
        self.ran: list[dict] = []
        self.interrupt_at = -1

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def run(self, folder: Path) -> int:
        request = json.loads((folder / "trial.json").read_text())
        if len(self.ran) == self.interrupt_at:
            (folder / "half").write_text("done")
            raise KeyboardInterrupt
        self.ran.append(request)
        if "fail" in request["overrides"]:
            (folder / "failed.json").write_text('{"failed": "k is 0."}')
            return 1
        if "die" in request["overrides"]:
            return -9
        (folder / "result.json").write_text(json.dumps({"digest": request["digest"]}))
        return 0


@pytest.fixture
def worker(monkeypatch):
    fake = FakeWorker()
    monkeypatch.setattr(runner, "Worker", lambda: fake)
    return fake


def trials(*overrides: dict) -> list[Trial]:
    base = Trial(scene(), "beags-tiny", {"base": True}, 0, "code")
    return [Trial(scene(), "beags-tiny", own, 0, "code", base=base) for own in overrides]


def test_an_interrupted_experiment_goes_on_where_it_was(tmp_path, worker):
    wanted = trials({"x": 1}, {"x": 2}, {"x": 3})
    worker.interrupt_at = 2  # the base, the first, and then no more
    with pytest.raises(KeyboardInterrupt):
        run_trials(wanted, tmp_path, lambda _: 1)
    worker.interrupt_at = -1
    told = []
    outcomes = run_trials(wanted, tmp_path, lambda _: 1, lambda done, total: told.append((done, total)))
    assert [request["overrides"] for request in worker.ran] == [{"base": True}, {"x": 1}, {"x": 2}, {"x": 3}]
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    for trial in wanted:
        outcome = outcomes[trial.digest]
        assert outcome.failed is None and outcome.result == {"digest": trial.digest}
        assert not (outcome.folder / "half").exists()
    assert worker.ran[1]["base"] == str(outcomes[wanted[0].base.digest].folder / "run")


def test_a_failed_trial_says_why_and_is_tried_again(tmp_path, worker):
    wanted = trials({"fail": 1}, {"x": 1}, {"die": 1})
    for _ in range(2):
        outcomes = run_trials(wanted, tmp_path, lambda _: 1)
        assert [outcomes[trial.digest].failed for trial in wanted[:2]] == ["k is 0.", None]
        assert "exit code -9" in outcomes[wanted[2].digest].failed
    assert len(worker.ran) == 4 + 2


def test_a_failed_base_fails_what_starts_from_it(tmp_path, worker):
    base = Trial(scene(), "beags-tiny", {"fail": 1}, 0, "code")
    refined = Trial(scene(), "beags-tiny", {"x": 1}, 0, "code", base=base)
    outcome = run_trials([refined], tmp_path, lambda _: 1)[refined.digest]
    assert outcome.failed == "its base failed: k is 0." and len(worker.ran) == 1


# -- telling -----------------------------------------------------------------------------------------------------------


def masks(value: float) -> dict:
    return {
        kind: {moment: {metric: value + 0.1 * (moment == "after") for metric in ("acc", "iou", "biou")}
               for moment in ("before", "after")}
        for kind in ("extracted", "rendered")
    }  # fmt: skip


def result(value: float, psnr: float | None = 30.0) -> dict:
    return {
        "evaluation": {
            "mean": masks(value),
            "psnr": {"before": 29.0, "after": psnr},
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
        make_row(every, "a", 0, BASE, result(0.8), None),
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
    assert every.figures["rendered_iou_after"] == pytest.approx(0.9)
    left = error_left(every, none)
    assert left == pytest.approx((1 - 0.9) / (1 - 0.5))
    assert error_left(every, None) is None
    lost = means([rows[3]])[0]
    assert lost.failed == "k is 0." and lost.figures == dict.fromkeys(FIGURES)


def test_json_and_csv_hold_every_row_and_the_same_figures(rows, tmp_path, experiment):
    import dataclasses

    experiment = dataclasses.replace(experiment, variants=(Variant("none"), Variant("k = 8", sweep="k", x=8.0)))
    report = report_json(experiment, rows, {"commit": "abc", "quick": False})
    write_json(tmp_path / "deep/r.json", report)
    write_csv(tmp_path / "deep/r.csv", table_rows(rows))
    read = json.loads((tmp_path / "deep/r.json").read_text())
    assert read["experiment"] == "mine" and read["commit"] == "abc" and read["paper"] is None
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


def test_tables_say_what_failed_and_whose_figures_the_papers_are(rows):
    from rich.console import Console

    console = Console(width=200, file=io.StringIO())
    for table in tables(load_experiment("ablation"), rows):
        console.print(table)
    text = console.file.getvalue()
    assert "failed: k = 8 on b: k is 0." in text and "k = 8 (1 of 2 scenes)" in text
    assert "the paper's figures, not ours" in text and "92.0 / 85.8 (52)" in text  # (100 - 85.8) / (100 - 72.8)


def test_memory_along_a_sweep_is_told_in_a_sentence(rows):
    assert memory_line(means(rows), "k") == "Along k the peak memory moves from 900 to 900 MB (own: 100 to 100)."
    assert memory_line(means(rows[3:]), "k") is None


def test_the_front_is_what_nothing_beats(tmp_path):
    from beags_plugin.bench.front import draw_front, pareto_front

    points = [tuple(point) for point in np.random.default_rng(0).integers(0, 6, (40, 2)).tolist()]
    rows = [
        Row(Variant(str(i)), "a", 0, {**dict.fromkeys(FIGURES), "cpu_seconds total": x, "psnr_after": y}, {})
        for i, (x, y) in enumerate(points)
    ]
    rows.append(Row(Variant("unknown"), "a", 0, dict.fromkeys(FIGURES), {}))
    found = {row.variant.name for row in pareto_front(rows, "cpu_seconds total", "psnr_after")}
    better = {
        (x, y): any(c <= x and q >= y and (c, q) != (x, y) for c, q in points) for x, y in points
    }  # by definition, pair by pair
    assert found == {str(i) for i, point in enumerate(points) if not better[point]}
    draw_front(tmp_path / "front.png", load_experiment("ablation"), rows)
    assert (tmp_path / "front.png").stat().st_size > 10_000


def test_the_axis_is_told_relative_to_the_pixels(rows, experiment):
    assert per_million_pixels(rows[1], experiment) == "2"  # 8 of 4 million
    assert per_million_pixels(rows[0], experiment) == "–"


def test_the_picture_is_drawn_with_failures_and_without(rows, tmp_path):
    import dataclasses

    from PIL import Image

    from beags_plugin.bench.pictures import draw

    pytest.importorskip("matplotlib")
    variants = tuple({row.variant.name: row.variant for row in rows}.values())
    experiment = dataclasses.replace(load_experiment("ablation"), variants=variants)
    draw(tmp_path / "p.png", experiment, rows)
    draw(tmp_path / "failed.png", experiment, [rows[3]])
    for name in ("p.png", "failed.png"):
        with Image.open(tmp_path / name) as image:
            assert image.width > 1000 and len(image.convert("L").getcolors()) > 20


# -- scenes and options ------------------------------------------------------------------------------------------------

SMALL = {"width": 48, "height": 36, "num_train": 8, "num_test": 2, "num_points": 300, "antialias": 1}


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "sample"
    return Scene("sample 5", write_sample(folder, SampleConfig(seed=5, **SMALL)), 1.0, "digest", seed=5)


def read_all(folder: Path) -> dict[str, np.ndarray]:
    return {path.stem: read_class_map(path) for path in sorted(folder.glob("*.png"))}


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all((first[name] == second[name]).all() for name in first)


def test_mild_damage_is_what_the_sample_has_and_none_is_the_truth(sample, tmp_path):
    mild = damaged_masks(sample, 1.0, tmp_path)
    assert same(read_all(mild), read_all(sample.data / "masks"))
    assert same(read_all(damaged_masks(sample, 0.0, tmp_path)), read_all(sample.data / "ground_truth/masks"))
    stamp = (mild / "complete").stat().st_mtime_ns
    assert damaged_masks(sample, 1.0, tmp_path) == mild and (mild / "complete").stat().st_mtime_ns == stamp


def test_more_damage_is_more_wrong_and_spares_held_out_views(sample, tmp_path):
    truth = read_all(sample.data / "ground_truth/masks")
    held_out = [Path(file).stem for file in json.loads((sample.data / "transforms.json").read_text())["test_filenames"]]
    wrong = []
    for degree in (0.5, 1.0, 2.0, 3.0):
        found = read_all(damaged_masks(sample, degree, tmp_path))
        assert all((found[name] == truth[name]).all() for name in held_out)
        wrong.append(sum(int((found.get(name, np.full_like(mask, 9)) != mask).sum()) for name, mask in truth.items()))
    assert wrong == sorted(wrong) and wrong[0] < wrong[-1]


def test_scenes_are_the_samples_or_the_users_or_both(sample, tmp_path, experiment, monkeypatch):
    import dataclasses

    experiment = dataclasses.replace(experiment, sample=SMALL, sample_seeds=(5, 6))
    options = Options(output=tmp_path)
    assert [s.name for s in scenes_of(experiment, options)] == ["sample 5", "sample 6"]
    assert [s.name for s in scenes_of(experiment, Options(data=(sample.data,), output=tmp_path))] == ["sample"]
    both = scenes_of(experiment, Options(data=(sample.data,), scenes=1, output=tmp_path, downscale=2.0))
    assert [(s.name, s.downscale) for s in both] == [("sample 5", 1.0), ("sample", 2.0)]
    for wrong, words in [
        (Options(scenes=3, output=tmp_path), "--scenes is 3"),
        (Options(scenes=0, output=tmp_path), "no scene to train on"),
        (Options(data=(tmp_path / "absent",), output=tmp_path), "is no folder"),
        (Options(data=(sample.data, sample.data), output=tmp_path), "two of the given folders are called sample"),
    ]:
        with pytest.raises(UserError, match=words):
            scenes_of(experiment, wrong)
    assert given_scenes([sample.data], None)[0].downscale == 1.0


def test_quick_keeps_the_ends_of_sweeps_and_trains_a_few_steps(experiment):
    quick = adapted(experiment, Options(quick=True))
    assert [v.name for v in quick.variants] == [v.name for v in experiment.variants]  # two points a line are its ends
    longer = adapted(load_experiment("sensitivity"), Options(quick=True))
    assert [v.x for v in longer.variants] == [5.0, 5000.0, 1.0, 1000.0]
    trial = plan(quick, [scene()], masks_of(scene()), "code")[1].trial
    assert steps_of(trial) == 7 and steps_of(trial.base) < 300
    with pytest.raises(UserError, match="no preset 'beags-huge'"):
        adapted(experiment, Options(preset="beags-huge"))


def test_rows_come_from_outcomes_in_order(experiment):
    variant = experiment.variants[0]
    trial = plan(experiment, [scene()], masks_of(scene()), "code")[0].trial
    outcomes = {
        trial.base.digest: Outcome(Path("x"), BASE),
        trial.digest: Outcome(Path("y"), result(0.5)),
    }
    (row,) = rows_of([Run(variant, scene(), 42, trial)], outcomes)
    assert row.scene == "a" and row.seed == 42 and row.figures["seconds base training"] == 60.0


# -- the whole, in miniature -------------------------------------------------------------------------------------------

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
    """Options of a finished miniature experiment, its file and its rows."""
    folder = tmp_path_factory.mktemp("bench")
    options = Options(output=folder / "out", json=folder / "figures.json", csv=folder / "figures.csv")
    path = written(folder, MINIATURE)
    return path, options, run_experiment(path, options)


def test_trials_are_trained_measured_and_told(miniature):
    _, options, rows = miniature
    by_name = {row.variant.name: row for row in rows}
    assert list(by_name) == ["alone", "broken", "damage = 0", "damage = 2"]
    assert by_name["broken"].failed == "k is 0: the voxel size needs at least 1 neighbour."
    alone, exact, damaged = (by_name[name].figures for name in ("alone", "damage = 0", "damage = 2"))
    for figures in (alone, exact, damaged):
        assert figures["steps"] == 3 and figures["gaussians"] > 100 and figures["seconds base training"] > 0
        assert 0 <= figures["extracted_iou_after"] <= 1 and 5 < figures["psnr_after"] < 50
        assert 0 < figures["own_memory_mb"] < figures["peak_memory_mb"] and figures["cpu_seconds"] > 0
        assert figures["training_pixels"] == 8 * 48 * 36
    for metric in ("psnr", "ssim", "extracted_biou", "rendered_iou"):  # it only assigns
        assert alone[f"{metric}_after"] == alone[f"{metric}_before"]
    assert exact["psnr_before"] == alone["psnr_before"] and exact["psnr_after"] != exact["psnr_before"]
    assert exact["mask_error_given"] == 0.0 < damaged["mask_error_given"]
    report = json.loads(options.json.read_text())
    assert report["commit"] and report["machine"]["cpu"] and report["experiment"] == "mine"
    assert [row["failed"] is None for row in report["means"]] == [True, False, True, True]
    assert options.csv.read_text().count("\n") == 1 + len(report["rows"]) + len(report["means"])
    for name in ("mine.png", "mine-confidence.png"):
        assert (options.output / name).stat().st_size > 10_000


def test_a_second_call_trains_only_what_failed(miniature, monkeypatch):
    path, options, rows = miniature
    ran = []

    def fail_again(self, folder: Path) -> int:
        ran.append(json.loads((folder / "trial.json").read_text())["overrides"])
        return 1

    monkeypatch.setattr(runner.Worker, "run", fail_again)
    again = run_experiment(path, options)
    assert [overrides["pipeline.model.prepare.k"] for overrides in ran] == [0]
    assert [row.figures for row in again] == [row.figures for row in rows]


def test_the_command_tells_a_mistake_in_one_sentence(capsys, tmp_path):
    from beags_plugin.cli import main

    with pytest.raises(SystemExit) as end:
        main(["bench", "file", "ablatoin", "--output", str(tmp_path)])
    assert end.value.code == 2
    assert "there is no experiment 'ablatoin'" in capsys.readouterr().out


def test_the_file_in_the_documentation_is_an_experiment(tmp_path):
    text = (Path(__file__).parents[1] / "docs/experiments.md").read_text()
    block = text.split("## The file")[1].split("Keys are")[0]
    path = written(tmp_path, "\n".join(line.strip() for line in block.splitlines()))
    found = load_experiment(path)
    assert [variant.name for variant in found.variants][:2] == ["as it is", "worse masks"]
    assert found.variants[1].damage == 2.0 and found.front and found.confidence and len(found.variants) == 5
