"""LLFF: scaled images, poses and points of either file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, write_colmap
from layout_folders import FOCAL, opencv_matrices, write_copies, write_llff, write_poses_bounds
from parsed_views import AS_GIVEN, POINT, moved, names, parse, pixel, real, title

import beags_plugin.data.files as files
from beags_plugin.data.files import image_size
from beags_plugin.views.cameras import camera_from_nerfstudio


def test_llff_scales_the_intrinsics_to_the_images_and_turns_the_axes(tmp_path):
    root = tmp_path / "fern"
    stems = write_llff(root)
    assert title(root) == "LLFF"
    outputs = parse(root, images_path=Path("images_4"), eval_interval=0, **AS_GIVEN)
    assert outputs.image_filenames[0] == root / "images_4/image000.png"
    for index, matrix in enumerate(opencv_matrices(len(stems))):
        if index != 1:
            x, y, z = (matrix @ [*POINT, 1.0])[:3]
            expected = [WIDTH / 2 + FOCAL * x / z, HEIGHT / 2 + FOCAL * y / z]
            np.testing.assert_allclose(pixel(outputs, index, POINT), expected, atol=1e-4)
    normalised = parse(root, images_path=Path("images_4"), eval_interval=0)
    expected = pixel(outputs, 0, POINT)
    np.testing.assert_allclose(pixel(normalised, 0, moved(normalised, POINT)), expected, atol=1e-3)


def test_llff_makes_the_largest_images_as_wide_as_papers_do(tmp_path, monkeypatch, capsys):
    root = tmp_path / "fern"
    write_llff(root, originals=True)
    monkeypatch.setattr(files, "LARGEST_WIDTH", WIDTH - 4)
    largest = max(image_size(path)[0] for path in root.rglob("*.*") if path.suffix.lower() in files.IMAGE_SUFFIXES)
    camera = camera_from_nerfstudio(parse(root).cameras, 0)
    assert camera.width == WIDTH - 4 < largest
    assert f"are used {WIDTH - 4} pixels wide (" in " ".join(capsys.readouterr().out.split())
    assert camera_from_nerfstudio(parse(root, downscale_factor=1.0).cameras, 0).width == largest
    assert "pixels wide" not in capsys.readouterr().out  # The user chose this size.


def test_images_of_llff_that_are_narrower_keep_their_size(tmp_path, monkeypatch, capsys):
    write_llff(tmp_path, originals=False)
    monkeypatch.setattr(files, "LARGEST_WIDTH", WIDTH + 1)
    assert camera_from_nerfstudio(parse(tmp_path).cameras, 0).width == WIDTH
    assert f"images_4 are used {WIDTH} pixels wide (other sizes: " in " ".join(capsys.readouterr().out.split())


def test_llff_with_colmap_pairs_renamed_copies_in_order(tmp_path):
    root = tmp_path / "fern"
    originals = [f"IMG_{4026 + index}.JPG" for index in range(10)]
    points = np.array([[0.1, 0.2, 0.3], [0.0, 0.1, -0.2]])
    write_colmap(root, names=originals, points=points)
    write_copies(root, [f"image{index:03d}.png" for index in range(10)], 2)
    for name in originals:
        (root / "images" / name).unlink()
    np.save(root / "poses_bounds.npy", np.zeros((10, 17)))  # COLMAP comes first: it knows the lens
    outputs = parse(root, "test")
    assert names(outputs) == ["image000", "image008"]
    K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    x, y, w = K @ (opencv_matrices(10)[8] @ [*POINT, 1.0])[:3]
    np.testing.assert_allclose(pixel(outputs, 1, moved(outputs, POINT)), [x / w / 2, y / w / 2], atol=1e-3)
    np.testing.assert_allclose(outputs.metadata["points3D_xyz"][1], moved(outputs, points[1]), atol=1e-5)


@pytest.mark.parametrize("same_frame", [True, False])
def test_llff_takes_colmap_points_only_where_the_poses_look(tmp_path, same_frame):
    write_llff(tmp_path)
    other = tmp_path / "other"
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (40, 3))
    write_colmap(other, points=points if same_frame else points + 40.0)
    (tmp_path / "sparse/0").mkdir(parents=True)
    (other / "sparse/0/points3D.bin").rename(tmp_path / "sparse/0/points3D.bin")
    outputs = parse(tmp_path, images_path=Path("images_4"), num_random_points=300)
    assert outputs.metadata["points3D_random"] != same_frame
    assert len(outputs.metadata["points3D_xyz"]) == (40 if same_frame else 300)
    if same_frame:
        np.testing.assert_allclose(outputs.metadata["points3D_xyz"][7], moved(outputs, points[7]), atol=1e-5)


def test_llff_draws_points_between_the_bounds(tmp_path):
    stems = write_llff(tmp_path)
    write_poses_bounds(tmp_path, stems, 4, bounds=(2.5, 3.5))
    outputs = parse(tmp_path, images_path=Path("images_4"), num_random_points=400, **AS_GIVEN)
    points = outputs.metadata["points3D_xyz"].double().numpy()
    depths = np.stack([points @ m[2, :3] + m[2, 3] for m in opencv_matrices(10)])
    assert points.shape == (400, 3) and ((depths > 2.5 - 1e-4) & (depths < 3.5 + 1e-4)).any(axis=0).all()


def test_llff_knows_the_lens_from_the_camera_file(tmp_path):
    write_llff(tmp_path)
    (tmp_path / "sparse/0").mkdir(parents=True)
    cameras = tmp_path / "sparse/0/cameras.txt"
    cameras.write_text(f"1 SIMPLE_RADIAL {4 * WIDTH} {4 * HEIGHT} {4 * FOCAL} {2 * WIDTH} {2 * HEIGHT} 0.02\n")
    parameters = parse(tmp_path, images_path=Path("images_4")).cameras.distortion_params
    torch.testing.assert_close(parameters, torch.tensor([0.02, 0, 0, 0, 0, 0]).expand(8, 6))
    cameras.write_text(f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.02\n")  # another camera
    assert not parse(tmp_path, images_path=Path("images_4")).cameras.distortion_params.any()


def test_fern_points_have_the_colours_of_the_images():
    """Poses, scaled intrinsics, lens and seed points agree: points meet their colours; mirrored they do not."""
    from PIL import Image

    root = real("fern")
    outputs, test = parse(root), parse(root, "test")
    assert title(root) == "LLFF" and len(names(outputs)) == 17
    assert names(test) == ["image000", "image008", "image016"]
    assert len(outputs.metadata["points3D_xyz"]) == 10091 and not outputs.metadata["points3D_random"]
    assert outputs.cameras.distortion_params[0, 0] == pytest.approx(0.01975, abs=1e-5)
    points = outputs.metadata["points3D_xyz"].double().numpy()
    colors = outputs.metadata["points3D_rgb"].double().numpy()
    camera = camera_from_nerfstudio(outputs.cameras, 5)
    x, y, z = (points @ camera.rotation.double().numpy().T + camera.translation.double().numpy()).T
    x, y = x / z, y / z
    lens = 1.0 + float(outputs.cameras.distortion_params[5, 0]) * (x * x + y * y)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    columns, rows = np.floor(fx * x * lens + cx).astype(int), np.floor(fy * y * lens + cy).astype(int)
    inside = (z > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    image = np.asarray(Image.open(outputs.image_filenames[5]).convert("RGB")).astype(float)
    error = np.abs(image[rows[inside], columns[inside]] - colors[inside]).mean(axis=1)
    mirrored = np.abs(image[rows[inside], camera.width - 1 - columns[inside]] - colors[inside]).mean(axis=1)
    assert inside.mean() > 0.5 and np.median(error) < 0.5 * np.median(mirrored)
