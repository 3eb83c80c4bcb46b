"""Every method through a run: what it does to the scene, which objects it leaves, how a resumed run ends."""

from __future__ import annotations

import json
import shutil
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import write_image
from PIL import Image

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
from run_folders import CLASSES, write_scene
from same_bits import differences, without_clocks
from viewer_windows import Window

from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.objects.export import export_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.training import densifier
from beags_plugin.plugin.training.scene_edits import edit_scene
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.read import read_run
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices

pytestmark = pytest.mark.slow("a training for each method")

UNTRAINED = {
    "none": {},
    "flashsplat": {"gamma": -0.9},
    "gaussiancut": {"num_edges": 3, "foreground_threshold": 0.6},
    "dr-splat": {"top_k": 2},
}
OWN: dict[str, dict] = {
    "cob-gs": {"epochs": 6, "tau": 0.4, "threshold": 0.2},  # both objects claim some Gaussians
    "cob-gs: box": {"object": "box", "epochs": 6, "tau": 0.4, "threshold": 0.2},
    "trace3d": {"min_pixels": 2, "max_ambiguous": 0.7, "member_share": 0.5},
    "gaussian-grouping": {"threshold": 0.25},
    "objectgs": {"labels": "nonzero"},
    "opengaussian": {"coarse": 8, "fine": 4, "min_gaussians": 1, "min_leaf": 1, "max_scale": 9.0, "min_views": 1},
    "instascene": {"min_gaussians": 2, "samples": 500, "cosine": 0.8},
    "ilgs": {"threshold": 0.02},
    "unified-lift": {"codes": 200, "threshold": 0.02},  # many random codes, some of which are of an object
}
EDITING = {"sagd": {"threshold": 0.3, "gd_interval": 2}}
RUNS = {**UNTRAINED, **OWN, **EDITING}
"""Options by the name of a refiner, perhaps with a remark after a colon."""
PLACES = ["/gauss_params.means", "/gauss_params.scales"]
BASE_STEPS = STEPS[0]


def overrides(refiner: str, **options) -> dict:
    return {
        "pipeline.model.refiner": refiner.partition(":")[0],
        "pipeline.model.refiner_options": options,
        "pipeline.model.prepare.reprojection": "none",
    }


def parameters(state: dict) -> dict:
    return {key: value for key, value in state.items() if key.startswith("gauss_params.")}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("refiners") / "data")


@pytest.fixture(scope="module")
def refined(data, tmp_path_factory):
    """A function that returns the run of a refiner, made once."""
    folder, made = tmp_path_factory.mktemp("runs"), {}

    def run(name: str) -> Path:
        if name not in made:
            made[name] = folder / name.replace(": ", "-")
            run_to_end(short_config(data, made[name], **overrides(name, **RUNS[name])))
        return made[name]

    return run


@pytest.mark.parametrize("name", UNTRAINED)
def test_a_refiner_that_trains_nothing_keeps_the_base_bit_for_bit(refined, name):
    run = refined(name)
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert not differences(parameters(base.state), parameters(after.state))
    assert base.members.objects is None, "base/ holds assignment alone"
    found = evaluate_run(run / "config.yml")
    assert found.before is not None and found.before.psnr == found.after.psnr


@pytest.mark.parametrize("name", ["opengaussian", "instascene"])
def test_a_refiner_that_learns_features_keeps_the_base_bit_for_bit(refined, name):
    run = refined(name)
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert not differences(parameters(base.state), parameters(after.state))
    own = checkpoint_of(run)["beags"]["parts"]["refinement"]["own"]
    assert own["adam"]["state"], "it has made steps"


def test_every_refiner_has_a_run_here():
    points = entry_points(group="beags.refiners")
    methods = {point.name for point in points if point.value.startswith("beags_baselines.")}
    assert {name.partition(":")[0] for name in RUNS} == {"none", *methods}


