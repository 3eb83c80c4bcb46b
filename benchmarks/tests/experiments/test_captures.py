"""``beags bench captures`` from small captures to its tables: masks, truths, rows, pictures, and what is missing."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import SCENES

pytest.importorskip("nerfstudio")

from capture_trees import write_capture, write_prompts, write_truth
from experiment_files import GOOD, written
from PIL import Image
from run_folders import discs

from beags_benchmarks.experiments import run as bench_run
from beags_benchmarks.experiments.captures import made_masks
from beags_benchmarks.experiments.captures.known import CAPTURES, PICKED, Capture, find_captures
from beags_benchmarks.experiments.captures.options import CapturesOptions
from beags_benchmarks.experiments.captures.pictures import _bulk
from beags_benchmarks.experiments.captures.run import run_captures
from beags_benchmarks.experiments.captures.tables import groups, mean_rows, psnr_cost, tables
from beags_benchmarks.experiments.engines import trial_folder
from beags_benchmarks.experiments.experiment import FILES, Variant, load_experiment
from beags_benchmarks.experiments.results import FIGURES, ResultRow
from beags_benchmarks.experiments.scenes import TrialScene
from beags_benchmarks.experiments.trials import FOCUS, MODEL, plan
from beags_plugin.commands import cli
from beags_plugin.masks.sources import salient
from beags_plugin.masks.sources.prompts import read_prompts
from beags_plugin.objects import make_masks
from beags_plugin.plugin.presets import preset_config
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.runs.checkpoint_file import read_checkpoint, saw_close_ups
from beags_plugin.runs.layout import newest_checkpoint
from beags_plugin.system.errors import UserError

ROWS = FILES / "captures" / "rows.toml"


def printed(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


def small_experiment(patch: pytest.MonkeyPatch, prompts: Path) -> None:
    """Make trials short, let the network find what is not black, and take clicks from ``prompts``."""
    patch.setattr(bench_run, "QUICK_BASE", {"base_steps": 60, "densify.start": 20, "densify.stop": 50})
    patch.setattr(bench_run, "QUICK_REFINE", {"refine_steps": 3})
    patch.setattr(salient, "load", lambda path: lambda photo: (photo.max(axis=2) > 20).astype(np.float32))
    patch.setattr(salient, "fetch_weights", lambda: None)
    patch.setattr(salient.SalientSource, "unavailable", lambda: None)
    patch.setattr(Capture, "prompts", property(lambda self: prompts))


def files_below(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The options and rows of a short run on bear, fruit and the skull, and what lay in the data before it."""
    root = tmp_path_factory.mktemp("captures")
    for name in ("bear", "fruit", "dtu_skull"):
        write_capture(root / "data", name)
    write_truth(root / "truth", "bear", ("v00", "v08"))
    write_truth(root / "truth", "fruit", ("v00",), untold_rows=5)
    prompts = write_prompts(root / "prompts.json")
    with pytest.MonkeyPatch.context() as patch:
        small_experiment(patch, prompts)
        before = files_below(root / "data"), files_below(root / "truth")
        options = CapturesOptions(
            root / "data",
            root / "truth",
            scenes=("bear", "fruit", "dtu_skull"),
            variants=("the paper's losses", "as long as the paper, neither loss"),
            quick=True,
            output=root / "out",
        )
        return options, run_captures(options), before


@pytest.fixture
def again(finished, monkeypatch):
    """The options of the finished run, where another one finds what it left."""
    options, *_ = finished
    small_experiment(monkeypatch, options.output.parent / "prompts.json")
    return options


@pytest.mark.slow("an experiment on captures is trained for it")
def test_every_capture_is_trained_on_each_kind_of_masks(finished):
    _, rows, _ = finished
    names = ["assignment alone", "as long as the paper, neither loss", "the paper's losses"]
    scenes = ["bear, picked", "bear, salient", "fruit, given", "dtu_skull, given", "dtu_skull, salient"]
    assert [(row.scene, row.variant.name) for row in rows] == [(scene, name) for scene in scenes for name in names]
    for row in rows:
        assert row.failed is None, row.failed
        assert 0 <= row.figures["extracted_biou_after"] <= 1 and 5 < row.figures["psnr_after"] < 50
        assert row.figures["rendered_biou_after"] is not None, "traced silhouettes serve as visible masks too"
        assert row.truth == ("visible" if row.scene.startswith("dtu_skull") else "silhouette")
        assert set(row.objects) == ({"apple", "banana"} if row.scene == "fruit, given" else set(row.objects))
        assert row.figures["steps"] == (0 if row.variant.name == "assignment alone" else 3)


