"""Exposures of photos that share no tracked points: the base shows how they differ, once it is roughly right."""

from __future__ import annotations

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
from beags_plugin.plugin.training.base_gains import gains_of_points, point_cloud
from beags_plugin.plugin.training.exposure import (
    GAMMA,
    asked_of_base,
    exposures_of_base,
    exposures_of_run,
    photo_gains,
)
from beags_plugin.plugin.views.datamanager import BeagsDataManager, BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.sample.exposure import photo_gains as true_gains
from beags_plugin.sample.writer import SampleConfig, write_sample

SAMPLE = SampleConfig(width=160, height=144, num_train=8, num_test=2, num_points=1200)
EXPOSED = replace(SAMPLE, exposure=1.2, white_balance=0.4)


@pytest.fixture(scope="module")
def tracked(shared):
    """Photos that see points, each in an exposure and white balance of its own; tracks say which points."""
    return shared("points_tracked", lambda at: write_sample(at / "data", EXPOSED)) / "data"


@pytest.fixture(scope="module")
def exposed(shared):
    """The same photos and points without tracks."""
    return shared("points_exposed", lambda at: written(at, EXPOSED, points=True)) / "data"


@pytest.fixture(scope="module")
def alike(shared):
    """The same points without tracks, in photos of one exposure."""
    return shared("points_alike", lambda at: written(at, SAMPLE, points=True)) / "data"


@pytest.fixture(scope="module")
def pointless(shared):
    """Photos of many exposures without any point."""
    return shared("pointless", lambda at: written(at, replace(SMALL, exposure=1.2))) / "data"


def manager_of(data: Path, **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data), **options)
    return BeagsDataManager(config, device="cpu", test_mode="val")


@dataclass
class Rendered:
    color: torch.Tensor
    alpha: torch.Tensor
    median_depth: torch.Tensor | None = None


class Surface:
    """A rasterizer of a scene whose surface lies where its tracks say that views see points, and nowhere else."""

    def __init__(self, manager: BeagsDataManager) -> None:
        self.views, self.tracks = manager.views("train"), manager.dataparser.tracks("train")
        self.points = manager.train_dataset.metadata["points3D_xyz"]
        self.sizes: list[tuple[int, int]] = []

    def rasterize(self, inputs, camera, settings, background) -> Rendered:
        assert settings.geometry
        self.sizes.append((camera.width, camera.height))
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

    rasterizer: Surface
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


def true_stops(manager: BeagsDataManager) -> np.ndarray:
    stems = [[path.stem for path in each.image_filenames] for each in (manager.train_dataset, manager.eval_dataset)]
    of_photo = true_gains(*stems, SAMPLE.seed, 1.2, 0.4)
    return np.log2([of_photo[view.name] for view in manager.views("train")])


# -- what a base shows, and when it counts -----------------------------------------------------------------------------


def test_photos_that_a_base_shows_in_other_light_get_transforms_and_one_line_says_so(tracked, exposed, capsys):
    model, manager = Model(Surface(manager_of(tracked))), manager_of(exposed)
    assert photo_gains(manager) is None and exposures_of_run(model, manager) is None
    assert asked_of_base(model, manager) == 5
    capsys.readouterr()
    own = exposures_of_base(model, manager)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("The photos differ in exposure by 0.") and "and their colours by 0." in line
    assert "besides, as the base shows them: each gets a colour transform of its own" in line
    assert own is not None and set(model.rasterizer.sizes) == {(142, 128)}
    diagonal = own.affine.detach()[:, range(3), range(3)]
    assert torch.allclose(diagonal.mean(dim=0), torch.ones(3), atol=1e-6)
    stops = GAMMA * torch.log2(diagonal)
    stops -= stops.mean(dim=0)
    true = torch.from_numpy(true_stops(manager)).float()
    assert true.std(dim=0).min() > 0.2 and (stops - true).abs().max() < 0.08


def test_points_count_in_photos_from_which_the_base_does_not_hide_them(tracked, exposed):
    manager, bare = manager_of(tracked), manager_of(exposed)
    true = photo_gains(manager)
    found = gains_of_points(Model(Surface(manager)), bare, point_cloud(bare), bare.views("train"))
    assert true is not None and np.abs(found.stops - true.stops).max() < 0.03
    assert found.noise == pytest.approx(true.noise, rel=0.2)


def test_points_of_large_clouds_are_spread_over_them(exposed, monkeypatch):
    manager = manager_of(exposed)
    every = point_cloud(manager)
    assert len(every) == 1200
    monkeypatch.setattr(showing, "MOST_POINTS", 500)
    assert np.array_equal(point_cloud(manager), every[::3])