@pytest.mark.parametrize("name", RUNS)
def test_the_report_of_a_run_keeps_how_many_pixels_the_codes_got_right(refined, name):
    report = json.loads((refined(name) / "training.json").read_text())
    assert ("labelled_share" in report) == (name in ("gaussian-grouping", "ilgs"))
    assert 0.0 < report.get("labelled_share", 0.5) < 1.0


@pytest.mark.parametrize("name", RUNS)
def test_objects_of_every_refiner_are_extracted_and_exported(refined, tmp_path, name):
    """Each with the Gaussians that the run holds for it, and with all their values."""
    config = refined(name) / "config.yml"
    scene = read_run(config)
    members, whole = scene.members, parameters(scene.state)
    expected = {scene.classes[c]: members.of(c) for c in members.present()}
    assert CLASSES[0] in expected and len(expected) > 1, "some Gaussians are of an object"
    extracted = extract_objects(config, keep_all=True, output=tmp_path / "extracted")
    assert {item.name for item in extracted} == expected.keys() - {CLASSES[0]}
    for item in extracted:
        part = read_run(item.config)
        assert [part.classes[c] for c in part.members.present()] == [item.name]
        assert not differences(parameters(part.state), {k: v[expected[item.name]] for k, v in whole.items()})
        assert len(read_vertices(item.ply)) == item.gaussians == int(expected[item.name].sum())
    exported = export_run(config, everything=True, keep_all=True, output=tmp_path / "exports")
    assert {item.name: item.gaussians for item in exported} == {k: int(v.sum()) for k, v in expected.items()}
    vertices = {path.stem: len(read_vertices(path)) for path in (tmp_path / "exports").glob("*.ply")}
    assert vertices == {item.name: item.gaussians for item in exported}


@pytest.mark.parametrize("name", RUNS)
def test_the_viewer_shows_the_objects_of_every_refiner(refined, name, monkeypatch):
    """Each isolated: the Gaussians that the run holds for it, drawn as if there were no others."""
    config = refined(name) / "config.yml"
    scene = read_run(config)
    members, surfels, cameras = scene.members, scene.surfels(), []
    window = Window(config)
    try:
        panel, model, viewing = window.panel, window.model, window.model.viewing
        window.viewer.control_panel._max_res.value = 64
        outputs = viewing.outputs
        monkeypatch.setattr(viewing, "outputs", lambda camera: cameras.append(camera) or outputs(camera))
        whole = window.look_as_it_opens()["rgb"]
        assert panel.listed.counts == {c: int(members.of(c).sum()) for c in members.present()}
        for class_id in members.present():
            panel.object.value = scene.classes[class_id]
            panel.act("Isolate")
            shown = window.look_as_it_opens()["rgb"]
            assert torch.equal(viewing.visible().index, members.of(class_id).nonzero()[:, 0])
            inputs = surfel_inputs(surfels[members.of(class_id)], cameras[-1], model.active_sh_degree())
            alone = model.rasterizer.rasterize(inputs, cameras[-1], model.settings(), viewing.background)
            assert torch.equal(shown, alone.color.clamp(0.0, 1.0))
            assert not torch.equal(shown, whole)
    finally:
        window.close()


def test_objects_that_overlap_go_through_evaluation_extraction_and_export(refined):
    run = refined("flashsplat")
    scene = read_run(run / "config.yml")
    members, names = scene.members, scene.classes
    objects = [c for c in members.present() if c != 0]
    assert members.objects is not None and len(objects) >= 2
    assert sum(int(members.of(c).sum()) for c in objects) > int((~members.of(0)).sum()), "some are of two objects"
    extracted = {item.name: item for item in extract_objects(run / "config.yml", keep_all=True)}
    exported = {each.name: each for each in export_run(run / "config.yml", everything=True)}
    for class_id in objects:
        count = int(members.of(class_id).sum())
        clean = exported[names[class_id]]
        assert clean.left_out is not None
        assert clean.gaussians == count - clean.left_out.outside - clean.left_out.loose
        assert extracted[names[class_id]].gaussians == count
        part = read_run(extracted[names[class_id]].config)
        assert part.members.present() == [class_id] and len(part.members) == count
        assert evaluate_run(extracted[names[class_id]].config).after.objects[class_id].extracted.iou > 0.1
    name = names[objects[0]]
    (without,) = extract_objects(run / "config.yml", [name], remove=True)
    assert without.gaussians == len(members) - int(members.of(objects[0]).sum())
    left = read_run(without.config).members.of(objects[1])
    assert int(left.sum()) == int((members.of(objects[1]) & ~members.of(objects[0])).sum()) > 0


