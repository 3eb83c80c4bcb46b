"""Mistakes in the files of a layout are refused with one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, noise, write_image
from layout_folders import ids, write_dtu, write_lerf_mask, write_llff
from parsed_views import parse

from beags_plugin.system.errors import UserError


def test_a_folder_without_images_is_refused(tmp_path):
    write_llff(tmp_path)
    for path in (tmp_path / "images_4").iterdir():
        path.unlink()
    with pytest.raises(UserError, match="images_4 holds no images"):
        parse(tmp_path, images_path=Path("images_4"))


def with_smaller_images(root: Path) -> None:
    for index, path in enumerate(sorted((root / "image").iterdir())):
        write_image(path, noise(index, WIDTH // 2, HEIGHT // 2))


def with_camera(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    with np.load(root / "cameras_sphere.npz") as cameras:
        entries = dict(cameras)
    entries["world_mat_2"] = change(entries["world_mat_2"])
    np.savez(root / "cameras_sphere.npz", **entries)


SKEW = np.array([[1.0, 0.4, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
DENORMAL = np.zeros((4, 4))  # their products are 0
DENORMAL[[0, 0, 1, 2, 2], [0, 1, 2, 1, 3]] = 5.4e-312, 1.4e-309, 5.3e-315, 1.3e-315, 5.3e-315
FLAT = np.diag([1.0, 1.0, 1e-13, 1.0])
DTU_MISTAKES = {
    "mask gone": (lambda root: (root / "mask/003.png").unlink(), "mask holds 8 masks for 9 images"),
    "smaller images": (with_smaller_images, "far from the middle of its 10x6 pixels: keep the images .* --images-path"),
    "skew": (lambda root: with_camera(root, lambda camera: SKEW @ camera), "world_mat_2 in .* is no camera with axes"),
    "denormal": (lambda root: with_camera(root, lambda _: DENORMAL), "far from the middle of its 20x12"),
    "flat": (lambda root: with_camera(root, lambda _: FLAT), "world_mat_2 in .* projects no space"),
    "half a file": (
        lambda root: (root / "cameras_sphere.npz").write_bytes(b"PK\x03\x04"),
        "cannot be read .*: restore",
    ),
}


@pytest.mark.parametrize("mistake", DTU_MISTAKES)
def test_mistakes_in_dtu_are_refused_with_one_sentence(tmp_path, mistake):
    write_dtu(tmp_path)
    make, message = DTU_MISTAKES[mistake]
    make(tmp_path)
    with pytest.raises(UserError, match=message) as raised:
        parse(tmp_path)
    assert "\n" not in str(raised.value)


def test_a_test_mask_of_no_view_is_refused(tmp_path):
    write_lerf_mask(tmp_path)
    write_image(tmp_path / "test_mask/2/green apple.png", ids())
    with pytest.raises(UserError, match="test_mask/2 is for no test view, of which there are 2"):
        parse(tmp_path)