@pytest.mark.slow("an experiment on captures is trained for it")
def test_masks_are_made_beside_the_trials_and_the_data_stay_as_they_are(finished):
    options, _, before = finished
    assert (files_below(options.data_root), files_below(options.truth)) == before
    made = {path.name.rpartition("-")[0] for path in (options.output / "scenes").iterdir()}
    assert made == {"bear-picked", "bear-salient", "dtu_skull-salient", "bear-truth", "fruit-truth", "dtu_skull-truth"}
    requests = [json.loads(path.read_text()) for path in options.output.glob("trials/*/trial.json")]
    bases = [request for request in requests if request["base"] is None]
    assert len(bases) == 3 and len(requests) == 3 + 15, "kinds of masks share the base of their photos"
    assert all(not request["options"] and request["preset"] == "beags-fast" for request in bases)
    papers = [request for request in requests if request["preset"] == "beags-paper"]
    assert len(papers) == 10
    picked = next(path for path in (options.output / "scenes").glob("bear-picked-*"))
    assert len(list((picked / "masks").glob("*.png"))) == 7, "held-out photos get none"


@pytest.mark.slow("an experiment on captures is trained for it")
def test_a_view_without_a_traced_silhouette_is_not_scored(finished):
    options, *_ = finished
    results = [json.loads(path.read_text()) for path in options.output.glob("trials/fruit*refined*/result.json")]
    assert len(results) == 3
    for result in results:
        masks = result["evaluation"]["masks"]
        scored = {(mask["kind"], mask["view"], mask["truth"]) for mask in masks}
        assert scored == {("extracted", "v00", "silhouette"), ("rendered", "v00", "visible")}, (
            "v08 has a given mask alone"
        )


@pytest.mark.slow("an experiment on captures is trained for it")
def test_files_hold_every_figure_and_the_means_by_masks(finished):
    options, rows, _ = finished
    report = json.loads((options.output / "captures.json").read_text())
    assert report["experiment"] == "captures" and report["size"] == 800 and report["quick"]
    assert list(report["groups"]) == ["best masks", "masks from photos alone"]
    best = report["groups"]["best masks"]
    assert best["scenes"] == ["bear, picked", "fruit, given", "dtu_skull, given"]
    paper = next(row for row in best["means"] if row["variant"] == "the paper's losses")
    own, control = (
        [row.figures["psnr_fit_after"] for row in rows if row.scene in best["scenes"] and row.variant.name == name]
        for name in ("the paper's losses", "as long as the paper, neither loss")
    )
    assert paper["psnr_cost"] == pytest.approx(np.mean(control) - np.mean(own), abs=1e-9)
    for scene in ("bear-picked", "bear-salient", "fruit-given", "dtu_skull-given", "dtu_skull-salient"):
        with Image.open(options.output / f"captures-{scene}.jpg") as picture:
            lines, objects = 3, 2 if scene == "fruit-given" else 1
            assert picture.height == lines * (200 + 18 + 4) and picture.width > 2 * 300 + objects * 6 * 200
            colors = np.asarray(picture.convert("RGB")).reshape(-1, 3)
            assert len(np.unique(colors, axis=0)) > 100


@pytest.mark.slow("an experiment on captures is trained for it")
def test_a_second_call_trains_nothing_and_makes_no_mask(finished, again, monkeypatch, capsys):
    monkeypatch.setattr(trial_folder.Worker, "run", None)
    monkeypatch.setattr(make_masks, "make_masks", None)
    assert [row.figures for row in run_captures(again)] == [row.figures for row in finished[1]]
    assert run_captures(replace(again, plan=True)) == []
    assert "18 trials, 0 of them not done." in printed(capsys)


