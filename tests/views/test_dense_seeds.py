"""Seed points from photos on whose depth several agree: where they lie, and when they are made."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")
pytest.importorskip("beags_benchmarks", reason="it generates photos that differ in exposure")

from beags_benchmarks.samples.config import VariedSample
from beags_plugin.plugin.views import datamanager as managing
from beags_plugin.plugin.views.datamanager import BeagsDataManager, BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.posing.dense_points import dense_points
from beags_plugin.posing.plane_sweep import PLANES, PosedPhoto, swept
from beags_plugin.sample.writer import write_sample
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.views import in_unit_range

SAMPLE = VariedSample(width=120, height=90, num_train=16, num_test=2, num_points=300, exposure=1.0)


@pytest.fixture(scope="module")
def data(shared) -> Path:
    """Photos of one scene, each in an exposure of its own; tests only read them."""
    return shared("dense_seeds", lambda at: write_sample(at / "data", SAMPLE)) / "data"


def manager_of(data: Path, begins: bool = True, **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data), begins=begins, **options)
    return BeagsDataManager(config, device="cpu", test_mode="val")


def seeds_of(manager: BeagsDataManager) -> tuple[torch.Tensor, torch.Tensor]:
    metadata = manager.train_dataparser_outputs.metadata
    return metadata["points3D_xyz"], metadata["points3D_rgb"]


@pytest.fixture(scope="module")
def manager(data) -> BeagsDataManager:
    return manager_of(data)


@pytest.mark.slow("sweeps planes through a scene's photos")
def test_they_lie_on_surfaces_in_the_colours_that_photos_have(data, manager):
    points, colors = seeds_of(manager)
    assert len(points) == len(colors) and len(points) > 900 and colors.dtype == torch.uint8
    added, outputs = points[300:].double(), manager.train_dataparser_outputs
    nearest, alike = np.full(len(added), np.inf), np.full(len(added), np.inf)
    for index, path in enumerate(outputs.image_filenames):
        exact = np.load(data / "ground_truth/depth" / f"{path.stem}.npy") * outputs.dataparser_scale
        camera = camera_from_nerfstudio(manager.train_dataset.cameras, index)
        local = added @ camera.rotation.double().T + camera.translation.double()
        xy = local @ camera.K.double().T
        column, row = (xy[:, :2] / xy[:, 2:]).numpy().astype(int).T
        inside = (local[:, 2].numpy() > 0) & (column >= 0) & (column < 120) & (row >= 0) & (row < 90)
        z = local[inside, 2].numpy()
        off = np.abs(z - exact[row[inside], column[inside]]) / z
        photo = 255.0 * in_unit_range(manager.cached_train[index]["image"]).numpy()[row[inside], column[inside]]
        other = np.abs(photo - colors[300:].numpy()[inside]).max(axis=1)
        alike[inside] = np.minimum(alike[inside], np.where(off < 0.03, other, np.inf))
        nearest[inside] = np.minimum(nearest[inside], off)
    assert np.quantile(nearest, 0.95) < 0.02, "of the depth"
    assert np.quantile(alike, 0.8) < 32, "of 255"


@pytest.mark.slow("sweeps planes through a scene's photos")
def test_they_are_the_same_for_any_number_of_threads(data, manager, monkeypatch):
    from beags_plugin.posing import dense_points as made

    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        monkeypatch.setattr(made, "WORKERS", 1)
        alone = seeds_of(manager_of(data))
    finally:
        cv2.setNumThreads(before)
    assert all(torch.equal(a, b) for a, b in zip(alone, seeds_of(manager), strict=True))


@pytest.mark.parametrize(
    ("options", "added"),
    [
        ({"begins": False}, False),
        ({"dense_seeds": "off"}, False),
        ({"photos": "objects"}, False),
        ({"photos": "objects", "dense_seeds": "on"}, True),
        ({}, True),
    ],
)
def test_when_they_are_added(data, manager, monkeypatch, options, added):
    monkeypatch.setattr(managing, "with_dense_seeds", lambda views, points, colors: (points[:7], colors[:7]))
    assert len(seeds_of(manager_of(data, **options))[0]) == (7 if added else 300)


def test_many_photos_need_none(data, monkeypatch):
    monkeypatch.setattr(managing, "with_dense_seeds", lambda views, points, colors: (points[:7], colors[:7]))
    monkeypatch.setattr(managing, "MOST_PHOTOS", 15)
    assert len(seeds_of(manager_of(data))[0]) == 300
    assert len(seeds_of(manager_of(data, dense_seeds="on"))[0]) == 7


def photos_of(depth: float, count: int) -> list[PosedPhoto]:
    """Photos of a plain with a pattern, ``depth`` before cameras that stand side by side, each in its own exposure."""
    pattern = cv2.GaussianBlur(np.random.default_rng(0).random((200, 400)).astype(np.float32), (0, 0), 1.5)
    pattern = (pattern - pattern.min()) / (pattern.max() - pattern.min())
    K, photos = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1.0]]), []
    for index in range(count):
        pose = np.eye(4)
        pose[0, 3] = -0.4 * index
        shift = 60.0 * 0.4 * index / depth
        place = np.float32([[1, 0, -100 - shift], [0, 1, -60]])
        grey = cv2.warpAffine(pattern, place, (64, 48))
        photos.append(PosedPhoto((0.9 - 0.2 * index) * grey, K, pose))
    return photos


@pytest.mark.parametrize("depth", [3.0, 4.3])
def test_a_sweep_finds_the_depth_of_a_plain(depth):
    photos = photos_of(depth, 3)
    found = swept(photos[1], [photos[0], photos[2]], 2.0, 8.0)
    assert found.step == pytest.approx((1 / 2.0 - 1 / 8.0) / (PLANES - 1))
    inner = np.zeros((48, 64), bool)
    inner[6:-6, 12:-12] = True
    assert found.sure[inner].mean() > 0.9
    assert np.abs(found.inverse - 1 / depth)[found.sure & inner].max() < 2.0 * found.step


def test_photos_that_share_nothing_give_no_points():
    photos = photos_of(3.0, 3)
    away = [PosedPhoto(each.grey, each.K, each.pose @ np.diag([-1.0, 1, -1, 1])) for each in photos[1:]]
    plain = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3)) + [0.0, 0.0, 3.0]
    colors = [np.zeros((48, 64, 3), np.uint8)] * 3
    points, seen = dense_points([photos[0], *away], colors, plain, 100)
    assert points.shape == seen.shape == (0, 3) and seen.dtype == np.uint8
    some = dense_points(photos, colors, plain, 100)[0]
    assert 50 < len(some) <= 100 and np.abs(some[:, 2] - 3.0).max() < 0.1
