"""Poses and points in map coordinates: read in double precision, moved to a local origin, and led back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import FX, HEIGHT, WIDTH, noise, quaternion, ring, write_image, write_transforms
from layout_folders import write_llff
from parsed_views import AS_GIVEN, parse, pixel

from beags_plugin.system.reading.ply import write_vertices

MAP = np.array([453_211.37, 5_411_873.94, 512.25])  # metres east, north and up, as surveyors give them
POINTS = np.array([[0.2, 0.1, 0.3], [-0.4, 0.2, 0.0], [0.0, 0.0, 0.5]])


def far_ring(count: int = 9) -> list[np.ndarray]:
    poses = [pose.copy() for pose in ring(count)]
    for pose in poses:
        pose[:3, 3] += MAP
    return poses


def far_ply(path: Path, kind: str = "<f8") -> None:
    table = np.zeros(len(POINTS), [(axis, kind) for axis in "xyz"])
    for column, axis in enumerate("xyz"):
        table[axis] = (POINTS + MAP)[:, column]
    with path.open("wb") as file:
        write_vertices(file, table)


def transforms(root: Path, **extra) -> None:
    root.mkdir(exist_ok=True)
    far_ply(root / "points.ply")
    write_transforms(root, poses=far_ring(), ply_file_path="points.ply", **extra)


def colmap(root: Path, text: bool) -> None:
    """Write a model in map coordinates by way of pycolmap's layout, written here by hand."""
    import struct

    model = root / "sparse/0"
    model.mkdir(parents=True)
    lines, binary = [], struct.pack("<Q", 9)
    for index, pose in enumerate(far_ring()):
        turned = pose[:3, :3] * [1.0, -1.0, -1.0]
        values = [*quaternion(turned.T), *(-turned.T @ pose[:3, 3])]
        write_image(root / f"images/v{index:02d}.png", noise(index))
        lines.append(f"{index + 1} {' '.join(map(repr, map(float, values)))} 1 v{index:02d}.png\n\n")
        name = f"v{index:02d}.png".encode() + b"\0"
        binary += struct.pack("<i7di", index + 1, *values, 1) + name + struct.pack("<Q", 0)
    far = POINTS + MAP
    if text:
        (model / "images.txt").write_text("".join(lines))
        (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FX} {FX} {WIDTH / 2} {HEIGHT / 2}\n")
        rows = [f"{i + 1} {x!r} {y!r} {z!r} 10 20 30 0.5\n" for i, (x, y, z) in enumerate(far.tolist())]
        (model / "points3D.txt").write_text("".join(rows))
        return
    (model / "images.bin").write_bytes(binary)
    camera = struct.pack("<Qii2Q4d", 1, 1, 1, WIDTH, HEIGHT, FX, FX, WIDTH / 2, HEIGHT / 2)
    (model / "cameras.bin").write_bytes(camera)
    body = b"".join(struct.pack("<Q3d3BdQ", i + 1, *p, 10, 20, 30, 0.5, 0) for i, p in enumerate(far))
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(far)) + body)


SOURCES = {
    "transforms": transforms,
    "COLMAP binary": lambda root: colmap(root, False),
    "COLMAP text": lambda root: colmap(root, True),
}


@pytest.mark.parametrize("options", [{}, {"orientation_method": "pca"}, AS_GIVEN], ids=str)
@pytest.mark.parametrize("source", SOURCES)
def test_points_stay_where_the_photos_show_them(tmp_path, source, options, capsys):
    SOURCES[source](tmp_path)
    outputs = parse(tmp_path, eval_interval=0, **options)
    transform, scale = outputs.dataparser_transform, outputs.dataparser_scale
    assert transform.dtype == torch.float64
    moved = outputs.metadata["points3D_xyz"]
    assert moved.dtype == torch.float32 and moved.abs().max() < 10
    center = (FX, FX * 16 / 17) if source == "transforms" else (FX, FX)
    principal = (8.5, 6.75) if source == "transforms" else (WIDTH / 2, HEIGHT / 2)
    for index, pose in enumerate(ring(9)):
        for point, seed in zip(POINTS, moved.tolist(), strict=True):
            x, y, z = pose[:3, :3].T @ (point - pose[:3, 3])
            expected = [principal[0] + center[0] * x / -z, principal[1] - center[1] * y / -z]
            np.testing.assert_allclose(pixel(outputs, index, seed), expected, atol=1e-3)
    back = (moved.double() / scale - transform[:, 3]) @ transform[:, :3]
    np.testing.assert_allclose(back.numpy(), POINTS + MAP, atol=1e-5, rtol=0)
    said = capsys.readouterr().out
    assert (
        "The cameras are about 453211, 5411874, 51" in said
        and "as map coordinates are" in said
        and "exports go back in double" in said
    )