@pytest.mark.slow("an experiment on captures is trained for it")
def test_masks_that_cannot_be_made_are_failed_rows_and_the_others_run(again, tmp_path, monkeypatch, capsys):
    clicks = write_prompts(tmp_path / "held_out.json", "v00")
    monkeypatch.setattr(Capture, "prompts", property(lambda self: clicks))
    rows = run_captures(replace(again, scenes=("bear",), json=tmp_path / "a.json", csv=tmp_path / "a.csv"))
    failed = {row.scene for row in rows if row.failed}
    assert failed == {"bear, picked"} and len(rows) == 6
    assert "no masks could be made: " in rows[0].failed and "held out" in rows[0].failed
    assert "failed: assignment alone on bear, picked: " in printed(capsys)


@pytest.mark.slow("an experiment on captures is trained for it")
def test_without_the_network_its_scenes_are_left_out(again, monkeypatch, capsys):
    monkeypatch.setattr(salient.SalientSource, "unavailable", lambda: "the library onnxruntime is not installed.")
    rows = run_captures(replace(again, scenes=("bear", "dtu_skull")))
    assert {row.scene for row in rows} == {"bear, picked", "dtu_skull, given"}
    assert printed(capsys).count("Captures with salient masks are left out: the library onnxruntime") == 1
    with pytest.raises(UserError, match="no capture is left to train on"):
        run_captures(replace(again, scenes=("bear",), masks=("salient",)))


def test_the_command_plans_and_writes_nothing(tmp_path, capsys):
    write_capture(tmp_path / "data", "fruit")
    write_truth(tmp_path / "truth", "fruit", ("v00", "v03"))
    (tmp_path / "truth/fruit/banana/v00.png").unlink()
    (tmp_path / "truth/fruit/banana/v03.png").unlink()
    arguments = ["--data-root", str(tmp_path / "data"), "--truth", str(tmp_path / "truth"), "--plan"]
    cli.main(["bench", "captures", *arguments, "--output", str(tmp_path / "out")])
    text = printed(capsys)
    assert "kitchen is left out: " in text and "8 trials, 8 of them not done." in text
    assert "v03.png is of no held-out photo and not scored." in text
    assert "no silhouette of banana lies in" in text and not (tmp_path / "out").exists()


def test_truth_of_another_scene_is_told_before_anything_is_trained(tmp_path, capsys):
    write_capture(tmp_path / "data", "fruit")
    write_truth(tmp_path / "truth", "fruit", ("v00", "v08"))
    for file in list((tmp_path / "truth").rglob("*.png")):
        file.rename(file.with_stem(f"other-{file.stem}"))
    options = CapturesOptions(tmp_path / "data", tmp_path / "truth", scenes=("fruit",), plan=True)
    run_captures(options)
    lines = [line for line in printed(capsys).splitlines() if "another scene" in line]
    assert " ".join(lines).count("no file in") == 2, "a sentence for each object, none for each file"
    shutil.rmtree(tmp_path / "truth")
    write_truth(tmp_path / "truth", "fruit", ("v00",))
    Image.new("L", (10, 90)).save(tmp_path / "truth/fruit/apple/v00.png")
    with pytest.raises(UserError, match="apple/v00.png is 10 x 90 pixels, which are other proportions than those of"):
        run_captures(options)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data_root": "nowhere"}, "the data root nowhere is no folder"),
        ({"data_root": "empty"}, "holds none of bear, kitchen, garden"),
        ({"data_root": "empty", "scenes": ("bear",)}, "holds none of bear that can be read (bear is left out: "),
        ({"truth": "nowhere"}, "the truth nowhere is no folder"),
        ({"scenes": ("baer",)}, "bear"),
        ({"masks": ("drawn",)}, "given, picked, salient"),
        ({"masks": ("salient",), "scenes": ("fruit",)}, "none of fruit is trained on masks of the kind salient"),
        ({"size": 8}, "size is 8: give 16 pixels or more."),
        ({"rows": "mine.toml"}, "'damage = 0' has masks of its own"),
        ({"variants": ("the papers losses",)}, "the paper's losses"),
    ],
)
def test_a_mistake_gets_one_sentence(tmp_path, monkeypatch, change, words):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "data", "fruit")
    for name in ("empty", "truth"):
        (tmp_path / name).mkdir()
    written(tmp_path, GOOD)
    given = {"data_root": "data", "truth": "truth", "plan": True} | change
    paths = {name: Path(given[name]) for name in ("data_root", "truth", "rows") if name in given}
    with pytest.raises(UserError) as error:
        run_captures(CapturesOptions(**{**given, **paths}))
    assert words in str(error.value) and "\n" not in str(error.value)


