"""Points from which training starts: read from a .ply, or drawn where the cameras look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from beags_plugin.core.cameras import Camera
from beags_plugin.errors import UserError


def read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] float32 and colours [N, 3] uint8 (mid-grey where the file has none) of a .ply's vertices.

    Raises ``UserError`` if the file is absent or has no vertices with x, y, z.
    """
    from plyfile import PlyData, PlyParseError

    if not path.is_file():
        raise UserError(f"the seed points {path} (ply_file_path) do not exist: restore the file or remove the key.")
    try:
        vertices = PlyData.read(str(path))["vertex"].data
        points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32)
    except (PlyParseError, KeyError, ValueError) as error:
        raise UserError(f"the seed points {path} cannot be read as a .ply with x, y, z: {error}.") from error
    if not all(name in vertices.dtype.names for name in ("red", "green", "blue")):
        return points, np.full(points.shape, 128, np.uint8)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
    if np.issubdtype(colors.dtype, np.floating):  # floats are shares of 1, integers are bytes
        colors = np.clip(colors * 255.0 + 0.5, 0, 255)
    return points, colors.astype(np.uint8)


def random_points(cameras: Sequence[Camera], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the cameras' common view, for scenes without seed points.

    Drawn uniformly in the ball around the cameras' point of interest (see ``_point_of_interest``) whose radius is half
    the cameras' median distance from it, and kept where at least half of the views see them (or as many views as
    see the best tenth, where frusta overlap less than that).

    Returns positions [count, 3] float32 and colours [count, 3] uint8, mid-grey. The same seed gives the same points.
    """
    rotations = np.stack([camera.rotation.double().numpy() for camera in cameras])
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    focus = _point_of_interest(rotations, centers)
    radius = 0.5 * float(np.median(np.linalg.norm(centers - focus, axis=1)))
    generator = np.random.default_rng(seed)
    batch = 1 << 14

    def draw() -> tuple[np.ndarray, np.ndarray]:
        directions = generator.normal(size=(batch, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = focus + radius * directions * np.cbrt(generator.uniform(size=(batch, 1)))
        return points, _share_of_views(points, rotations, centers, cameras)

    points, share = draw()
    threshold = min(0.5, float(np.quantile(share, 0.9)))
    kept = [points[share >= threshold]]
    while sum(map(len, kept)) < count:
        points, share = draw()
        kept.append(points[share >= threshold])
    xyz = np.concatenate(kept)[:count].astype(np.float32)
    return xyz, np.full((count, 3), 128, np.uint8)


def _point_of_interest(rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """The point [3] closest to all optical axes in the least-squares sense.

    Where that point says nothing (axes almost parallel, or it lies behind half of the cameras, as for views that look
    outwards) it is put in front of the cameras' mean, at 4 times the radius of the set of cameras.
    """
    axes = rotations[:, 2]
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = projectors.mean(0)
    # The smallest eigenvalue is the mean squared sine between the axes and their common direction; below 1e-3 (about
    # 2 degrees) the distance along the axes is noise.
    if np.linalg.eigvalsh(system)[0] > 1e-3:
        point = np.linalg.solve(system, (projectors @ centers[:, :, None]).mean(0)[:, 0])
        if np.mean(np.sum((point - centers) * axes, axis=1) > 0) > 0.5:
            return point
    middle = centers.mean(0)
    reach = float(np.linalg.norm(centers - middle, axis=1).max()) or 1.0
    return middle + 4.0 * reach * axes.mean(0)


def _share_of_views(
    points: np.ndarray, rotations: np.ndarray, centers: np.ndarray, cameras: Sequence[Camera]
) -> np.ndarray:
    """Share [P] of the cameras in whose image a point [P, 3] falls."""
    seen = np.zeros(len(points))
    for rotation, center, camera in zip(rotations, centers, cameras, strict=True):
        x, y, w = camera.K.double().numpy() @ rotation @ (points - center).T
        seen += (w > 0) & (x >= 0) & (x < camera.width * w) & (y >= 0) & (y < camera.height * w)
    return seen / len(cameras)
