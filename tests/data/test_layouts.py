"""Layouts from their exact file trees: recognition, split, intrinsics of scaled images, ids and names."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, noise, write_colmap, write_image, write_transforms
from layout_folders import (
    FOCAL,
    ids,
    opencv_matrices,
    write_3dovs,
    write_lerf_mask,
    write_llff,
    write_mipnerf360,
    write_poses_bounds,
)
from parsed_views import AS_GIVEN, POINT, moved, names, parse, pixel, real, title

import beags_plugin.data.files as files
from beags_plugin.data import LAYOUTS
from beags_plugin.data.dataset import Dataset, PoseTable, Split
from beags_plugin.data.layout import Layout
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio


@pytest.mark.parametrize(("gone", "factor", "size"), [((), 4, (5, 3)), (("images_4", "images_8"), 2, (10, 6))])
def test_mipnerf360_takes_a_quarter_or_the_largest_copies_that_are_small_enough(
    tmp_path, monkeypatch, capsys, gone, factor, size
):
    stems = write_mipnerf360(tmp_path / "garden")
    tmp_path = tmp_path / "garden"
    for name in gone:
        shutil.rmtree(tmp_path / name)
    monkeypatch.setattr(files, "LARGEST_WIDTH", 10)
    assert title(tmp_path) == "Mip-NeRF 360"
    outputs = parse(tmp_path, **AS_GIVEN)
    assert outputs.image_filenames[0].parent.name == f"images_{factor}"
    said = " ".join(capsys.readouterr().out.split())
    assert f"images_{factor} are used {size[0]} pixels wide (other sizes: " in said
    camera = camera_from_nerfstudio(outputs.cameras, 0)
    assert (camera.width, camera.height) == size
    expected = [[FX / factor, 0, CX / factor], [0, FY / factor, CY / factor], [0, 0, 1]]
    np.testing.assert_allclose(camera.K.numpy(), expected, rtol=1e-6)
    assert names(parse(tmp_path, "test")) == [stems[0], stems[8]]
    assert names(outputs) == stems[1:8] + stems[9:]


@pytest.mark.parametrize("layout", ["mipnerf360", "llff", "lerf-mask", "3dovs"])
def test_a_size_that_the_user_chose_has_no_note(tmp_path, layout, capsys):
    EVERY[layout][0](tmp_path)
    parse(tmp_path, layout=layout, downscale_factor=1.0)
    assert "pixels wide (other sizes: " in " ".join(capsys.readouterr().out.split()), "and so they are by a factor of 1"
    folder = {"mipnerf360": "images_4"}.get(layout, "images")
    for options in ({"downscale_factor": 2.0}, {"images_path": Path(folder)}):
        parse(tmp_path, layout=layout, **options)
        assert "are used" not in capsys.readouterr().out


def test_mipnerf360_masks_and_ground_truth_of_both_kinds(tmp_path):
    stems = write_mipnerf360(tmp_path)
    write_image(tmp_path / f"masks/{stems[1]}.png", ids(3))
    with pytest.raises(UserError, match="is 20x12 pixels but its image is 5x3: .* name images of its size with"):
        parse(tmp_path)
    (tmp_path / "classes.json").write_text('{"3": "table"}')
    write_image(tmp_path / f"ground_truth/visible/table/{stems[8]}.png", ids(255))
    write_image(tmp_path / f"ground_truth/silhouettes/table/{stems[0]}.png", ids(255))
    outputs = parse(tmp_path, "test", images_path=Path("images"))
    assert outputs.metadata["classes"] == {0: "background", 3: "table"}
    truth = outputs.metadata["ground_truth"]
    assert truth["visible"] == {"table": [None, tmp_path / f"ground_truth/visible/table/{stems[8]}.png"]}
    assert truth["silhouettes"] == {"table": [tmp_path / f"ground_truth/silhouettes/table/{stems[0]}.png", None]}
    labels = BeagsDataset(parse(tmp_path, images_path=Path("images"))).get_data(0)["labels"].numpy()
    np.testing.assert_array_equal(labels, ids(3))


@pytest.mark.parametrize("text", [False, True])
def test_colmap_in_binary_and_text(tmp_path, text, capsys):
    write_colmap(tmp_path, text=text)
    assert title(tmp_path) == "COLMAP"
    outputs = parse(tmp_path, **AS_GIVEN)
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    x, y, w = K @ (opencv_matrices(9)[1] @ [*POINT, 1.0])[:3]
    np.testing.assert_allclose(pixel(outputs, 0, moved(outputs, POINT)), [x / w, y / w], atol=1e-3)
    said = " ".join(capsys.readouterr().out.split())
    assert "COLMAP layout, poses of sparse/0, 9 images in images (2 held out), no masks, random seed points." in said


def test_nerfstudio_comes_before_colmap(tmp_path):
    write_colmap(tmp_path)
    write_transforms(tmp_path)
    assert title(tmp_path) == title(tmp_path / "transforms.json") == "nerfstudio"
    assert title(tmp_path, "colmap") == "COLMAP"


def test_two_layouts_in_one_folder_are_refused(tmp_path):
    write_lerf_mask(tmp_path)
    write_poses_bounds(tmp_path, [f"{index:06d}.png" for index in range(6)], 1)
    with pytest.raises(UserError, match=r"test_mask \(lerf-mask\) and poses_bounds\.npy \(llff\): choose one"):
        parse(tmp_path)
    assert title(tmp_path, "lerf-mask") == "LERF-Mask"
    assert len(parse(tmp_path, layout="lerf-mask").image_filenames) == 4


def test_an_unknown_folder_or_layout_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"neither transforms\.json nor a COLMAP model .*poses_bounds\.npy \(llff\)"):
        parse(tmp_path)
    with pytest.raises(UserError, match=r"there is no layout 'llf' .did you mean llff.*: choose one of 3dovs, colmap"):
        parse(tmp_path, layout="llf")
    with pytest.raises(UserError, match=r"holds no segmentations/classes\.txt, which the layout 3dovs needs"):
        parse(tmp_path, layout="3dovs")


class Turntable(Layout):
    """A layout of another package."""

    title = "turntable"
    marks = "turntable.txt"

    def missing(self, root: Path) -> str | None:
        return None if (root / "turntable.txt").is_file() else "no turntable.txt"

    def read(self, root: Path, images: Path | None) -> Dataset:
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        poses = np.linalg.inv(opencv_matrices(9)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        shots = tuple(root / f"shot{index}.png" for index in range(9))
        sizes = np.full((9, 2), (WIDTH, HEIGHT))
        table = PoseTable(root / "turntable.txt", shots, poses[:, :3], np.stack([K] * 9), sizes)
        held_out = (root / "turntable.txt").read_text().split()
        return Dataset(self.title, root, table, Split(held_out=tuple(held_out)) if held_out else Split())


def test_another_package_can_add_a_layout(tmp_path, monkeypatch):
    monkeypatch.setitem(LAYOUTS._specs, "turntable", "test_layouts:Turntable")
    (tmp_path / "turntable.txt").touch()
    for index in range(9):
        write_image(tmp_path / f"shot{index}.png", noise(index))
    write_image(tmp_path / "masks/shot3.png", ids(6))
    assert title(tmp_path) == "turntable"
    outputs = parse(tmp_path)
    assert names(outputs) == [f"shot{index}" for index in range(1, 8)]
    assert outputs.metadata["classes"] == {0: "background", 6: "class_6"} and outputs.metadata["points3D_random"]


def test_a_view_that_a_layout_holds_out_in_vain_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(LAYOUTS._specs, "turntable", "test_layouts:Turntable")
    (tmp_path / "turntable.txt").write_text("shot2 front")
    for index in range(9):
        write_image(tmp_path / f"shot{index}.png", noise(index))
    parse(tmp_path)
    said = " ".join(capsys.readouterr().out.split())
    assert "holds out front, but no image has that name" in said and "holds out shot2" not in said


COLMAP_K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
POSES_BOUNDS_K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
# layout: how its fixture is written, the options to read it with, K and size of the images that are read
EVERY = {
    "nerfstudio": (write_transforms, {}, COLMAP_K, 1.0),
    "colmap": (write_colmap, {}, COLMAP_K, 1.0),
    "mipnerf360": (write_mipnerf360, {"images_path": Path("images_2")}, COLMAP_K, 0.5),
    "llff": (write_llff, {"images_path": Path("images_4")}, POSES_BOUNDS_K, 1.0),
    "lerf-mask": (write_lerf_mask, {}, COLMAP_K, 1.0),
    "3dovs": (write_3dovs, {}, POSES_BOUNDS_K, 1.0),
}


every_layout = pytest.mark.parametrize("layout", EVERY)


def enlarge(path: Path) -> None:
    """Double the width and height of an image or mask."""
    from PIL import Image

    with Image.open(path) as image:
        larger = image.resize((2 * image.width, 2 * image.height), Image.Resampling.NEAREST)
    larger.save(path)


@every_layout
def test_intrinsics_follow_the_size_of_the_images(tmp_path, layout):
    write, options, K, factor = EVERY[layout]
    write(tmp_path)
    before = parse(tmp_path, layout=layout, **options)
    scale = np.diag([factor, factor, 1.0])
    np.testing.assert_allclose(camera_from_nerfstudio(before.cameras, 1).K.numpy(), scale @ K, rtol=1e-5)
    seen = pixel(before, 1, moved(before, POINT))
    for split in ("train", "test"):
        outputs = parse(tmp_path, split, layout=layout, **options)
        for path in (*outputs.image_filenames, *outputs.metadata["mask_filenames"]):
            if path is not None:
                enlarge(path)
    after = parse(tmp_path, layout=layout, **options)
    camera = camera_from_nerfstudio(after.cameras, 1)
    assert (camera.width, camera.height) == (2 * factor * WIDTH, 2 * factor * HEIGHT)
    np.testing.assert_allclose(camera.K.numpy(), np.diag([2.0, 2.0, 1.0]) @ scale @ K, rtol=1e-5)
    np.testing.assert_allclose(pixel(after, 1, moved(after, POINT)), 2 * seen, atol=1e-3)


@every_layout
def test_ground_truth_has_a_folder_for_what_is_seen_and_one_for_what_is_hidden(tmp_path, layout):
    write, options, _, _ = EVERY[layout]
    write(tmp_path)
    stem = names(parse(tmp_path, "test", layout=layout, **options))[0]
    folder = tmp_path / "ground_truth"
    files = {kind: folder / kind / f"thing/{stem}.png" for kind in ("visible", "silhouettes")}
    for path in (*files.values(), folder / f"masks/{stem}.png"):
        write_image(path, ids(1))
    truth = parse(tmp_path, "test", layout=layout, **options).metadata["ground_truth"]
    for kind, path in files.items():
        assert truth[kind]["thing"][0] == path and not any(truth[kind]["thing"][1:])
    assert truth["masks"][0] == folder / f"masks/{stem}.png" and not any(truth["masks"][1:])
    train = parse(tmp_path, layout=layout, **options).metadata["ground_truth"]
    if set(names(parse(tmp_path, layout=layout, **options))).isdisjoint({stem}):
        assert not any(any(train[kind]["thing"]) for kind in files)


def test_kitchen_is_mipnerf360():
    root = real("kitchen")
    assert title(root) == "Mip-NeRF 360"
    assert names(parse(root, "test")) == ["00", "08", "16", "24"] and len(names(parse(root))) == 21