def test_old_masks_are_removed_but_the_last_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(made_masks, "KEPT", 2)
    monkeypatch.setattr(make_masks, "make_masks", lambda data, source, run, folder, overwrite: folder.mkdir() or [])
    write_capture(tmp_path / "data", "bear")
    found, _ = find_captures(CapturesOptions(tmp_path / "data"))
    for number in range(4):
        made_masks.make_masks_once(found[0], PICKED, tmp_path / f"bear-picked-{number}", tmp_path)
    assert sorted(path.name for path in tmp_path.glob("bear-*")) == ["bear-picked-2", "bear-picked-3"]


def test_photos_are_divided_to_the_wanted_size(tmp_path):
    write_capture(tmp_path, "fruit")
    for size, factor in ((800, 1.0), (80, 1.0), (60, 80 / 60), (16, 5.0)):
        found, _ = find_captures(CapturesOptions(tmp_path, size=size))
        assert found[0].photos.downscale == pytest.approx(factor)
        assert found[0].size.pixels == 7 * round(80 / factor) * round(48 / factor)


def test_strays_do_not_make_an_object_small_in_its_picture():
    surfels, _ = discs()
    means = torch.linspace(0.0, 1.0, len(surfels))[:, None].repeat(1, 3)
    low, high = _bulk(replace(surfels, means=means))
    means[-1] = 100.0
    assert torch.equal(_bulk(replace(surfels, means=means))[0], low)
    assert (_bulk(replace(surfels, means=means))[1] - high).abs().max() < 0.05 and (low < 0).all() and (high > 1).all()


def row(scene: str, name: str, psnr: float | None, control: str | None = None) -> ResultRow:
    figures = {**dict.fromkeys(FIGURES), "psnr_fit_after": psnr}
    return ResultRow(Variant(name, control=control), scene, 1, figures, {}, None if psnr else "it broke")


def test_costs_are_beside_the_control_of_the_same_scenes():
    rows = [row("bear, picked", "control", 20.0), row("bear, picked", "own", 19.5, "control")]
    assert [psnr_cost(each, rows) for each in rows] == [None, 0.5]
    rows += [row("fruit, given", "control", None), row("fruit, given", "own", 30.0, "control")]
    averaged = mean_rows(rows, ["bear, picked", "fruit, given"])
    assert [psnr_cost(each, averaged) for each in averaged] == [None, None], "one scene beside two"
    assert groups(["bear, salient", "fern, picked", "fruit, given"]) == {
        "best masks": ["fruit, given"],
        "masks from photos alone": ["bear, salient"],
    }
    assert tables(rows)[-1] == "failed: control on fruit, given: it broke"