@pytest.mark.parametrize(
    "name", ["gaussian-grouping", "objectgs", "opengaussian", "instascene", "ilgs", "unified-lift"]
)
def test_ids_far_apart_and_threads_change_nothing(refined, data, tmp_path, name):
    """The same masks with the ids 300 and 40000 for 1 and 2, trained with three threads."""
    far = {0: 0, 1: 300, 2: 40_000}
    shutil.copytree(data, tmp_path / "data")
    (tmp_path / "data/classes.json").write_text(json.dumps({str(far[c]): n for c, n in CLASSES.items() if c}))
    for file in (tmp_path / "data/masks").iterdir():
        write_image(file, np.vectorize(far.get, otypes=[np.uint16])(np.array(Image.open(file))))
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        run_to_end(short_config(tmp_path / "data", tmp_path / "run", **overrides(name, **OWN[name])))
    finally:
        torch.set_num_threads(threads)
    one, other = read_run(refined(name) / "config.yml"), read_run(tmp_path / "run/config.yml")
    assert not differences(parameters(one.state), parameters(other.state))
    assert [far[c] for c in one.members.present()] == other.members.present()
    assert all(torch.equal(one.members.of(c), other.members.of(far[c])) for c in far)


def test_objectgs_trains_the_scene_but_not_its_classes(refined):
    run = refined("objectgs")
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert len(differences(parameters(base.state), parameters(after.state))) == 6, "all of them moved"
    e6, phi = base.members.class_ids, after.members.class_ids
    assert after.members.objects is None and torch.equal(phi[e6 != 0], e6[e6 != 0])
    assert (phi != 0).sum() > (e6 != 0).sum(), "one pixel of an object makes one of it"


def test_unified_lift_keeps_the_base_bit_for_bit(refined):
    run = refined("unified-lift")
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert not differences(parameters(base.state), parameters(after.state))
    assert after.members.objects is not None and any(len(each) for each in after.members.objects.values())
    found = evaluate_run(run / "config.yml")
    assert found.before is not None and found.before.psnr == found.after.psnr


def test_sagd_draws_members_at_rims_into_their_objects(refined, data, tmp_path, capsys):
    """Nothing is trained: only places and sizes of members change, and without decomposition not even those."""
    run = refined("sagd")
    base, after = read_run(run / "base/config.yml"), read_run(run / "config.yml")
    assert differences(parameters(base.state), parameters(after.state)) == PLACES
    moved = (base.surfels().means != after.surfels().means).any(dim=1)
    shrunk = after.surfels().log_scales < base.surfels().log_scales
    assert moved.sum() > 0 and torch.equal(moved, shrunk.all(dim=1)) and torch.equal(moved, shrunk.any(dim=1))
    assert after.members.objects is None and bool((after.members.class_ids[moved] != 0).all())
    capsys.readouterr()
    options = {**EDITING["sagd"], "gd_interval": -1}
    run_to_end(short_config(data, tmp_path / "run", **overrides("sagd", **options)))
    assert "decomposition" not in capsys.readouterr().out
    without = read_run(tmp_path / "run/config.yml")
    assert not differences(parameters(base.state), parameters(without.state))
    assert torch.equal(without.members.class_ids, after.members.class_ids)


