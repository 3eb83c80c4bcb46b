"""Every refiner through a run: what it does to the scene, which objects it leaves, how a resumed run ends."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from resumed_runs import (
    STEPS,
    checkpoint_of,
    differences,
    interrupted,
    kill_at,
    resume_to_end,
    run_to_end,
    short_config,
    without_clocks,
)
from run_folders import write_scene

from beags_plugin.plugin.objects.evaluate import evaluate_run
from beags_plugin.plugin.objects.export import export_run
from beags_plugin.plugin.objects.extract import extract_objects
from beags_plugin.plugin.runs.read import read_run
from beags_plugin.system.errors import UserError

UNTRAINED = {
    "none": {},
    "flashsplat": {"gamma": -0.9},
    "gaussiancut": {"num_edges": 3, "foreground_threshold": 0.6},
}
OWN: dict[str, dict] = {
    "cob-gs": {"epochs": 6, "tau": 0.4, "threshold": 0.2},  # both objects claim some Gaussians
    "trace3d": {"min_pixels": 2},
}
BASE_STEPS = STEPS[0]


def overrides(refiner: str, **options) -> dict:
    return {
        "pipeline.model.refiner": refiner,
        "pipeline.model.refiner_options": options,
        "pipeline.model.refine_rounds": 1,
        "pipeline.model.prepare.reprojection": "none",
    }


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("refiners") / "data")


@pytest.fixture(scope="module")
def refined(data, tmp_path_factory):
    """A function that returns the run of a refiner, made once."""
    folder, made = tmp_path_factory.mktemp("runs"), {}

    def run(name: str) -> Path:
        if name not in made:
            options = {**UNTRAINED, **OWN}[name]
            run_to_end(short_config(data, folder / name, **overrides(name, **options)))
            made[name] = folder / name
        return made[name]

    return run


@pytest.mark.parametrize("name", UNTRAINED)
def test_a_refiner_that_trains_nothing_keeps_the_base_bit_for_bit(refined, name):
    run = refined(name)
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    state = {key: value for key, value in after.state.items() if key.startswith("gauss_params.")}
    assert not differences(state, {key: base.state[key] for key in state})
    assert base.members.objects is None, "base/ holds assignment alone"
    found = evaluate_run(run / "config.yml")
    assert found.before is not None and found.before.psnr == found.after.psnr


def test_objects_that_overlap_go_through_evaluation_extraction_and_export(refined):
    run = refined("flashsplat")
    scene = read_run(run / "config.yml")
    members, names = scene.members, scene.classes
    objects = [c for c in members.present() if c != 0]
    assert members.objects is not None and len(objects) >= 2
    assert sum(int(members.of(c).sum()) for c in objects) > int((~members.of(0)).sum()), "some are of two objects"
    extracted = {item.name: item for item in extract_objects(run / "config.yml")}
    exported = {each.name: each for each in export_run(run / "config.yml", everything=True)}
    for class_id in objects:
        count = int(members.of(class_id).sum())
        assert extracted[names[class_id]].gaussians == exported[names[class_id]].gaussians == count
        part = read_run(extracted[names[class_id]].config)
        assert part.members.present() == [class_id] and len(part.members) == count
        assert evaluate_run(extracted[names[class_id]].config).after.objects[class_id].extracted.iou > 0.1
    name = names[objects[0]]
    (without,) = extract_objects(run / "config.yml", [name], remove=True)
    assert without.gaussians == len(members) - int(members.of(objects[0]).sum())
    left = read_run(without.config).members.of(objects[1])
    assert int(left.sum()) == int((members.of(objects[1]) & ~members.of(objects[0])).sum()) > 0


@pytest.mark.parametrize(
    ("name", "step"),
    # of cob-gs also where the next object begins, and after a checkpoint that follows this
    [*((name, step) for name in OWN for step in (0, 2, 7)), ("cob-gs", 14), ("cob-gs", 20)],
)
def test_a_killed_run_ends_as_the_whole_one(refined, data, tmp_path, monkeypatch, name, step):
    run = tmp_path / "run"
    changes = overrides(name, **OWN[name])
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, BASE_STEPS + step), **changes)
    resume_to_end(run)
    found = differences(without_clocks(checkpoint_of(run)), without_clocks(checkpoint_of(refined(name))))
    assert not found, found[:9]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"gama": 0.1}, "gama"),
        ({"gamma": True}, "the option gamma of the refiner flashsplat is True: give a float"),
        ({"gamma": 2.0}, "gamma is 2, but"),
    ],
)
def test_a_wrong_option_is_said_before_anything_is_trained(data, tmp_path, options, sentence):
    config = short_config(data, tmp_path / "run", **overrides("flashsplat", **options))
    with pytest.raises(UserError, match=sentence):
        config.model_config.check()


def test_more_rounds_are_for_refiners_that_train_with_the_losses_of_the_config(data, tmp_path):
    config = short_config(data, tmp_path / "run", **{**overrides("none"), "pipeline.model.refine_rounds": 2})
    with pytest.raises(UserError, match="refine_rounds is 2: the refiner none has 1 round"):
        run_to_end(config)
