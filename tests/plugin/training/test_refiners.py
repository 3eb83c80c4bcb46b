"""Refiners through a run: this method, assignment alone, and one of another package that owns its training."""

from __future__ import annotations

import json
from pathlib import Path

import pulse_refiner
import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import (
    STEPS,
    checkpoint_of,
    interrupted,
    kill_at,
    resume_to_end,
    run_to_end,
    short_config,
)
from run_folders import write_scene
from same_bits import differences, without_clocks

from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.objects.export import export_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.refiners import REFINERS, make_refiner
from beags_plugin.runs.read import read_run
from beags_plugin.system import registry
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices

BASE_STEPS = STEPS[0]


def overrides(refiner: str, **options) -> dict:
    return {
        "pipeline.model.refiner": refiner,
        "pipeline.model.refiner_options": options,
        "pipeline.model.prepare.reprojection": "none",
    }


def parameters(state: dict) -> dict:
    return {key: value for key, value in state.items() if key.startswith("gauss_params.")}


@pytest.fixture(scope="module", autouse=True)
def registered():
    """The refiner "pulse", as if an entry point named it."""
    REFINERS.register("pulse", pulse_refiner.SPEC)
    yield
    del REFINERS._specs["pulse"]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("refiners") / "data")


@pytest.fixture(scope="module")
def refined(data, tmp_path_factory):
    """A function that returns the run of a refiner, made once."""
    folder, made = tmp_path_factory.mktemp("runs"), {}

    def run(name: str) -> Path:
        if name not in made:
            made[name] = folder / name
            run_to_end(short_config(data, made[name], **overrides(name)))
        return made[name]

    return run


def test_assignment_alone_keeps_the_base_bit_for_bit(refined):
    run = refined("none")
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert not differences(parameters(base.state), parameters(after.state))
    assert torch.equal(base.members.class_ids, after.members.class_ids) and after.members.objects is None
    found = evaluate_run(run / "config.yml")
    assert found.before is not None and found.before.psnr == found.after.psnr


def test_a_training_of_its_own_changes_what_it_names(refined):
    """Its edit, its rates, its figures and its objects, of which some Gaussians belong to both."""
    run = refined("pulse")
    base, after = read_run(run / "base/config.yml").surfels(), read_run(run / "config.yml").surfels()
    assert len(after) == len(base) + pulse_refiner.SPLIT
    assert torch.equal(after.means[: len(base) - pulse_refiner.SPLIT], base.means[pulse_refiner.SPLIT :])
    assert not torch.equal(after.sh_dc[: len(base) - pulse_refiner.SPLIT], base.sh_dc[pulse_refiner.SPLIT :])
    members = read_run(run / "config.yml").members
    assert (members.of(1) & members.of(2)).sum() > 10
    numbers = checkpoint_of(run)["beags"]["parts"]["refinement"]["own"]["numbers"]
    assert json.loads((run / "training.json").read_text())["pulse"] == pytest.approx(float(numbers.sum()))


@pytest.mark.parametrize("step", [0, 2, pulse_refiner.SPLIT_AT, 7])
def test_a_killed_training_of_its_own_ends_as_the_whole_one(refined, data, tmp_path, monkeypatch, step):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, BASE_STEPS + step), **overrides("pulse"))
    resume_to_end(run)
    found = differences(without_clocks(checkpoint_of(run)), without_clocks(checkpoint_of(refined("pulse"))))
    assert not found, found[:9]


@pytest.mark.parametrize("name", ["bea", "none", "pulse"])
def test_objects_are_extracted_and_exported(refined, tmp_path, name):
    """Each with the Gaussians that the run holds for it, and with all their values."""
    config = refined(name) / "config.yml"
    scene = read_run(config)
    members, whole = scene.members, parameters(scene.state)
    expected = {scene.classes[c]: members.of(c) for c in members.present()}
    assert {"cup", "box"} <= expected.keys()
    for item in extract_objects(config, keep_all=True, output=tmp_path / "extracted"):
        part = read_run(item.config)
        assert not differences(parameters(part.state), {k: v[expected[item.name]] for k, v in whole.items()})
        assert len(read_vertices(item.ply)) == item.gaussians == int(expected[item.name].sum())
    exported = export_run(config, everything=True, keep_all=True, output=tmp_path / "exports")
    assert {item.name: item.gaussians for item in exported} == {k: int(v.sum()) for k, v in expected.items()}


def test_a_run_of_a_refiner_that_is_not_installed_is_read(refined, tmp_path, monkeypatch):
    config = refined("pulse") / "config.yml"
    monkeypatch.delitem(REFINERS._specs, "pulse")
    assert set(evaluate_run(config).after.objects) == {1, 2}
    assert {item.name for item in extract_objects(config, output=tmp_path / "extracted")} == {"cup", "box"}
    assert len(export_run(config, ["cup"], output=tmp_path / "exports")) == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"lavel": 0.1}, "lavel"),
        ({"level": True}, "the option level of the refiner pulse is True: give a float"),
        ({"level": 101.0}, "level is 101: give a number"),
    ],
)
def test_a_wrong_option_is_said_before_anything_is_trained(data, tmp_path, options, sentence):
    config = short_config(data, tmp_path / "run", **overrides("pulse", **options))
    with pytest.raises(UserError, match=sentence):
        config.model_config.check()


def test_an_option_that_does_not_fit_the_classes_is_said_before_anything_is_trained(data, tmp_path):
    config = short_config(data, tmp_path / "run", **overrides("pulse", object="cap"))
    with pytest.raises(UserError, match="there is no object 'cap'.*: choose one of cup, box"):
        run_to_end(config)
    assert not list((tmp_path / "run").rglob("*.ckpt"))


@pytest.mark.parametrize("name", ["flashsplat", "magic"])
def test_an_unknown_refiner_is_refused_with_how_to_install_others(name, monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [])
    monkeypatch.setattr(REFINERS, "_discovered", False)
    monkeypatch.setattr(REFINERS, "_specs", {"bea": "", "none": ""})
    with pytest.raises(UserError, match=rf"'{name}': choose one of bea, none; .* \(pip install ./baselines in "):
        make_refiner(name, {})


def test_a_checkpoint_of_another_refiner_is_refused(data, tmp_path, monkeypatch):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, BASE_STEPS + 6), **overrides("pulse"))
    config = short_config(data, tmp_path / "other", **overrides("none"))
    (config.load_checkpoint,) = (run / "nerfstudio_models").iterdir()
    with pytest.raises(UserError, match="refinement began with the refiner pulse.*, not with none"):
        run_to_end(config)


def test_a_run_says_that_its_refiner_did_not_end(data, tmp_path, capsys):
    config = short_config(data, tmp_path / "run", **overrides("pulse"))
    config.max_num_iterations = BASE_STEPS + 4
    run_to_end(config)
    assert "The refiner pulse was stopped before its end" in " ".join(capsys.readouterr().out.split())


def test_a_run_of_before_the_options_of_refiners_is_read(refined, tmp_path):
    from beags_plugin.plugin.options.saved_config import load_run_config

    lines = (refined("none") / "config.yml").read_text().splitlines()
    (tmp_path / "config.yml").write_text("\n".join(line for line in lines if "refiner_options" not in line))
    assert load_run_config(tmp_path / "config.yml").model_config.refiner_options == {}
