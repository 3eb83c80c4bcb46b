"""Training on the objects' pixels alone: what lies outside the masks has no say, and dark objects come out solid."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from data_folders import noise, write_image
from PIL import Image
from raster_scenes import make_scene
from resumed_runs import (
    assert_same_run,
    interrupted,
    kill_at,
    resume_to_end,
    run_to_end,
    short_config,
)
from run_folders import write_drawn_scene, write_trained

from beags_plugin.evaluation.records import IMAGE_FIGURES
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.normal import NormalConsistencyLoss
from beags_plugin.losses.photometric import PhotometricLoss
from beags_plugin.objects.evaluate import EvaluatedRun
from beags_plugin.plugin.presets import preset_config
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.prepared import photos_contradict
from beags_plugin.runs.read import read_run
from beags_plugin.views.objects_alone import objects_alone, of_objects

# masks as they are: a pixel that the vote gives to an object would have the photo's say
OPTIONS = {"pipeline.datamanager.photos": "objects", "pipeline.model.prepare.reprojection": "none",
           "pipeline.model.background_color": "black", "pipeline.model.densify.reset_every": 0,
           "pipeline.datamanager.dataparser.num_random_points": 3000}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return two scenes of black objects, before black and before other noise in each photo; and a run on the first."""
    root = tmp_path_factory.mktemp("turntable")
    write_drawn_scene(root / "black")
    for mask in sorted((root / "black/masks").iterdir()):
        ids = np.asarray(Image.open(mask)).astype(np.uint16)
        ids[:, :12] = IGNORE  # a part of the cup too
        write_image(mask, ids)
        write_image(root / "black/images" / mask.name, np.zeros((*ids.shape, 3), np.uint8))
    shutil.copytree(root / "black", root / "noise")
    train = json.loads((root / "noise/transforms.json").read_text())["frames"]
    for index, name in enumerate(sorted(frame["file_path"] for frame in train)[1:8]):  # those that train
        ids = np.asarray(Image.open(root / "noise/masks" / f"{name[-7:-4]}.png"))
        photo = np.random.default_rng(index).integers(0, 256, (*ids.shape, 3), dtype=np.uint8)
        photo[(ids != 0) & (ids != IGNORE)] = 0
        write_image(root / "noise" / name, photo)
    run_to_end(short_config(root / "black", root / "run", **OPTIONS))
    return root


def test_what_surrounds_objects_changes_no_bit_and_a_killed_run_ends_alike(folders, tmp_path, monkeypatch):
    run = tmp_path / "run"
    interrupted(folders / "noise", run, monkeypatch, lambda patch: kill_at(patch, 30), **OPTIONS)
    with monkeypatch.context() as patch, pytest.raises(BaseException, match="^$"):
        kill_at(patch, 50)
        resume_to_end(run)
    resume_to_end(run)
    assert_same_run(run, folders / "run")


def test_black_objects_are_solid_and_nothing_else_is(folders):
    """If the background were always black, black objects could stay empty space."""
    scene = read_run(folders / "run/config.yml")
    views = EvaluatedRun(folders / "run/config.yml").views
    for view in views:
        camera = view.camera
        with torch.no_grad():
            inputs = surfel_inputs(scene.surfels(), camera)
            alpha = make_rasterizer("auto").rasterize(inputs, camera, scene.settings, torch.zeros(3)).alpha
        inside = (view.visible != 0) & (view.visible != IGNORE)
        assert alpha[inside].mean() > 0.6 and alpha[view.visible == 0].mean() < 0.1, (
            alpha[inside].mean(),
            alpha[view.visible == 0].mean(),
        )


def test_only_the_objects_of_such_a_run_are_scored(folders):
    metrics = EvaluatedRun(folders / "run/config.yml").metrics()
    assert [name for name in IMAGE_FIGURES if getattr(metrics.after, name) is not None] == ["psnr_objects"]
    assert metrics.after.mean.extracted is not None
    assert any("objects' pixels alone" in note for note in metrics.notes)


def test_losses_move_depth_and_colour_in_their_pixels_alone():
    """Depth where objects are, colour where it is known."""
    scene = make_scene()
    drawn = make_rasterizer("torch").rasterize(scene.inputs, scene.camera, scene.settings, scene.background)
    leaves = {name: getattr(drawn, name).detach().requires_grad_() for name in ("color", "depth")}
    labels = torch.zeros(drawn.alpha.shape, dtype=torch.int32)
    labels[8:20, 10:25], labels[:, 18:] = 2, IGNORE
    photo = torch.rand(drawn.color.shape, dtype=torch.float64)
    batch = objects_alone({"labels": labels, "image": photo})
    render = of_objects(replace(drawn, **leaves), batch["image"], batch)
    inputs = LossInputs(0, 0, None, scene.camera, render, batch["image"])  # type: ignore[arg-type]
    (PhotometricLoss().value(inputs) + NormalConsistencyLoss().value(inputs)).backward()
    assert (leaves["color"].grad.any(dim=-1) == (labels != IGNORE)).all()
    moved, inside = leaves["depth"].grad != 0, labels == 2
    assert moved[inside].any() and not moved[~inside].any()


@pytest.mark.parametrize("contradict", [False, True])
def test_a_run_says_that_its_background_contradicts_itself(tmp_path, capsys, contradict):
    """The photos are of the very scene that it starts from, as they are or with other noise around the objects."""
    write_drawn_scene(tmp_path / "data")
    for index in range(9 if contradict else 0):
        ids = np.asarray(Image.open(tmp_path / f"data/masks/v{index:02d}.png"))
        photo = np.array(Image.open(tmp_path / f"data/images/v{index:02d}.png"))
        photo[ids == 0] = noise(index, *ids.shape[::-1])[ids == 0]
        write_image(tmp_path / f"data/images/v{index:02d}.png", photo)
    write_trained(tmp_path / "base", tmp_path / "data", base=False)
    frame = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    options = {f"pipeline.datamanager.dataparser.{name}": value for name, value in frame.items()}
    options |= {"pipeline.model.refine_steps": 1, "pipeline.model.close_contacts": False}
    config = preset_config("beags-refine", options, tmp_path)
    config.data, config.run_dir, config.vis = tmp_path / "data", tmp_path / "run", "tensorboard"
    config.load_dir = tmp_path / "base/nerfstudio_models"
    run_to_end(config)
    assert photos_contradict(tmp_path / "run") == contradict
    assert ("--pipeline.datamanager.photos objects" in capsys.readouterr().out) == contradict
