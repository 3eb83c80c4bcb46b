"""Training views at a fraction of their size: what they show, and where their cameras see it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from data_folders import HEIGHT, WIDTH, write_image, write_transforms
from distorted_views import manager

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.plugin.options.pyramid import LEAST_SIDE, PyramidConfig, small_size
from beags_plugin.plugin.options.schedule import PhaseSchedule
from beags_plugin.plugin.views.small_views import SmallViews, small_camera
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
from beags_plugin.system.errors import UserError


def test_sizes_grow_in_equal_steps_to_the_whole():
    schedule, pyramid = PhaseSchedule(100, 20), PyramidConfig(start=4.0, until=0.5, levels=2)
    factors = [pyramid.factor(step, schedule) for step in range(120)]
    assert factors[:25] == [4.0] * 25 and factors[25:50] == [2.0] * 25 and factors[50:] == [1.0] * 70
    smooth = PyramidConfig(start=8.0, until=1.0, levels=50)
    factors = [smooth.factor(step, schedule) for step in range(120)]
    assert factors[0] == 8.0 and factors == sorted(factors, reverse=True) and len(set(factors)) == 51
    assert factors[50] == pytest.approx(8.0**0.5) and factors[100:] == [1.0] * 20
    assert PyramidConfig().factor(0, schedule) == 1.0
    assert pyramid.factor(0, PhaseSchedule(100, 20, warm=True)) == 1.0  # polishing needs the detail
    assert pyramid.factor(0, PhaseSchedule(0, 20)) == 1.0
    assert PyramidConfig(start=4.0, until=0.0).factor(0, schedule) == 1.0


@pytest.mark.parametrize(
    ("option", "message"),
    [({"start": 0.5}, "start is 0.5"), ({"start": float("nan")}, "start is nan"), ({"until": 1.5}, "until is 1.5"),
     ({"levels": 0}, "levels is 0")],
)  # fmt: skip
def test_wrong_pyramids_are_refused(option, message):
    with pytest.raises(UserError, match=f"pyramid.{message}"):
        PyramidConfig(**option).check()


def test_no_photo_falls_below_the_least_side():
    assert small_size(640, 480, 4.0) == (160, 120) and small_size(255, 127, 2.0) == (128, 64)
    assert small_size(640, 64, 8.0) == (320, LEAST_SIDE)
    assert small_size(20, 24, 4.0) == (20, 24)  # already smaller


def test_photos_are_averaged_and_what_is_known_shrinks():
    image = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8))
    inside = torch.zeros(6, 8, dtype=torch.bool)
    inside[:, :5] = True
    labels = torch.arange(48, dtype=torch.int32).reshape(6, 8)
    whole = {"image": image, "labels": labels, "inside": inside, "alpha": 255 * inside.byte(), "image_idx": 3}
    camera = Camera(torch.eye(4), torch.eye(3), 8, 6)
    views = SmallViews(keep=True)
    assert views.batch(0, camera, whole, 0) is whole
    views.shrink(lambda step, width, height: [(4, 3), (4, 3), (2, 3), (width, height)][step])
    small = views.batch(0, camera, whole, 0)
    exact = image.float().reshape(3, 2, 4, 2, 3).mean((1, 3))
    assert small["image"].dtype == torch.uint8 and (small["image"].float() - exact).abs().max() <= 0.5
    assert small["inside"].tolist() == [[True, True, False, False]] * 3  # the third pixel is covered by half
    assert small["alpha"][0].tolist() in ([255, 255, 127, 0], [255, 255, 128, 0])
    assert small["labels"].tolist() == labels[1::2, 1::2].tolist() and small["labels"].dtype == torch.int32
    assert small["image_idx"] == 3
    assert views.batch(0, camera, {"image": None}, 1)["image"] is small["image"]  # kept
    floats = {"image": image.float() / 255}
    smaller = views.batch(0, camera, floats, 2)["image"]
    assert torch.allclose(smaller, exact.reshape(3, 2, 2, 3).mean(2) / 255, atol=1e-6)
    assert views.batch(0, camera, floats, 3) is floats and not views._batches  # nothing is kept of what is over


def test_a_small_camera_renders_the_average_of_the_whole_picture():
    """A smooth scene off the centre, at a third of the width and half of the height: each axis has its own factor."""
    K = torch.tensor([[300.0, 0, 110.3], [0, 280.0, 71.9], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 240, 180)
    g = torch.Generator().manual_seed(1)
    spread = torch.randn(12, 3, generator=g) * torch.tensor([0.8, 0.5, 0.2])
    scene = SurfelInputs(
        spread + torch.tensor([0.1, 0.1, 4.0]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(12, 1),
        torch.full((12, 2), -0.7),
        torch.zeros(12),
        torch.rand(12, 3, generator=g),
    )
    small = small_camera(camera, (80, 90))
    rasterizer, settings = make_rasterizer("torch"), RasterSettings(0.01, 100.0, geometry=False)
    whole, found = (rasterizer.rasterize(scene, each, settings, torch.zeros(3)).color for each in (camera, small))
    averaged = whole.reshape(90, 2, 80, 3, 3).mean((1, 3))
    error = (found - averaged).abs()
    assert error.mean() < 1e-3 and error.max() < 0.02
    shifted = (found.roll(1, dims=1) - averaged).abs()[:, 2:]
    assert shifted.mean() > 5 * error.mean()  # half a pixel would show


@pytest.mark.parametrize("stream", ["never", "always"])
def test_the_data_manager_gives_small_views_with_their_cameras(tmp_path, stream):
    write_transforms(tmp_path)
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    ids[:4], ids[:, 10:] = 7, IGNORE
    for view in range(1, 8):
        write_image(tmp_path / f"masks/v{view:02d}.png", ids)
    usual, data = manager(tmp_path, stream=stream), manager(tmp_path, stream=stream)
    data.shrink(lambda step, width, height: (width // 2, height // 2) if step < 8 else (width, height))
    for step in range(16):
        (camera, batch), (whole_camera, whole) = data.next_train(step), usual.next_train(step)
        assert batch["image_idx"] == whole["image_idx"]  # the order is that of whole views
        own, other = camera.metadata["camera"], whole_camera.metadata["camera"]
        side = 2 if step < 8 else 1
        assert batch["image"].shape == (HEIGHT // side, WIDTH // side, 3)
        assert (own.width, own.height) == (WIDTH // side, HEIGHT // side) == (int(camera.width), int(camera.height))
        assert torch.allclose(own.K[:2] * side, other.K[:2]) and torch.equal(own.viewmat, other.viewmat)
        assert torch.allclose(camera.get_intrinsics_matrices()[0], own.K)
        assert camera.metadata["labels"].shape == batch["labels"].shape == batch["image"].shape[:2]
        assert torch.equal(data.training_camera(batch["image_idx"], step).K, own.K)
    assert data.views("train")[0].image.shape == (HEIGHT, WIDTH, 3)
    assert data.next_eval_image(0)[1]["image"].shape == (HEIGHT, WIDTH, 3)
    assert not data._small._batches  # nothing is kept once photos are whole
    index, step = 2, 0
    assert data.training_camera(index, step).width == WIDTH // 2 and data.training_camera(index, 9).width == WIDTH


def test_objects_alone_are_cut_out_before_they_are_averaged(tmp_path):
    write_transforms(tmp_path)
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    ids[:5] = 7  # half of the third row of small pixels
    write_image(tmp_path / "masks/v01.png", ids)
    data = manager(tmp_path, photos="objects")
    data.shrink(lambda step, width, height: (width // 2, height // 2))
    batch = next(batch for _, batch in map(data.next_train, range(7)) if batch["image_idx"] == 0)
    assert batch["inside"][:2].all() and not batch["inside"][2:].any()
    assert (batch["alpha"][2].float() - 127.5).abs().max() <= 0.5 and (batch["alpha"][3:] == 0).all()
    assert (batch["image"][3:] == 0).all() and batch["known"].all()
