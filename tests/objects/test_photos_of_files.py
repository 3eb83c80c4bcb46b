"""The photos that textures are made of: as they were trained on, and with the pixels of their files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from run_folders import SETTINGS, discs, drawn_labels, write_drawn_scene, write_trained

from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.objects import photos
from beags_plugin.objects.photos import photos_of
from beags_plugin.objects.shown import ShownScene
from beags_plugin.preparation.consistent_masks import render_depths
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.run import Run
from beags_plugin.surfaces.frames import Frame
from beags_plugin.surfaces.item import Photo
from beags_plugin.views.cameras import camera_from_nerfstudio

CUP = 1


def cup_photos(folder: Path, downscale: int) -> list[Photo]:
    """Return the photos of the cup of discs, whose files are 8 times as large as other scenes', after a downscale."""
    write_drawn_scene(folder / "data", factor=8)
    config = write_trained(folder / "run", folder / "data")
    text = config.read_text()
    assert "downscale_factor: null" in text
    config.write_text(text.replace("downscale_factor: null", f"downscale_factor: {downscale}"))
    surfels, ids = discs()
    run = Run(config)
    data = run.views("val")
    cameras = [camera_from_nerfstudio(data.train_dataset.cameras, i) for i in range(len(data.train_dataset))]
    rasterizer = make_rasterizer("auto")
    depths = list(render_depths(surfels, cameras, rasterizer, SETTINGS, "median"))
    labels = [drawn_labels(camera) for camera in cameras]
    views = MaskedViews(cameras, labels, depths, rasterizer, SETTINGS)
    shown = ShownScene([str(i) for i in range(len(cameras))], views, data, range(len(cameras)))
    part, _ = select_class(surfels, Membership(ids), CUP)
    return list(photos_of(shown, CUP, part, Frame.of_run()))


def drawn(camera: Camera) -> torch.Tensor:
    surfels, _ = discs()
    found = make_rasterizer("auto").rasterize(surfel_inputs(surfels, camera), camera, SETTINGS, torch.zeros(3))
    return found.color.clamp(0, 1)


def test_photos_that_were_shrunk_have_sharper_ones(tmp_path):
    found = cup_photos(tmp_path, 4)
    assert len(found) >= 5
    for photo in found:
        sharper = photo.sharper
        assert sharper is not None and sharper.edge == 4
        assert sharper.camera.focal == pytest.approx(4 * photo.camera.focal, rel=0.02)
        image = sharper.image()
        assert image.shape == (sharper.camera.height, sharper.camera.width, 3)
        assert (image - drawn(sharper.camera)).abs().mean() < 0.004  # The file shows this there, up to rounding.
        own, exact = sharper.own(), drawn_labels(sharper.camera) == CUP
        assert (own & exact).sum() > 0.8 * (own | exact).sum()
        assert sharper.depth().shape == own.shape
        assert float(sharper.depth()[exact & own].median()) == pytest.approx(
            float(photo.depth()[photo.own()].median()), rel=0.05
        )


def test_coarse_images_are_dropped_once_a_sharper_one_is_read(tmp_path):
    found = cup_photos(tmp_path, 4)
    before = [photo.image() for photo in found]
    masks = [photo.own() for photo in found]
    assert all(photo.image() is image for photo, image in zip(found, before, strict=True))
    assert found[0].sharper is not None
    found[0].sharper.image()
    again = [photo.image() for photo in found]
    assert all(a is not b and torch.equal(a, b) for a, b in zip(again, before, strict=True))
    assert all(photo.own() is mask for photo, mask in zip(found, masks, strict=True))


def test_photos_of_their_files_size_have_none(tmp_path):
    assert all(photo.sharper is None for photo in cup_photos(tmp_path, 1))


def test_sharper_photos_keep_their_bound(tmp_path, monkeypatch):
    bytes_of_all = 60_000
    monkeypatch.setattr(photos, "_KEPT", bytes_of_all)
    found = [photo.sharper for photo in cup_photos(tmp_path, 8) if photo.sharper is not None]
    assert found and sum(3 * each.camera.width * each.camera.height for each in found) < 1.1 * bytes_of_all
    assert (found[0].image() - drawn(found[0].camera)).abs().mean() < 0.02