def test_photos_that_a_base_shows_as_they_are_get_none(tracked, alike, capsys):
    model, manager = Model(Surface(manager_of(tracked))), manager_of(alike)
    capsys.readouterr()
    assert exposures_of_base(model, manager) is None and model.exposures is None
    assert capsys.readouterr().out == "" and model.rasterizer.sizes
    model.exposure = "on"
    own = exposures_of_base(model, manager)
    assert own is not None and torch.allclose(own.affine, torch.eye(3, 4).repeat(8, 1, 1), atol=0.02)


def test_a_photo_that_shows_nothing_begins_at_0_stops(tracked, exposed):
    manager = manager_of(exposed)
    manager.cached_train[3]["image"] = torch.zeros_like(manager.cached_train[3]["image"])
    found = gains_of_points(Model(Surface(manager_of(tracked))), manager, point_cloud(manager), manager.views("train"))
    assert np.isinf(found.noise[3]) and not found.stops[3].any() and np.isfinite(np.delete(found.noise, 3)).all()
    rest = np.delete(true_stops(manager), 3, axis=0)
    assert np.abs(np.delete(found.stops, 3, axis=0) - (rest - rest.mean(axis=0))).max() < 0.08


def test_of_many_photos_some_tell_and_then_all_are_compared(tracked, exposed, alike, monkeypatch):
    scene, manager = manager_of(tracked), manager_of(exposed)
    every = exposures_of_base(Model(Surface(scene)), manager)
    monkeypatch.setattr(learning, "MOST_VIEWS", 3)
    model = Model(Surface(scene))
    assert exposures_of_base(model, manager_of(alike)) is None and len(model.rasterizer.sizes) == 3
    some = exposures_of_base(model, manager)
    assert len(model.rasterizer.sizes) == 3 + 3 + 8 and torch.equal(some.affine, every.affine)


def test_streamed_photos_are_compared_alike(tracked, exposed):
    gains = []
    for stream in ("never", "always"):
        manager = manager_of(exposed, stream=stream)
        model = Model(Surface(manager_of(tracked)))
        gains.append(gains_of_points(model, manager, point_cloud(manager), manager.views("train")))
    assert gains[0].stops.any()
    assert np.array_equal(gains[0].stops, gains[1].stops) and np.array_equal(gains[0].noise, gains[1].noise)


def test_when_a_base_is_asked(tracked, exposed):
    seen, manager = manager_of(tracked), manager_of(exposed)
    scene = Surface(seen)
    assert asked_of_base(Model(scene, "off"), manager) is None
    assert asked_of_base(Model(scene, "on"), manager) == 5 and exposures_of_run(Model(scene, "on"), manager) is None
    assert asked_of_base(Model(scene, exposures=Exposures(("a",), torch.eye(3, 4)[None])), manager) is None
    warm = PhaseSchedule(base_steps=100, refine_steps=0, warm=True)
    assert asked_of_base(Model(scene, schedule=warm), manager) == 0
    assert asked_of_base(Model(scene, schedule=PhaseSchedule(0, 100)), manager) == 0
    assert asked_of_base(Model(scene), seen) is None


@pytest.mark.parametrize("photos", ["all", "objects"])
def test_photos_without_any_point_get_transforms_only_where_they_are_wanted(tracked, pointless, photos, capsys):
    scene, manager = Surface(manager_of(tracked)), manager_of(pointless, photos=photos)
    capsys.readouterr()
    for exposure in ("auto", "off"):
        model = Model(scene, exposure)
        assert exposures_of_run(model, manager) is None and asked_of_base(model, manager) is None
    model = Model(scene, "on")
    own = exposures_of_run(model, manager)
    assert own is not None and torch.equal(own.affine, torch.eye(3, 4).repeat(8, 1, 1))
    assert model.exposures.names == tuple(view.name for view in manager.views("train"))
    assert asked_of_base(model, manager) is None and asked_of_base(Model(scene, "on"), manager) is None
    assert not scene.sizes and capsys.readouterr().out == ""


def test_objects_that_turn_in_a_standing_light_are_no_exposures(tracked, exposed):
    model, manager = Model(Surface(manager_of(tracked))), manager_of(exposed, photos="objects")
    assert asked_of_base(model, manager) is None
    assert exposures_of_run(model, manager_of(tracked, photos="objects")) is None
    assert exposures_of_run(model, manager_of(tracked)) is not None
    model = Model(Surface(manager_of(tracked)), "on")
    assert asked_of_base(model, manager) == 5 and exposures_of_base(model, manager) is not None
    cloud, views = point_cloud(manager), manager.views("train")
    inside = gains_of_points(model, manager, cloud, views)
    assert not np.array_equal(inside.stops, gains_of_points(model, manager_of(exposed), cloud, views).stops)
