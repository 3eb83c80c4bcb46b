"""Images and masks as a view is loaded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import (
    CX,
    HEIGHT,
    WIDTH,
    noise,
    write_image,
    write_transforms,
)
from parsed_views import parse
from PIL import Image

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio

# --- masks --------------------------------------------------------------------------------------------------------


def labels_of(root: Path, index: int = 0, **options) -> np.ndarray:
    outputs = parse(root, eval_interval=0, **options)
    return BeagsDataset(outputs).get_data(index)["labels"]


@pytest.mark.parametrize("kind", ["8-bit", "16-bit", "palette"])
def test_class_maps_keep_their_ids(tmp_path, kind):
    write_transforms(tmp_path)
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2:5, 3:9], ids[6:, 10:] = 1, 7
    if kind == "palette":
        image = Image.fromarray(ids, mode="P")
        image.putpalette([value for i in range(256) for value in (255 - i, i, i // 2)])
        (tmp_path / "masks").mkdir()
        image.save(tmp_path / "masks/v00.png")
    else:
        array = ids if kind == "8-bit" else np.where(ids == 7, IGNORE, ids).astype(np.uint16)
        write_image(tmp_path / "masks/v00.png", array)
    loaded = labels_of(tmp_path)
    assert loaded.dtype == torch.uint16
    expected = np.where(ids == 7, IGNORE, ids) if kind == "16-bit" else ids
    np.testing.assert_array_equal(loaded.numpy(), expected)
    classes = parse(tmp_path).metadata["classes"]
    assert set(classes) == ({0, 1} if kind == "16-bit" else {0, 1, 7})
    assert classes[0] == "background"


def test_ignore_ids_become_ignore_and_are_no_class(tmp_path):
    write_transforms(tmp_path)
    ids = np.full((HEIGHT, WIDTH), 255, np.uint8)
    ids[:4] = 2
    write_image(tmp_path / "masks/v00.png", ids)
    (tmp_path / "classes.json").write_text('{"2": "cup"}')
    loaded = labels_of(tmp_path, ignore_ids=(255,)).numpy()
    assert (loaded[:4] == 2).all() and (loaded[4:] == IGNORE).all()
    assert parse(tmp_path, ignore_ids=(255,)).metadata["classes"] == {0: "background", 2: "cup"}
    with pytest.raises(UserError, match=r"v00\.png holds id 255, which .*classes\.json does not name"):
        parse(tmp_path)


def test_missing_masks_are_ignore(tmp_path):
    write_transforms(tmp_path)
    write_image(tmp_path / "masks/v03.png", np.ones((HEIGHT, WIDTH), np.uint8))
    files = parse(tmp_path, eval_interval=0).metadata["mask_filenames"]
    assert [file and file.name for file in files] == [None] * 3 + ["v03.png"] + [None] * 5
    assert (labels_of(tmp_path, 0).numpy() == IGNORE).all()
    assert (labels_of(tmp_path, 3).numpy() == 1).all()


def test_masks_of_images_in_subfolders(tmp_path):
    poses = write_transforms(tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta["frames"] = meta["frames"][:2]
    for folder, frame in zip(("a", "b"), meta["frames"], strict=True):
        write_image(tmp_path / f"images/{folder}/same.png", noise(0))
        write_image(tmp_path / f"masks/{folder}/same.png", np.full((HEIGHT, WIDTH), ord(folder), np.uint8))
        frame["file_path"] = f"images/{folder}/same.png"
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    assert [int(labels_of(tmp_path, i)[0, 0]) for i in range(2)] == [ord("a"), ord("b")]
    assert len(poses) == 9
    (tmp_path / "masks/a/same.png").rename(tmp_path / "masks/same.png")
    with pytest.raises(UserError, match="could belong to 2 images"):
        parse(tmp_path)


def test_ground_truth_is_noted_where_it_is(tmp_path):
    write_transforms(tmp_path)
    assert parse(tmp_path).metadata["ground_truth"] is None
    write_image(tmp_path / "ground_truth/masks/v01.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_image(tmp_path / "ground_truth/silhouettes/cup/v02.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    truth = parse(tmp_path).metadata["ground_truth"]
    assert truth["masks"] == [tmp_path / "ground_truth/masks/v01.png"] + [None] * 6
    assert truth["silhouettes"] == {"cup": [None, tmp_path / "ground_truth/silhouettes/cup/v02.png"] + [None] * 5}


# --- images -------------------------------------------------------------------------------------------------------


def test_downscaled_image_and_class_map_stay_aligned(tmp_path):
    write_transforms(tmp_path)
    columns = np.broadcast_to(np.arange(WIDTH, dtype=np.uint8), (HEIGHT, WIDTH))
    write_image(tmp_path / "images/v00.png", np.repeat(10 * columns[..., None], 3, axis=2))
    write_image(tmp_path / "masks/v00.png", np.ascontiguousarray(columns))
    data = BeagsDataset(parse(tmp_path, eval_interval=0, downscale_factor=4.0)).get_data(0)
    assert data["image"].shape == (3, 5, 3)
    # Columns 0..3 average to 1.5; the new pixel's centre lies on the edge between columns 1 and 2.
    np.testing.assert_allclose(data["image"][0, :, 0] * 255, 10 * (1.5 + 4 * np.arange(5)), atol=0.01)
    np.testing.assert_array_equal(data["labels"][0].numpy(), 2 + 4 * np.arange(5))
    odd = BeagsDataset(parse(tmp_path, eval_interval=0, downscale_factor=20 / 4)).get_data(0)["labels"]
    np.testing.assert_array_equal(odd[0].numpy(), 2 + 5 * np.arange(4))  # the middle one of five


def test_camera_res_scale_factor_scales_both_once_more(tmp_path):
    write_transforms(tmp_path)
    dataset = BeagsDataset(parse(tmp_path, eval_interval=0), scale_factor=0.5)
    camera = camera_from_nerfstudio(dataset.cameras, 0)
    data = dataset.get_data(0)
    assert data["image"].shape[:2] == data["labels"].shape == (camera.height, camera.width) == (6, 10)
    np.testing.assert_allclose(camera.K[0, 2], CX / 2)


def test_alpha_goes_on_black_and_grey_becomes_rgb(tmp_path):
    write_transforms(tmp_path)
    rgba = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    rgba[:, 5:, 3] = 0
    rgba[:, :5, 3] = 255
    write_image(tmp_path / "images/v00.png", rgba)
    write_image(tmp_path / "images/v01.png", np.full((HEIGHT, WIDTH), 77, np.uint8))
    dataset = BeagsDataset(parse(tmp_path, eval_interval=0))
    image = dataset.get_data(0, "uint8")["image"]
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert (image[:, :5] == 200).all() and (image[:, 5:] == 0).all()
    assert (dataset.get_data(1, "uint8")["image"] == 77).all()
