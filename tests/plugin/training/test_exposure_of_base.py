"""Exposures of photos that share no tracked points: the base shows how they differ, once it is roughly right."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from trackless_scenes import SMALL, written

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.surfels import Surfels
from beags_plugin.plugin.options.schedule import PhaseSchedule
from beags_plugin.plugin.training import base_gains as showing
from beags_plugin.plugin.training import exposure as learning
from beags_plugin.plugin.training.base_gains import gains_of_colors, gains_of_points, point_cloud
from beags_plugin.plugin.training.exposure import (
    GAMMA,
    asked_of_base,
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


@pytest.fixture(scope="module")
def alike(shared):
    """A sample of photos of one exposure, without points."""
    return shared("trackless", lambda at: written(at, SAMPLE)) / "data"


@pytest.fixture(scope="module")
def exposed(shared):
    """The same photos, each in an exposure and white balance of its own."""
    return (
        shared("trackless_exposed", lambda at: written(at, replace(SAMPLE, exposure=1.2, white_balance=0.4))) / "data"
    )


def manager_of(data: Path, **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data), **options)
    return BeagsDataManager(config, device="cpu", test_mode="val")


@dataclass
class Rendered:
    color: torch.Tensor
    alpha: torch.Tensor
    median_depth: torch.Tensor | None = None


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


class Surface:
    """A rasterizer of a scene whose surface lies where its tracks say that views see points, and nowhere else."""

    def __init__(self, manager: BeagsDataManager) -> None:
        self.views, self.tracks = manager.views("train"), manager.dataparser.tracks("train")
        self.points = manager.train_dataset.metadata["points3D_xyz"]

    def rasterize(self, inputs, camera, settings, background) -> Rendered:
        assert settings.geometry
        (index,) = (i for i, v in enumerate(self.views) if torch.equal(v.camera.viewmat, camera.viewmat))
        ids, places = self.tracks[index]
        depth = torch.zeros(camera.height, camera.width)
        inside = (places < 1.0).all(axis=1)
        column, row = (places[inside] * [camera.width, camera.height]).astype(int).T
        z = (self.points[ids[inside]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2]
        depth[row, column] = z
        return Rendered(torch.zeros(*depth.shape, 3), (depth > 0).float(), depth)


@dataclass
class Model:
    """What exposures ask of a model."""

    rasterizer: TrainedOn | Surface
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

    def settings(self, geometry: bool = True) -> RasterSettings:
        return RasterSettings(0.01, 100.0, geometry)


@pytest.fixture(scope="module")
def cloud(shared):
    """Photos that see points: with tracks, and without."""

    def write(at: Path) -> None:
        config = replace(SAMPLE, num_points=1200, exposure=1.2, white_balance=0.4)
        shutil.copytree(written(at, config, points=True), at / "bare")
        write_sample(at / "tracked", config)

    at = shared("points_exposed", write)
    return at / "tracked", at / "bare"


def true_stops(manager: BeagsDataManager) -> np.ndarray:
    stems = [[path.stem for path in each.image_filenames] for each in (manager.train_dataset, manager.eval_dataset)]
    of_photo = true_gains(*stems, SAMPLE.seed, 1.2, 0.4)
    return np.log2([of_photo[view.name] for view in manager.views("train")])


# -- what a base shows, and when it counts -----------------------------------------------------------------------------


def test_photos_that_a_base_shows_in_other_light_get_transforms_and_one_line_says_so(alike, exposed, capsys):
    model, manager = Model(TrainedOn(manager_of(alike))), manager_of(exposed)
    assert photo_gains(manager) is None and exposures_of_run(model, manager) is None
    assert asked_of_base(model, manager) == 50
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


def test_points_count_in_photos_from_which_the_base_does_not_hide_them(cloud, capsys):
    tracked, bare = (manager_of(data) for data in cloud)
    model, true = Model(Surface(tracked)), photo_gains(tracked)
    assert photo_gains(bare) is None and asked_of_base(model, bare) == 5
    found = gains_of_points(model, bare, point_cloud(bare), bare.views("train"))
    assert true is not None and np.abs(found.stops - true.stops).max() < 0.03
    assert found.noise == pytest.approx(true.noise, rel=0.2)
    capsys.readouterr()
    own = exposures_of_base(model, bare)
    (line,) = capsys.readouterr().out.splitlines()
    assert f"by {found.spread:.2f} EV" in line and "as the base shows them" in line
    stops = GAMMA * torch.log2(own.affine.detach()[:, range(3), range(3)])
    assert torch.allclose(stops - stops.mean(dim=0), torch.from_numpy(found.stops).float(), atol=1e-3)


def test_points_of_large_clouds_are_spread_over_them(cloud, monkeypatch):
    manager = manager_of(cloud[1])
    every = point_cloud(manager)
    assert len(every) == 1200
    monkeypatch.setattr(showing, "MOST_POINTS", 500)
    assert np.array_equal(point_cloud(manager), every[::3])


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
    found = gains_of_colors(Model(TrainedOn(manager_of(alike))), manager, manager.views("train"))
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
        gains.append(gains_of_colors(Model(TrainedOn(manager_of(alike))), manager, manager.views("train")))
    assert np.array_equal(gains[0].stops, gains[1].stops) and np.array_equal(gains[0].noise, gains[1].noise)


def test_when_a_base_is_asked(alike, exposed, shared):
    manager, scene = manager_of(exposed), TrainedOn(manager_of(alike))
    assert asked_of_base(Model(scene, "off"), manager) is None
    assert asked_of_base(Model(scene, "on"), manager) == 50
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
    assert asked_of_base(model, manager) == 50 and exposures_of_base(model, manager) is not None
    inside = gains_of_colors(model, manager, manager.views("train"))
    assert not np.array_equal(inside.stops, gains_of_colors(model, manager_of(exposed), manager.views("train")).stops)
