"""Tiny scenes in the exact file trees of the data sets, with known cameras and masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from data_folders import HEIGHT, WIDTH, noise, ring, write_colmap, write_image

FOCAL = 32.0  # focal length of the original images of LLFF and DTU


def ids(class_id: int = 1, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return [height, width] uint8: a rectangle of ``class_id`` on 0."""
    mask = np.zeros((height, width), np.uint8)
    mask[height // 4 : height // 2, width // 4 : width // 2] = class_id
    return mask


def write_copies(root: Path, names, *factors: int) -> None:
    """Write smaller copies images_<factor>/<name> of images of 20 x 12 pixels."""
    for factor in factors:
        for index, name in enumerate(names):
            write_image(root / f"images_{factor}" / name, noise(index, round(WIDTH / factor), round(HEIGHT / factor)))


def opencv_matrices(count: int) -> list[np.ndarray]:
    """Return world-to-camera [4, 4] of ``ring``, OpenCV axes."""
    return [np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0])) for pose in ring(count)]


def write_mipnerf360(root: Path) -> list[str]:
    """Write a scene like garden: DSC*.JPG in images, images_2, images_4, images_8, and sparse/0."""
    names = [f"DSC{7956 + index:05d}.JPG" for index in range(10)]
    write_colmap(root, names=names)
    write_copies(root, names, 2, 4, 8)
    return [Path(name).stem for name in names]


def write_poses_bounds(root: Path, names, factor: int, bounds=(2.0, 5.0)) -> list[np.ndarray]:
    """Write poses_bounds.npy of ``ring`` for images of 20 x 12 times ``factor`` pixels; return world-to-camera."""
    rows = []
    for pose in ring(len(names)):
        right, up, back, position = pose[:3, :4].T
        size = [HEIGHT * factor, WIDTH * factor, FOCAL * factor]
        matrix = np.stack([-up, right, back, position, np.array(size)], axis=1)  # LLFF: down, right, backward
        rows.append([*matrix.ravel(), *bounds])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return opencv_matrices(len(names))


def write_llff(root: Path, originals: bool = True, factor: int = 4) -> list[str]:
    """Write fern: images/IMG_40NN.JPG, images_4/imageNNN.png in their order, poses_bounds.npy in original pixels."""
    names = [f"image{index:03d}.png" for index in range(10)]
    for index, name in enumerate(names):
        write_image(root / "images_4" / name, noise(index))
        if originals:
            write_image(root / f"images/IMG_{4026 + index}.JPG", noise(index, WIDTH * factor, HEIGHT * factor))
    write_poses_bounds(root, names, factor)
    return [Path(name).stem for name in names]


def write_lerf_mask(root: Path) -> list[str]:
    """Write figurines: images, images_train, object_mask, test_mask/<n>/<prompt>.png, sparse/0."""
    names = [f"frame_{index:05d}.jpg" for index in (1, 2, 41, 90, 105, 152)]
    write_colmap(root, names=names)
    for index, name in enumerate(names):
        if Path(name).stem not in ("frame_00041", "frame_00152"):
            write_image(root / "images_train" / name, noise(index))
            write_image(root / f"object_mask/{Path(name).stem}.png", ids(37))
    write_image(root / "test_mask/0/green apple.png", 255 * ids())
    write_image(root / "test_mask/0/old camera.png", np.repeat(255 * ids()[::-1, :, None], 3, axis=2))
    write_image(root / "test_mask/1/green apple.png", 255 * ids())
    return [Path(name).stem for name in names]


def write_3dovs(root: Path) -> list[str]:
    """Write bed: images/NN.jpg, segmentations/classes.txt, segmentations/<NN>/<class>.png, poses_bounds.npy."""
    names = [f"{index:02d}.jpg" for index in range(6)]
    for index, name in enumerate(names):
        write_image(root / "images" / name, noise(index))
    (root / "segmentations").mkdir()
    (root / "segmentations/classes.txt").write_text("red bag\nbanana\nwhite sheet\n")
    for view in ("00", "04"):
        for index, name in enumerate(("red bag", "banana", "white sheet")):
            write_image(root / f"segmentations/{view}/{name}.png", np.roll(255 * ids(), 5 * index, axis=1))
    write_poses_bounds(root, names, 1)
    return [Path(name).stem for name in names]
