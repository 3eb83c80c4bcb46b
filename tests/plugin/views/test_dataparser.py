"""Poses, intrinsics, splits and seed points as the data parser gives them."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import rich
import torch
from data_folders import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    WIDTH,
    look_at,
    noise,
    write_colmap,
    write_image,
    write_transforms,
)
from parsed_views import AS_GIVEN, names, parse, pixel, real
from rich.console import Console

from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.progress import progress_bar
from beags_plugin.views.cameras import camera_from_nerfstudio


def test_what_it_says_stands_above_a_bar_not_on_it(tmp_path, monkeypatch):
    write_transforms(tmp_path)
    console = Console(file=StringIO(), force_terminal=True)
    monkeypatch.setattr(rich, "_console", console)
    with progress_bar("Evaluating"):
        parse(tmp_path)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    line = f"{tmp_path}: nerfstudio layout"
    assert "Evaluating" in printed and printed.partition(line)[0].endswith("\x1b[2K")  # the bar's line is erased


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_photos_without_a_pose_are_told_and_left_out(tmp_path, write, capsys):
    write(tmp_path)
    for name in ("made.png", "v03.jpg"):  # no photo, and a copy of one that has a pose
        write_image(tmp_path / "images" / name, noise(0))
    assert names(parse(tmp_path, eval_interval=0)) == [f"v{i:02d}" for i in range(9)]
    assert "no pose" not in capsys.readouterr().out
    write_image(tmp_path / "images/w7.jpg", noise(0))
    assert len(names(parse(tmp_path, eval_interval=0))) == 9
    assert f"The photo {tmp_path}/images/w7.jpg has no pose, so it is not used." in capsys.readouterr().out
    write_image(tmp_path / "images/u5.jpg", noise(0))
    parse(tmp_path)
    said = capsys.readouterr().out
    assert f"2 photos have no pose, so they are not used; the first of them is {tmp_path}/images/u5.jpg." in said


# --- poses and intrinsics -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("per_frame", [False, True])
def test_transforms_cameras_see_points_where_the_file_says(tmp_path, per_frame):
    poses = write_transforms(tmp_path, per_frame=per_frame)
    outputs = parse(tmp_path, eval_interval=0, **AS_GIVEN)
    assert names(outputs) == [f"v{i:02d}" for i in range(9)]
    point = np.array([0.3, -0.2, 0.4])
    for index, pose in enumerate(poses):
        x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])  # OpenGL: y up, z backward
        cx = CX + 0.25 * index if per_frame else CX
        expected = [cx + FX * x / -z, CY - FY * y / -z]
        camera = camera_from_nerfstudio(outputs.cameras, index)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose(pixel(outputs, index, point), expected, atol=1e-4)


@pytest.mark.parametrize(("text", "folder"), [(False, "sparse/0"), (True, "sparse/0"), (False, "colmap/sparse/0")])
def test_colmap_cameras_and_seed_points_agree_after_normalisation(tmp_path, text, folder):
    points = np.array([[0.2, 0.1, 0.3], [-0.4, 0.2, 0.0], [0.0, 0.0, 0.5]])
    matrices = write_colmap(tmp_path, text=text, folder=folder, points=points)
    outputs = parse(tmp_path, eval_interval=0)
    assert names(outputs) == [f"v{i:02d}" for i in range(9)]  # image ids run the other way
    assert outputs.metadata["points3D_rgb"].tolist() == [[10, 20, 30]] * 3
    assert outputs.metadata["points3D_rgb"].dtype == torch.uint8
    assert not outputs.metadata["points3D_random"]
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    for index, matrix in enumerate(matrices):
        for raw, moved in zip(points, outputs.metadata["points3D_xyz"].tolist(), strict=True):
            x, y, w = K @ (matrix[:3, :3] @ raw + matrix[:3, 3])
            np.testing.assert_allclose(pixel(outputs, index, moved), [x / w, y / w], atol=1e-3)


def test_transform_and_scale_lead_back_to_the_original_world(tmp_path):
    write_transforms(tmp_path)
    given = parse(tmp_path, eval_interval=0, **AS_GIVEN).cameras.camera_to_worlds
    outputs = parse(tmp_path, eval_interval=0)
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    torch.testing.assert_close(back, given, atol=1e-5, rtol=0)


def test_downscaling_scales_each_axis_by_the_rounded_size(tmp_path):
    write_transforms(tmp_path)
    camera = camera_from_nerfstudio(parse(tmp_path, downscale_factor=3.0).cameras, 0)
    assert (camera.width, camera.height) == (7, 4)  # 20 / 3 is rounded up
    expected = [[FX * 7 / 20, 0, CX * 7 / 20], [0, FY / 3, CY / 3], [0, 0, 1]]
    np.testing.assert_allclose(camera.K.numpy(), expected, rtol=1e-6)


def test_cameras_follow_smaller_copies_of_the_images(tmp_path):
    write_colmap(tmp_path)
    for index in range(9):
        write_image(tmp_path / f"images_2/v{index:02d}.png", noise(index, 10, 6))
    camera = camera_from_nerfstudio(parse(tmp_path, images_path=Path("images_2")).cameras, 0)
    assert (camera.width, camera.height) == (10, 6)
    np.testing.assert_allclose(camera.K.numpy()[:2, 2], [CX / 2, CY / 2], rtol=1e-6)


# --- splits -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_every_eighth_view_by_name_is_held_out(tmp_path, write):
    write(tmp_path)
    parser = BeagsDataParserConfig(data=tmp_path).setup()
    assert names(parser.get_dataparser_outputs("train")) == [f"v{i:02d}" for i in range(1, 8)]
    for split in ("val", "test"):
        outputs = parser.get_dataparser_outputs(split)
        assert names(outputs) == ["v00", "v08"]
        assert len(outputs.cameras) == len(outputs.metadata["mask_filenames"]) == 2


def test_held_out_views_leave_the_training_set(tmp_path):
    write_transforms(tmp_path)
    options = dict(eval_interval=4, held_out=("v03",))
    assert names(parse(tmp_path, "train", **options)) == ["v01", "v02", "v05", "v06", "v07"]
    assert names(parse(tmp_path, "test", **options)) == ["v00", "v03", "v04", "v08"]


def test_splits_named_by_the_data_win(tmp_path):
    write_transforms(
        tmp_path / "a", train_filenames=["images/v04.png", "images/v01.png"], test_filenames=["images/v02.png"]
    )
    assert [names(parse(tmp_path / "a", split)) for split in ("train", "test", "val")] == [
        ["v01", "v04"],
        ["v02"],
        ["v02"],
    ]
    write_colmap(tmp_path / "b")
    (tmp_path / "b/train_list.txt").write_text("v05.png\nv00.png\n")
    (tmp_path / "b/test_list.txt").write_text("v07.png\n")
    assert [names(parse(tmp_path / "b", split)) for split in ("train", "val")] == [["v00", "v05"], ["v07"]]


# --- seed points --------------------------------------------------------------------------------------------------


def test_ply_seed_points_move_with_the_cameras(tmp_path):
    vertices = "0.1 0.2 0.3 9 8 7\n-0.5 0.0 0.25 255 0 1\n"
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "seed.ply").write_text(header + vertices)
    poses = write_transforms(tmp_path, ply_file_path="seed.ply")
    outputs = parse(tmp_path, eval_interval=0)
    assert outputs.metadata["points3D_rgb"].tolist() == [[9, 8, 7], [255, 0, 1]]
    for index in (0, 5):
        x, y, z = poses[index][:3, :3].T @ (np.array([-0.5, 0.0, 0.25]) - poses[index][:3, 3])
        moved = outputs.metadata["points3D_xyz"][1].tolist()
        np.testing.assert_allclose(pixel(outputs, index, moved), [CX + FX * x / -z, CY - FY * y / -z], atol=1e-3)


@pytest.mark.parametrize("kind", ["around", "forward", "outward"])
def test_random_points_lie_in_common_view(tmp_path, kind):
    poses = {
        "around": None,
        "forward": [look_at((0.1 * i, 5.0, 0.05 * (i % 3)), (0.1 * i, 0.0, 0.05 * (i % 3))) for i in range(9)],
        "outward": [
            look_at((0.1 * np.cos(i), 0.1 * np.sin(i), 0), (9 * np.cos(i), 9 * np.sin(i), 0)) for i in range(9)
        ],
    }[kind]
    write_transforms(tmp_path, poses=poses)
    outputs = parse(tmp_path, eval_interval=0, num_random_points=500)
    points = outputs.metadata["points3D_xyz"]
    assert outputs.metadata["points3D_random"] and points.shape == (500, 3) and points.isfinite().all()
    assert outputs.metadata["points3D_rgb"].shape == (500, 3)
    seen = np.zeros(500)
    for index in range(9):
        camera = camera_from_nerfstudio(outputs.cameras, index)
        moved = points @ camera.rotation.T + camera.translation
        x, y, w = (moved @ camera.K.T).T
        seen += ((w > 0) & (x > 0) & (x < WIDTH * w) & (y > 0) & (y < HEIGHT * w)).numpy()
    assert (seen >= (1 if kind == "outward" else 4.5)).mean() > 0.99

    again = parse(tmp_path, eval_interval=0, num_random_points=500).metadata["points3D_xyz"]
    assert torch.equal(points, again)


# --- real captures ------------------------------------------------------------------------------------------------


def test_fruit_reprojects_and_its_masks_fit():
    from nerfstudio.data.utils.colmap_parsing_utils import read_points3D_binary

    from beags_plugin.views.colmap_files import read_features

    root = real("fruit")
    outputs = parse(root)
    assert len(outputs.image_filenames) == 70 and len(names(parse(root, "test"))) == 11
    assert outputs.metadata["classes"] == {0: "background", 1: "apple", 2: "banana"}
    position = {key: i for i, key in enumerate(read_points3D_binary(root / "sparse/0/points3D.bin"))}
    seen, places = read_features(root / "sparse/0")[outputs.image_filenames[5].stem]
    seen, places = seen[seen >= 0], places[seen >= 0]
    points = outputs.metadata["points3D_xyz"][[position[i] for i in seen]]
    camera = camera_from_nerfstudio(outputs.cameras, 5)
    moved = (points @ camera.rotation.T + camera.translation) @ camera.K.T
    error = np.linalg.norm((moved[:, :2] / moved[:, 2:]).numpy() - places * [camera.width, camera.height], axis=1)
    assert len(seen) > 300 and np.median(error) < 1.0  # the reconstruction's mean error is 0.74 px
    data = BeagsDataset(outputs).get_data(5)
    assert data["image"].shape[:2] == data["labels"].shape == (camera.height, camera.width)
    assert set(np.unique(data["labels"].numpy())) <= {0, 1, 2}


def test_skull_has_no_seed_points_but_starts_around_the_skull():
    root = real("dtu_skull")
    outputs = parse(root, downscale_factor=2.0, num_random_points=2000)
    assert len(outputs.image_filenames) == 42
    centre = outputs.cameras.cx / outputs.cameras.width
    assert centre.std() > 0 or (centre - 0.5).abs().max() > 1e-3  # off-centre principal points are kept
    # The skull is inside the unit sphere of the file's world.
    points = outputs.metadata["points3D_xyz"].double()
    transform = outputs.dataparser_transform.double()
    original = (points / outputs.dataparser_scale - transform[:, 3]) @ transform[:, :3]
    assert (original.norm(dim=1) < 1).double().mean() > 0.1
    data = BeagsDataset(outputs).get_data(3)
    assert data["image"].shape[:2] == data["labels"].shape == (300, 400)