def test_rows_refine_as_the_presets_that_they_name():
    """The paper's row is beags-paper but for k and exposures; every other row has a control of its length."""
    experiment = load_experiment(str(ROWS))
    by_name = {variant.name: variant for variant in experiment.variants}
    trials = {run.variant.name: run.trial for run in plan(experiment, [TrialScene("a", Path("/a"), 1.0, "1")], {}, "")}
    assert len({trial.base.digest for trial in trials.values()}) == 1
    models = {name: preset_config(t.preset, t.overrides, Path()).model_config for name, t in trials.items()}
    paper = preset_config("beags-paper", {MODEL + "base_steps": 0}, Path()).model_config
    own = models["the paper's losses"]
    assert replace(own, exposure="off", prepare=replace(own.prepare, k_pixels=0)) == paper
    assert own.exposure == "auto" and own.prepare.k_pixels == 120_000_000
    assert (own.refine_steps, own.losses["boundary"].weight, own.losses["occupancy"].weight) == (3000, 0.5, 10.0)
    assert own.losses["silhouette"].weight == 0.0
    for name in ("beags-refine", "beags-fast"):
        assert models[name] == preset_config(name, {MODEL + "base_steps": 0}, Path()).model_config
    for name, variant in by_name.items():
        assert ("neither loss" in name) == (not any(loss.weight for loss in _of_masks(models[name])))
        if variant.control is not None:
            control = models[variant.control]
            assert control.refine_steps == models[name].refine_steps
    assert [name for name, variant in by_name.items() if variant.control is None and "loss" not in name] == [
        "assignment alone"
    ]


def test_a_base_with_close_ups_takes_them_from_the_masks_and_one_without_is_of_the_photos():
    photos = TrialScene("a", Path("/a"), 1.0, "1")
    masked = TrialScene("a, picked", Path("/a"), 1.0, "2", options={"masks_path": "/masks"}, photos=photos)
    runs = plan(load_experiment(str(ROWS.with_name("rows-focus.toml"))), [masked], {}, "")
    assert [(run.trial.base.scene, run.trial.base.overrides[FOCUS]) for run in runs] == [
        (photos, "off"),
        (masked, "auto"),
    ]


@pytest.mark.slow("two bases are trained for it")
def test_only_the_row_with_close_ups_has_seen_some(tmp_path, monkeypatch, capsys):
    write_capture(tmp_path / "data", "fruit")
    write_truth(tmp_path / "truth", "fruit")
    small_experiment(monkeypatch, tmp_path)
    rows = ROWS.with_name("rows-focus.toml")
    options = CapturesOptions(
        tmp_path / "data",
        tmp_path / "truth",
        rows=rows,
        scenes=("fruit",),
        quick=True,
        size=40,
        output=tmp_path / "out",
    )
    assert [row.failed for row in run_captures(options)] == [None, None]
    seen = {}
    for folder in (tmp_path / "out" / "trials").glob("fruit*-base-*"):
        checkpoint = newest_checkpoint(folder / "run" / "nerfstudio_models")
        focus = json.loads((folder / "trial.json").read_text())["overrides"][FOCUS]
        seen[focus] = saw_close_ups(read_checkpoint(checkpoint))
    assert seen == {"off": False, "auto": True}
    assert "full size" in printed(capsys)


def _of_masks(model) -> list:
    return [model.losses[name] for name in ("boundary", "occupancy", "silhouette")]


@pytest.mark.parametrize("capture", [capture for capture in CAPTURES if PICKED in capture.masks], ids=lambda c: c.name)
def test_the_committed_clicks_lie_in_training_photos(capture):
    objects = read_prompts(capture.prompts, beside_alone=True)
    assert {one.name for one in objects} == set(capture.objects or ("fern",)), "as the silhouettes are called"
    folder = SCENES / capture.name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    outputs = BeagsDataParserConfig(data=folder).setup().get_dataparser_outputs("train")
    photos = {path.stem: path for path in outputs.image_filenames}
    for one in objects:
        for view, prompt in one.prompts.items():
            with Image.open(photos[view]) as image:
                assert all(0 <= x < image.width and 0 <= y < image.height for x, y in prompt.points)


def test_the_real_captures_are_planned_whole():
    truth = SCENES.parent / "truth"
    if not (SCENES.is_dir() and truth.is_dir()):
        pytest.skip(f"{SCENES} or {truth} is not here")
    found, lines = find_captures(CapturesOptions(SCENES, truth))
    assert [each.capture.name for each in found] == [capture.name for capture in CAPTURES] and lines == []
    assert {each.capture.name for each in found if each.truth} == {"bear", "kitchen", "garden", "fruit"}
    for each in found:
        width = each.size.pixels / each.size.views
        assert 400 * 250 < width <= 800 * 600, "400 to 800 pixels on the longer side"
