"""DTU in the form of NeuS: projection matrices in cameras_sphere.npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from beags_plugin.data.dataset import Dataset, PoseTable
from beags_plugin.data.files import choose_images, image_size, list_images, numbered
from beags_plugin.data.layout import Layout
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import load_arrays
from beags_plugin.system.reading.text import reason

FILE = "cameras_sphere.npz"
IMAGES = ("image", "images")
LARGEST_SKEW = 1.0  # pixels; the rasterizers support no skew
LEAST_SINGULAR_VALUE = 1e-10  # smallest singular value of a projection's 3 x 3 part, over the largest; usually 1e-4
OFF_CENTRE = 0.2  # largest distance of a principal point from the middle, over the image's sides


class Dtu(Layout):
    """image/*.png, mask/*.png and cameras_sphere.npz, whose world has the object in the unit sphere.

    Masks and images are paired in the order of names. Nothing occludes the object, so its masks are its silhouettes.
    """

    title = "DTU"
    marks = FILE
    refines = ("colmap", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        if root.is_file() or not (root / FILE).is_file():
            return f"no {FILE}"
        return None if any(list_images(root / name) for name in IMAGES) else "no images (image)"

    def read(self, root: Path, images: Path | None) -> Dataset:
        original = next(list_images(root / name) for name in IMAGES if list_images(root / name))
        files = list_images(choose_images(root, images)) if images is not None else original
        to_world, K, sizes, missing = read_cameras(root / FILE, original)
        if len(files) != len(original):
            raise UserError(f"{images} holds {len(files)} images, not {len(original)}: keep a copy of every one.")
        masks = list_images(root / "mask")
        if missing and len(masks) == len(files) + len(missing):  # masks of all photos
            masks = [masks[index] for index in numbered(original, len(masks))[0] or []]
        if masks and len(masks) != len(files):
            raise UserError(f"{root / 'mask'} holds {len(masks)} masks for {len(files)} images: keep one for each.")
        by_stem = {file.stem: mask for file, mask in zip(files, masks, strict=False)}
        return Dataset(
            self.title,
            root,
            PoseTable(root / FILE, tuple(files), to_world, K, sizes, missing=missing),
            mask_kind="binary" if masks else "ids",
            mask_files=by_stem if masks else None,
            class_names={1: "object"} if masks else None,
            silhouettes={"object": by_stem} if masks else {},
        )


def read_cameras(
    file: Path, images: list[Path]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.int64], tuple[Path, ...]]:
    """Read camera to world [V, 3, 4] (OpenGL axes), K [V, 3, 3] and sizes [V, 2] of the original images.

    The last part are the paths of missing photos of other cameras, if the images' numbers tell them. ``world_mat_i``
    [4, 4] projects the world to pixels, ``scale_mat_i`` maps the unit sphere to the world.
    Raises ``UserError`` if an entry is missing or describes no camera.
    """
    try:
        table = {name: entry.astype(np.float64) for name, entry in load_arrays(file).items() if "_mat_" in name}
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"the cameras {file} cannot be read ({reason(error)}): restore the file.") from error
    count = sum(name.startswith("world_mat_") and not name.startswith("world_mat_inv_") for name in table)
    places, missing = numbered(images, count)
    if len(images) + len(missing) != count:
        raise UserError(
            f"{file} has {count} cameras but there are {len(images)} images: keep the images of these cameras."
        )
    poses, intrinsics = [], []
    for index in range(count) if places is None else places:
        projection = table.get(f"world_mat_{index}")
        if projection is None or projection.shape != (4, 4):
            raise UserError(f"{file} lacks the 4 x 4 matrix world_mat_{index}: restore the file.")
        scale = table.get(f"scale_mat_{index}", np.eye(4))
        if scale.shape != (4, 4):
            raise UserError(f"scale_mat_{index} in {file} is {list(scale.shape)}, not 4 x 4: restore the file.")
        with np.errstate(over="ignore", invalid="ignore"):
            projection = (projection @ scale)[:3]
        # The scale of a projection has no meaning, and may be a denormal number.
        largest = np.abs(projection[:, :3]).max()
        if not (np.isfinite(projection).all() and largest > 0 and _is_regular(projection[:, :3] / largest)):
            raise UserError(f"world_mat_{index} in {file} projects no space to an image: restore the file.")
        K, rotation, center = decompose(projection / largest)
        if not (np.isfinite(K).all() and np.isfinite(center).all()) or abs(K[0, 1]) > LARGEST_SKEW:
            raise UserError(f"world_mat_{index} in {file} is no camera with axes at right angles: correct the file.")
        K[0, 1] = 0.0
        K[:2, 2] += 0.5  # pixel centres of the file are whole numbers
        intrinsics.append(K)
        poses.append(np.concatenate([rotation.T * [1.0, -1.0, -1.0], center[:, None]], axis=1))
    sizes = np.array([image_size(image) for image in images], np.int64)
    for image, K, size in zip(images, intrinsics, sizes, strict=True):
        if (np.abs(K[:2, 2] / size - 0.5) > OFF_CENTRE).any():  # the file does not give image sizes
            raise UserError(
                f"{file} has the principal point of {image} at {K[0, 2]:.0f}, {K[1, 2]:.0f}, far from the middle of "
                f"its {size[0]}x{size[1]} pixels: keep the images that the file is of in {image.parent}, and name the "
                "folder of smaller copies with --images-path."
            )
    return np.stack(poses), np.stack(intrinsics), sizes, missing


def _is_regular(matrix: npt.NDArray[np.float64]) -> bool:
    """Return whether a matrix [3, 3] is invertible in float64; NumPy's rank also accepts some that are not."""
    values = np.linalg.svd(matrix, compute_uv=False)
    return bool(values[-1] > LEAST_SINGULAR_VALUE * values[0])


def decompose(projection: npt.NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return K [3, 3], world-to-camera rotation [3, 3] (OpenCV) and centre [3] of K [R | -R c], given up to scale."""
    from scipy.linalg import rq

    K, rotation = (np.asarray(part) for part in rq(projection[:, :3]))
    signs = np.sign(np.diag(K))
    K, rotation = K * signs, signs[:, None] * rotation
    if np.linalg.det(rotation) < 0:  # the projection's scale was negative
        rotation = np.negative(rotation)
    return K / K[2, 2], rotation, np.linalg.solve(projection[:, :3], -projection[:, 3])
