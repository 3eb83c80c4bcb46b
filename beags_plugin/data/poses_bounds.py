"""LLFF's poses_bounds.npy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beags_plugin.data.dataset import PoseTable
from beags_plugin.data.files import list_images, numbered
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import load_array
from beags_plugin.system.reading.text import reason

FILE = "poses_bounds.npy"
# LLFF's camera axes are down, right and backward; OpenGL's are right, up and backward.
_TO_OPENGL = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def read_poses_bounds(file: Path, images: Path) -> PoseTable:
    """Read the poses of the images in the folder ``images``, in the order of their names.

    A row of the file holds a 3 x 5 matrix [R | t | (height, width, focal length)], camera to world, in pixels of the
    original images, then the nearest and the farthest depth. The principal point is the centre. The lens distortion
    comes from COLMAP's sparse/0/cameras. Raises ``UserError`` for other content, and if the numbers of rows and images
    differ.
    """
    try:
        rows = load_array(file)
    except (OSError, ValueError) as error:
        raise UserError(f"the poses {file} cannot be read ({reason(error)}): save them as LLFF does.") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise UserError(
            f"the poses {file} are {list(rows.shape)} of {rows.dtype} instead of [views, 17] numbers: save "
            "them as LLFF does."
        )
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise UserError(f"the poses {file} hold a value such as NaN that is not finite: save them as LLFF does.")
    files = list_images(images)
    places, missing = numbered(files, len(rows))
    rows = rows if places is None else rows[places]
    if len(files) != len(rows):
        raise UserError(
            f"{file} has {len(rows)} poses but {images} {len(files)} images: keep the images that have poses."
        )
    matrices = rows[:, :15].reshape(-1, 3, 5).astype(np.float64)
    height, width, focal = matrices[:, :, 4].T
    _check_rows(file, files, rows)
    K = np.zeros((len(rows), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = width / 2, height / 2, 1.0
    poses = np.concatenate([matrices[:, :, :3] @ _TO_OPENGL.T, matrices[:, :, 3:4]], axis=2)
    sizes = np.stack([width, height], axis=1).astype(np.int64)
    lenses = (file.parent / "sparse" / "0" / f"cameras.{end}" for end in ("txt", "bin"))
    lens = next((each for each in lenses if each.is_file()), None)
    return PoseTable(file, tuple(files), poses, K, sizes, rows[:, 15:].astype(np.float64), lens, missing)


def _check_rows(file: Path, images: list[Path], rows: np.ndarray) -> None:
    """Raise ``UserError`` for the first row that describes no camera."""
    for image, row in zip(images, rows, strict=True):
        (height, width, focal), (near, far) = row[[4, 9, 14]], row[15:]
        if not (height >= 1 and width >= 1 and focal > 0):
            raise UserError(
                f"{file} gives {image.name} {width:g} x {height:g} pixels and the focal length {focal:g}: save the "
                "poses as LLFF does."
            )
        if not 0 < near < far:
            raise UserError(
                f"{file} gives {image.name} the depths {near:g} to {far:g}: they must grow from above 0; save the "
                "poses as LLFF does."
            )
