"""Exposures of photos that share no points: the base shows how they differ, once it is roughly right."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, checkpoint_of, interrupted, kill_at, resume_to_end, run_to_end, short_config
from training_in_processes import train_in_two

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.surfels import Surfels
from beags_plugin.plugin.options.schedule import PhaseSchedule
from beags_plugin.plugin.runs.read import read_run
from beags_plugin.plugin.training import exposure as learning
from beags_plugin.plugin.training.exposure import (
    GAMMA,
    asked_of_base,
    base_gains,
    exposures_of_base,
    exposures_of_run,
    photo_gains,
)
from beags_plugin.plugin.views.datamanager import BeagsDataManager, BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import resize_area
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.sample.exposure import photo_gains as true_gains
from beags_plugin.sample.writer import SampleConfig, write_sample

SAMPLE = SampleConfig(width=160, height=144, num_train=8, num_test=2, num_points=200)
SMALL = replace(SAMPLE, width=56, height=42, num_points=600)
BASE_STEP = 11  # of the 45 of the base


def written(at: Path, config: SampleConfig) -> Path:
    write_sample(at / "data", config)
    (at / "data/seed_tracks.json").unlink()
    return at / "data"


@pytest.fixture(scope="module")
def alike(shared):
    """A sample of photos of one exposure, whose points say nothing of which photos show them."""
    return shared("trackless", lambda at: written(at, SAMPLE)) / "data"


@pytest.fixture(scope="module")
def exposed(shared):
    """The same photos, each in an exposure and white balance of its own."""
    return (
        shared("trackless_exposed", lambda at: written(at, replace(SAMPLE, exposure=1.2, white_balance=0.4))) / "data"
    )


@pytest.fixture(scope="module")
def small(shared):
    return shared("trackless_small", lambda at: written(at, replace(SMALL, exposure=1.5))) / "data"


def asking(data: Path, run: Path, **options):
    """The config of a short run whose base begins exposures, whatever it shows."""
    return short_config(data, run, **{"pipeline.model.exposure": "on", **options})


@pytest.fixture(scope="module")
def whole(shared, small):
    return shared("trackless_run", lambda at: run_to_end(asking(small, at / "run"))) / "run"


def manager_of(data: Path, **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data), **options)
    return BeagsDataManager(config, device="cpu", test_mode="val")


@dataclass
class Rendered:
    color: torch.Tensor
    alpha: torch.Tensor


class TrainedOn:
    """A rasterizer of a scene that shows each view exactly as a photo, times a light [H, W] of its own."""

    def __init__(self, manager: BeagsDataManager, light=lambda width, height: torch.ones(height, width)) -> None:
        self.views, self.light = manager.views("train"), light
        self.sizes: list[tuple[int, int]] = []

    def rasterize(self, inputs, camera, settings, background) -> Rendered:
        (view,) = (view for view in self.views if torch.equal(view.camera.viewmat, camera.viewmat))
        self.sizes.append((camera.width, camera.height))
        photo = torch.from_numpy(resize_area(view.image.numpy(), camera.width, camera.height))
        color = photo * self.light(camera.width, camera.height)[..., None] ** (1 / GAMMA)
        return Rendered(color, torch.ones(camera.height, camera.width))


@dataclass
class Model:
    """What exposures ask of a model."""

    rasterizer: TrainedOn
    exposure: str = "auto"
    exposures: Exposures | None = None
    device: str = "cpu"
    schedule: PhaseSchedule = field(default_factory=lambda: PhaseSchedule(base_steps=100, refine_steps=0))
    background_color = torch.zeros(3)

    @property
    def config(self) -> Model:
        return self

    def surfels(self) -> Surfels:
        empty = torch.zeros(0, 3)
        return Surfels(empty, torch.zeros(0, 4), empty[:, :2], empty[:, 0], empty, torch.zeros(0, 15, 3))

    def settings(self, geometry: bool) -> RasterSettings:
        return RasterSettings(0.01, 100.0, geometry)


def true_stops(manager: BeagsDataManager) -> np.ndarray:
    stems = [[path.stem for path in each.image_filenames] for each in (manager.train_dataset, manager.eval_dataset)]
    of_photo = true_gains(*stems, SAMPLE.seed, 1.2, 0.4)
    return np.log2([of_photo[view.name] for view in manager.views("train")])


# -- what a base shows, and when it counts -----------------------------------------------------------------------------


def test_photos_that_a_base_shows_in_other_light_get_transforms_and_one_line_says_so(alike, exposed, capsys):
    model, manager = Model(TrainedOn(manager_of(alike))), manager_of(exposed)
    assert photo_gains(manager) is None and exposures_of_run(model, manager) is None
    assert asked_of_base(model, manager) == 25
    capsys.readouterr()
    own = exposures_of_base(model, manager)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("The photos differ in exposure by 0.") and "and their colours by 0." in line
    assert "besides, as the base shows them: each gets a colour transform of its own" in line
    assert own is not None and max(model.rasterizer.sizes) == (142, 128)
    diagonal = own.affine.detach()[:, range(3), range(3)]
    assert torch.allclose(diagonal.mean(dim=0), torch.ones(3), atol=1e-6)
    stops = GAMMA * torch.log2(diagonal)
    stops -= stops.mean(dim=0)
    true = torch.from_numpy(true_stops(manager)).float()
    assert true.std(dim=0).min() > 0.2 and (stops - true).abs().max() < 0.08


def test_photos_that_a_base_shows_as_they_are_get_none(alike, capsys):
    model, manager = Model(TrainedOn(manager_of(alike))), manager_of(alike)
    capsys.readouterr()
    assert exposures_of_base(model, manager) is None and model.exposures is None
    assert capsys.readouterr().out == ""
    model.exposure = "on"
    own = exposures_of_base(model, manager)
    assert own is not None and torch.allclose(own.affine, torch.eye(3, 4).repeat(8, 1, 1), atol=2e-3)


def test_what_differs_within_a_photo_is_no_exposure(alike, exposed):
    """A scene that has half of each photo wrong, or a table that shines, says nothing of photos."""

    def halves(width: int, height: int) -> torch.Tensor:
        return torch.where(torch.arange(width) < width // 2, 0.6, 1.0).expand(height, width)

    assert exposures_of_base(Model(TrainedOn(manager_of(alike), halves)), manager_of(exposed)) is None
    even = TrainedOn(manager_of(alike), lambda width, height: torch.full((height, width), 0.8))
    assert exposures_of_base(Model(even), manager_of(exposed)) is not None


def test_a_photo_that_shows_nothing_begins_at_the_identity(alike, exposed, monkeypatch):
    manager = manager_of(exposed)
    manager.cached_train[3]["image"] = torch.zeros_like(manager.cached_train[3]["image"])
    found = base_gains(Model(TrainedOn(manager_of(alike))), manager, manager.views("train"))
    assert np.isinf(found.noise[3]) and not found.stops[3].any() and np.isfinite(np.delete(found.noise, 3)).all()
    assert np.delete(found.stops, 3, axis=0).mean(axis=0) == pytest.approx(0.0, abs=1e-4)


def test_of_many_photos_some_tell_and_then_all_are_compared(alike, exposed, monkeypatch):
    manager = manager_of(exposed)
    every = exposures_of_base(Model(TrainedOn(manager_of(alike))), manager)
    monkeypatch.setattr(learning, "MOST_VIEWS", 3)
    model = Model(TrainedOn(manager_of(alike)))
    assert exposures_of_base(model, manager_of(alike)) is None and len(model.rasterizer.sizes) == 3
    some = exposures_of_base(model, manager)
    assert len(model.rasterizer.sizes) == 3 + 3 + 8 and torch.equal(some.affine, every.affine)


def test_streamed_photos_are_compared_alike(alike, exposed):
    gains = []
    for stream in ("never", "always"):
        manager = manager_of(exposed, stream=stream)
        gains.append(base_gains(Model(TrainedOn(manager_of(alike))), manager, manager.views("train")))
    assert np.array_equal(gains[0].stops, gains[1].stops) and np.array_equal(gains[0].noise, gains[1].noise)


def test_when_a_base_is_asked(alike, exposed, shared):
    manager, scene = manager_of(exposed), TrainedOn(manager_of(alike))
    assert asked_of_base(Model(scene, "off"), manager) is None
    assert asked_of_base(Model(scene, "on"), manager) == 25
    assert asked_of_base(Model(scene, exposures=Exposures(("a",), torch.eye(3, 4)[None])), manager) is None
    warm = PhaseSchedule(base_steps=100, refine_steps=0, warm=True)
    assert asked_of_base(Model(scene, schedule=warm), manager) == 0
    assert asked_of_base(Model(scene, schedule=PhaseSchedule(0, 100)), manager) == 0
    tracked = shared("tracked", lambda at: write_sample(at / "data", SMALL)) / "data"
    assert asked_of_base(Model(scene), manager_of(tracked)) is None


def test_objects_that_turn_in_a_standing_light_are_no_exposures(alike, exposed, shared):
    model, manager = Model(TrainedOn(manager_of(alike))), manager_of(exposed, photos="objects")
    assert asked_of_base(model, manager) is None
    at = shared("tracked_exposed", lambda at: write_sample(at / "data", replace(SMALL, exposure=1.5))) / "data"
    assert exposures_of_run(model, manager_of(at, photos="objects")) is None
    assert exposures_of_run(model, manager_of(at)) is not None
    model = Model(TrainedOn(manager_of(alike)), "on")
    assert asked_of_base(model, manager) == 25 and exposures_of_base(model, manager) is not None
    inside = base_gains(model, manager, manager.views("train"))
    assert not np.array_equal(inside.stops, base_gains(model, manager_of(exposed), manager.views("train")).stops)


# -- runs --------------------------------------------------------------------------------------------------------------


def test_a_base_begins_them_at_its_step(whole, small, tmp_path):
    exposures = read_run(whole / "config.yml").exposures
    assert exposures is not None and torch.allclose(exposures.affine.mean(dim=0), torch.eye(3, 4), atol=1e-6)
    part = checkpoint_of(whole)["beags"]["parts"]["exposure"]
    assert not torch.equal(part["start"], torch.eye(3, 4).repeat(8, 1, 1))
    assert float(part["adam"]["state"][0]["step"]) == 57 - BASE_STEP
    fits = ["psnr_fit" in each for each in json.loads((whole / "held_out.json").read_text())]
    assert fits == [False, *[True] * (len(fits) - 1)]


@pytest.mark.parametrize(("step", "after"), [(8, True), (BASE_STEP, False), (BASE_STEP, True), (30, True), (50, False)])
def test_a_killed_run_ends_as_the_whole_one(small, whole, tmp_path, monkeypatch, step, after):
    options = {"pipeline.model.exposure": "on"}
    interrupted(small, tmp_path / "run", monkeypatch, lambda patch: kill_at(patch, step, after), **options)
    resume_to_end(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


def test_the_number_of_threads_and_streaming_are_no_matter(small, whole, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2 if before == 1 else 1)
    try:
        run_to_end(asking(small, tmp_path / "run", **{"pipeline.datamanager.stream": "always"}))
    finally:
        torch.set_num_threads(before)
    assert_same_run(tmp_path / "run", whole)


def test_a_base_that_shows_no_difference_changes_nothing(tmp_path):
    data = written(tmp_path, SMALL)
    run_to_end(short_config(data, tmp_path / "auto"))
    run_to_end(short_config(data, tmp_path / "off", **{"pipeline.model.exposure": "off"}))
    assert_same_run(tmp_path / "auto", tmp_path / "off")
    assert "exposure" not in checkpoint_of(tmp_path / "auto")["beags"]["parts"]


def test_a_scene_to_start_from_is_asked_at_once(small, whole, tmp_path):
    config = asking(small, tmp_path / "run", **{"pipeline.model.base_steps": 10, "pipeline.model.refine_steps": 0})
    config.pipeline.model.start_from = whole
    run_to_end(config)
    assert float(checkpoint_of(tmp_path / "run")["beags"]["parts"]["exposure"]["adam"]["state"][0]["step"]) == 10


@pytest.mark.skipif(not torch.distributed.is_gloo_available(), reason="torch was built without gloo")
def test_exposures_are_alike_in_two_processes(small, tmp_path):
    data = shutil.copytree(small, tmp_path / "data")
    train_in_two(data, tmp_path, **{"pipeline.model.exposure": "on"})
    first, second = (json.loads((tmp_path / f"rank{rank}.json").read_text())["end"] for rank in (0, 1))
    assert first["exposures"] is not None and first["exposures"] == second["exposures"]
    assert first["_model.gauss_params.means"] == second["_model.gauss_params.means"]