def test_the_saved_transform_and_cameras_go_back_in_double(tmp_path):
    transforms(tmp_path)
    outputs = parse(tmp_path, eval_interval=0)
    outputs.save_dataparser_transform(tmp_path / "saved.json")
    saved = json.loads((tmp_path / "saved.json").read_text())
    assert saved["transform"] == outputs.dataparser_transform.tolist()
    rotation = outputs.dataparser_transform[:, :3]
    assert (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-14  # 1e-7 is half a metre here
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    np.testing.assert_allclose(back[:, :3, 3].numpy(), np.array(far_ring())[:, :3, 3], atol=1e-5, rtol=0)


def test_a_shift_to_map_coordinates_in_applied_transform_is_kept_in_double(tmp_path):
    applied = np.c_[np.eye(3), -MAP]
    poses = write_transforms(tmp_path, applied_transform=applied.tolist())
    outputs = parse(tmp_path, eval_interval=0)
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    np.testing.assert_allclose(back[:, :3, 3].numpy(), np.array(poses)[:, :3, 3] + MAP, atol=1e-5, rtol=0)


def test_llff_in_map_coordinates(tmp_path):
    write_llff(tmp_path)
    near = parse(tmp_path, eval_interval=0).cameras.camera_to_worlds
    rows = np.load(tmp_path / "poses_bounds.npy")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    matrices[:, :, 3] += MAP
    np.save(tmp_path / "poses_bounds.npy", np.c_[matrices.reshape(len(rows), 15), rows[:, 15:]])
    far = parse(tmp_path, eval_interval=0).cameras.camera_to_worlds
    torch.testing.assert_close(far, near, atol=1e-5, rtol=0)


def test_seed_points_that_single_precision_has_torn_apart_are_told(tmp_path, capsys):
    far_ply(tmp_path / "points.ply", "<f4")
    write_transforms(tmp_path, poses=far_ring(), ply_file_path="points.ply")
    parse(tmp_path)
    said = capsys.readouterr().out
    assert "points.ply" in said and "single precision" in said and "0.5" in said


def test_seed_points_in_map_coordinates_beside_local_poses_are_not_used(tmp_path, capsys):
    far_ply(tmp_path / "points.ply")
    write_transforms(tmp_path, ply_file_path="points.ply")
    outputs = parse(tmp_path, num_random_points=50)
    assert outputs.metadata["points3D_random"]
    assert "points.ply is not used, because its points do not lie where the cameras look" in capsys.readouterr().out


def test_a_world_near_0_is_normalised_as_nerfstudio_does(tmp_path, capsys):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    write_transforms(tmp_path, applied_transform=[[1, 0, 0, 2.0], [0, 0, 1, 0], [0, -1, 0, 0]])
    ours = parse(tmp_path, eval_interval=0)
    options = dict(downscale_factor=1, train_split_fraction=1.0, load_3D_points=False)
    theirs = NerfstudioDataParserConfig(data=tmp_path, **options).setup().get_dataparser_outputs("train")
    assert torch.equal(ours.cameras.camera_to_worlds, theirs.cameras.camera_to_worlds)
    assert torch.equal(ours.dataparser_transform.float(), theirs.dataparser_transform)
    assert ours.dataparser_scale == theirs.dataparser_scale
    assert "map coordinates" not in capsys.readouterr().out