def test_a_joint_base_grows_with_the_classes_of_its_seeds(data, tmp_path, monkeypatch):
    """Clones and splits inherit; a killed run ends as the whole one; there is no refinement."""
    changes, edits = overrides("objectgs", joint=True), []

    def spied(model, adam, edited):
        before = model.class_ids
        edit_scene(model, adam, edited)
        edits.append((before[edited.source], model.class_ids, edited.fresh))

    run_to_end(short_config(data, tmp_path / "plain", **overrides("none")))
    monkeypatch.setattr(densifier, "edit_scene", spied)
    run_to_end(short_config(data, tmp_path / "whole", **changes))
    assert len(edits) == 3 and all(torch.equal(inherited, found) for inherited, found, _ in edits)
    assert all(classes[fresh].any() for classes, _, fresh in edits), "new Gaussians are of objects too"

    whole = checkpoint_of(tmp_path / "whole")
    assert whole["step"] == BASE_STEPS - 1 and whole["pipeline"]["_model.assigned"]
    plain = checkpoint_of(tmp_path / "plain")["pipeline"]
    opacities = [state["_model.gauss_params.opacities"] for state in (plain, whole["pipeline"])]
    assert opacities[0].shape != opacities[1].shape or not torch.equal(*opacities), "the classes take part"
    scene = read_run(tmp_path / "whole/config.yml")
    assert scene.members.present() == [0, 1, 2] and scene.members.objects is None
    assert set(evaluate_run(tmp_path / "whole/config.yml").after.objects) == {1, 2}
    for step in (3, 24):
        interrupted(data, tmp_path / str(step), monkeypatch, lambda patch, at=step: kill_at(patch, at), **changes)
        resume_to_end(tmp_path / str(step))
        found = differences(without_clocks(checkpoint_of(tmp_path / str(step))), without_clocks(whole))
        assert not found, found[:9]


@pytest.mark.parametrize(
    ("name", "step"),
    # cob-gs is also stopped where the next object begins, and after a checkpoint that follows this.
    [*((name, step) for name in OWN for step in (0, 2, 7)), ("cob-gs", 14), ("cob-gs", 20), ("sagd", 0)],
)
def test_a_killed_run_ends_as_the_whole_one(refined, data, tmp_path, monkeypatch, name, step):
    run = tmp_path / "run"
    changes = overrides(name, **RUNS[name])
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


def test_a_run_that_cannot_be_is_refused(refined, data, tmp_path):
    changes = {**overrides("objectgs", joint=True), "pipeline.model.base_steps": 0}
    config = short_config(data, tmp_path / "run", **changes)
    config.load_dir = refined("none") / "base/nerfstudio_models"
    with pytest.raises(UserError, match="joint trains a base of its own"):
        run_to_end(config)


def test_a_joint_base_needs_masks(tmp_path):
    data = write_scene(tmp_path / "data", masks=False)
    changes = {**overrides("objectgs", joint=True), "pipeline.model.refine_steps": 0}
    with pytest.raises(UserError, match="no training view has a mask"):
        run_to_end(short_config(data, tmp_path / "run", **changes))


def test_objects_of_a_former_refiner_do_not_stay(data, refined, tmp_path):
    config = short_config(data, tmp_path / "run", **overrides("none"), **{"pipeline.model.base_steps": 0})
    config.load_dir = refined("flashsplat") / "base/nerfstudio_models"
    run_to_end(config)
    assert read_run(tmp_path / "run/config.yml").members.objects is None
    stopped = short_config(data, tmp_path / "stopped", **overrides("flashsplat", **UNTRAINED["flashsplat"]))
    stopped.max_num_iterations = BASE_STEPS
    run_to_end(stopped)
    config = short_config(data, tmp_path / "again", **overrides("none"), **{"pipeline.model.base_steps": 0})
    config.load_dir = tmp_path / "stopped/nerfstudio_models"
    run_to_end(config)
    for again in ("again", "again/base"):
        assert read_run(tmp_path / again / "config.yml").members.objects is None
