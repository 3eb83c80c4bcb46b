from __future__ import annotations

import random
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, noise, write_image, write_transforms
from distorted_views import LARGE_H, LARGE_W, manager, write_distorted
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.views.lens import undistort_labels
from beags_plugin.views.views import unique_names


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "equidistant"])
def test_class_map_is_undistorted_like_its_image(tmp_path, model):
    rays = [(x, y) for x in (-0.42, -0.16, 0.11, 0.37) for y in (-0.3, -0.05, 0.21)]
    distorted = write_distorted(tmp_path, model, rays)
    view = manager(tmp_path).views("train")[0]
    assert view.name == "v01" and view.labels is not None
    assert view.image.shape[:2] == view.labels.shape == (view.camera.height, view.camera.width)

    def differing(labels) -> float:
        known = labels != IGNORE
        return float((((labels > 0) & known) != (view.image[..., 0] > 0.5))[known].float().mean())

    assert differing(view.labels) < 0.005  # the discs' boundaries, where the image is interpolated
    assert differing(view.labels.roll(1, dims=1)) > 4 * differing(view.labels)
    if view.labels.shape == distorted.shape:
        assert differing(torch.from_numpy(distorted).int()) > 4 * differing(view.labels)

    # The new pinhole camera sees each ray where its disc has gone. Nearest sampling moves a disc of radius 6 at random
    # by tenths of a pixel.
    rows, columns = torch.meshgrid(*(torch.arange(n) + 0.5 for n in view.labels.shape), indexing="ij")
    in_map, in_image, expected = [], [], []
    for number, (x, y) in enumerate(rays, 1):
        disc = view.labels == number
        in_map.append(torch.stack([columns[disc].mean(), rows[disc].mean()]))
        near = ((columns - in_map[-1][0]).abs() < 10) & ((rows - in_map[-1][1]).abs() < 10)
        weights = view.image[..., 0] * near
        in_image.append(torch.stack([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum())
        expected.append((view.camera.K @ torch.tensor([x, y, 1.0]))[:2])
    off_rays = torch.stack(in_map) - torch.stack(expected)
    off_image = torch.stack(in_map) - torch.stack(in_image)
    assert off_rays.abs().max() < 0.75 and off_rays.mean(0).abs().max() < 0.25
    assert off_image.abs().max() < 0.6 and off_image.mean(0).abs().max() < 0.2


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "equidistant"])
def test_every_label_comes_from_the_pixel_that_the_image_came_from(tmp_path, model):
    write_distorted(tmp_path, model, [])
    rows, columns = np.mgrid[:LARGE_H, :LARGE_W].astype(np.float32)
    data = manager(tmp_path)
    assert data.train_dataset[0]["image"].shape == (LARGE_H, LARGE_W, 3)  # files keep their size, for the viewer
    cameras = data.train_dataparser_outputs.cameras  # those of the dataset are straightened
    camera, K = cameras[0].reshape(()), cameras[0].get_intrinsics_matrices().numpy()
    ramps = np.stack([columns, rows, columns], axis=2)
    straight = deepcopy(cameras)
    new_K, ramps, _ = _undistort_image(camera, camera.distortion_params.numpy(), {}, ramps, K)
    for name, value in zip(("fx", "fy", "cx", "cy"), (*np.diag(new_K)[:2], *new_K[:2, 2]), strict=True):
        getattr(straight, name)[0] = float(value)
    straight.height[0], straight.width[0] = ramps.shape[:2]
    labels = undistort_labels((rows * LARGE_W + columns).astype(np.uint16), cameras, straight, 0)
    assert labels.shape == ramps.shape[:2]
    known = labels != IGNORE
    inside = known & (ramps[..., 0] > 1) & (ramps[..., 1] > 1)  # The ramp blends with black at the border.
    inside &= (ramps[..., 0] < LARGE_W - 2) & (ramps[..., 1] < LARGE_H - 2)
    assert inside.mean() > 0.9
    # OpenCV interpolates at 1/32 pixel, so the nearest pixel is within 0.5 + 1/64 of the ramp.
    assert np.abs(labels % LARGE_W - ramps[..., 0])[inside].max() < 0.52
    assert np.abs(labels // LARGE_W - ramps[..., 1])[inside].max() < 0.52


def test_views_without_distortion_are_the_files(tmp_path):
    write_transforms(tmp_path)
    write_image(tmp_path / "masks/v02.png", np.full((HEIGHT, WIDTH), 3, np.uint8))
    data = manager(tmp_path)
    train, evaluation = data.views("train"), data.views("test")
    assert [view.name for view in train] == [f"v{i:02d}" for i in range(1, 8)]
    assert [view.name for view in evaluation] == ["v00", "v08"]
    assert [view.labels is not None for view in train] == [False, True] + [False] * 5
    assert train[1].labels.dtype == torch.int32 and (train[1].labels == 3).all()
    np.testing.assert_allclose(train[2].image.numpy(), noise(3) / 255.0, atol=1e-6)
    expected = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
    np.testing.assert_allclose(train[0].camera.K.numpy(), expected)
    with pytest.raises(ValueError, match="unknown split"):
        data.views("tests")


@pytest.mark.parametrize("cache", ["cpu", "gpu"])
@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_batches_on_a_cpu(tmp_path, cache, kind):
    write_transforms(tmp_path)
    data = manager(tmp_path, cache_images=cache, cache_images_type=kind)
    camera, batch = data.next_train(0)
    assert batch["image"].dtype == getattr(torch, kind)
    assert batch["labels"].shape == (HEIGHT, WIDTH) and batch["labels"].dtype == torch.int32
    assert camera.metadata["labels"] is batch["labels"] and "mask" not in batch
    assert data.next_eval_image(0)[1]["labels"].shape == (HEIGHT, WIDTH)
    batches = data.fixed_indices_eval_dataloader
    assert len(batches) == 2 and all("labels" in batch for _, batch in batches)
    assert data.views("train")[0].image.dtype == torch.float32 and data.views("train")[0].image.max() <= 1


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_training_sees_objects_alone_where_asked(tmp_path, kind):
    write_transforms(tmp_path)
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    ids[2:6], ids[:, 10:] = 7, IGNORE
    for name in ("v00", "v03"):
        write_image(tmp_path / f"masks/{name}.png", ids)
    rgba = np.dstack([noise(3), np.full((HEIGHT, WIDTH), 100, np.uint8)])
    write_image(tmp_path / "images/v03.png", rgba)
    data = manager(tmp_path, photos="objects", cache_images_type=kind)
    whole = data.cached_train
    for step in range(7):
        camera, batch = data.next_train(step)
        inside = torch.from_numpy(ids == 7) if batch["image_idx"] == 2 else torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
        assert torch.equal(batch["alpha"], 100 * inside.byte()) and torch.equal(batch["inside"], inside)
        assert torch.equal(batch["image"], whole[batch["image_idx"]]["image"] * inside[..., None])
        assert torch.equal(batch["known"], batch["labels"] != IGNORE) and camera.metadata["objects_alone"]
    assert "inside" not in data.next_eval_image(0)[1]
    assert data.views("train")[2].image[ids == 0].any()


def test_order_of_views_follows_the_seed_alone(tmp_path):
    write_transforms(tmp_path)

    def orders(seed: int) -> tuple[list[int], list[int]]:
        random.seed()  # Others may leave any state.
        data = manager(tmp_path, train_cameras_sampling_seed=seed)
        state = random.getstate()
        train = [data.next_train(step)[1]["image_idx"] for step in range(21)]
        evaluation = [data.next_eval_image(step)[1]["image_idx"] for step in range(6)]
        assert random.getstate() == state
        return train, evaluation

    first = orders(1)
    assert orders(1) == first and orders(2) != first
    assert all(sorted(first[0][i : i + 7]) == list(range(7)) for i in (0, 7, 14))


@pytest.mark.parametrize("stream", ["never", "always"])
def test_replaced_labels_reach_batches_and_views(tmp_path, stream):
    write_transforms(tmp_path)
    write_image(tmp_path / "masks/v01.png", np.full((HEIGHT, WIDTH), 1, np.uint8))
    data = manager(tmp_path, stream=stream)
    assert "present" not in data.next_train(0)[1]  # the host knows the objects of labels that it is given
    assert (data.views("train")[0].labels == 1).all() and data.views("train")[1].labels is None
    new = [torch.full((HEIGHT, WIDTH), 5 + index, dtype=torch.int32) for index in range(7)]
    new[2][0], new[3][1] = IGNORE, 300
    data.replace_labels(new)
    for step in range(1, 8):
        camera, batch = data.next_train(step)
        assert torch.equal(batch["labels"], new[batch["image_idx"]])
        assert batch["present"] == [5 + batch["image_idx"], *([300] if batch["image_idx"] == 3 else [])]
        assert camera.metadata["labels"] is batch["labels"]
    assert all(torch.equal(view.labels, labels) for view, labels in zip(data.views("train"), new, strict=True))

    new[0].fill_(9)  # the manager keeps its own copy
    assert (data.views("train")[0].labels == 5).all()
    data.replace_labels([labels + 1 for labels in new[:2]] + new[2:])
    assert (data.views("train")[0].labels == 10).all()
    originals = [view.labels for view in data.views("train", original=True)]
    assert (originals[0] == 1).all() and originals[1:] == [None] * 6


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ([torch.zeros(HEIGHT, WIDTH)] * 6, "6 views for 7"),
        ([torch.zeros(WIDTH, HEIGHT)] * 7, "for a view of"),
        ([torch.full((HEIGHT, WIDTH), -1)] * 7, "must lie in"),
    ],
)
def test_wrong_class_maps_are_refused(tmp_path, maps, message):
    write_transforms(tmp_path)
    with pytest.raises(ValueError, match=message):
        manager(tmp_path).replace_labels(maps)


def test_paths_of_the_configuration_are_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_transforms(tmp_path / "scene")
    config = BeagsDataManagerConfig()
    assert config.dataparser.data == Path()  # "not given" is no path
    config.data = "scene"
    assert config.data == tmp_path / "scene"
    config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    assert config.dataparser.data == tmp_path / "scene"
    outputs = config.dataparser.setup().get_dataparser_outputs("train")
    assert all(path.is_absolute() for path in outputs.image_filenames)


def test_views_of_equal_stems_have_names_of_their_own():
    files = [Path("images/left/0001.png"), Path("images/right/0001.png"), Path("images/right/0002.png")]
    assert unique_names(files) == ["left_0001", "right_0001", "0002"]
    assert unique_names([Path("a/x.png"), Path("b/y.jpg")]) == ["x", "y"]
    assert unique_names([Path("a/c/x.png"), Path("b/c/x.png")]) == ["a_c_x", "b_c_x"]
    assert unique_names([Path("a/x.png"), Path("b/x.png"), Path("a_x.png")]) == ["a_x_2", "b_x", "a_x"]
    assert unique_names([Path("x.png"), Path("x.jpg")]) == ["x", "x_2"]
