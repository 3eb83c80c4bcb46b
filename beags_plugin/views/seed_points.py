"""Seed points of training, read from a file or sampled where the cameras look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.data.dataset import ColmapModel, Dataset, PoseTable
from beags_plugin.data.layouts.colmap import points_file
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.reading.ply import read_ply_points
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.colmap_files import read_colmap_points
from beags_plugin.views.poses import PosedViews

SEED = 0  # seed of the sampling
# Distance, over the cameras' extent, beyond which points count only if a photo shows them, and beyond which never.
_FAR, _TOO_FAR = 100.0, 1e4


def starting_points(scene: Dataset, views: PosedViews, count: int) -> dict[str, Any]:
    """Return the seed points of a scene in the world of its cameras, or ``count`` sampled ones if it has none.

    Returns ``points3D_xyz`` [P, 3] float32, ``points3D_rgb`` [P, 3] uint8, and ``points3D_random``, whether they are
    sampled. If the poses give depths, points are sampled between them, and those of a file are used only if they lie
    between them. Raises ``UserError`` for a file that cannot be read.
    """
    cameras = [camera_from_nerfstudio(views.cameras, index) for index in range(len(views.images))]
    bounds = scene.poses.bounds if isinstance(scene.poses, PoseTable) else None
    scale = views.placing.scale
    file = scene.seed_points or views.points
    if isinstance(scene.poses, ColmapModel):
        file = file or points_file(scene.poses.folder)
    if file is not None:
        points, colors = _read(file)
        moved = views.placing.points(points, original=isinstance(scene.poses, ColmapModel))
        there = _seen_by_any(moved.numpy(), cameras)
        if bounds is not None:
            there = _within_bounds(moved.numpy(), cameras, scale * bounds) > 0.9
        if len(points) and there:
            if views.placing.origin is not None and (torn := _torn(points)) is not None:
                say(f"The seed points {file} are {torn}: export them in double precision, or in local coordinates.")
            return {"points3D_xyz": moved, "points3D_rgb": torch.from_numpy(colors), "points3D_random": False}
        if len(points):
            say(f"{file} is not used, because its points do not lie where the cameras look.")
    if bounds is None:
        xyz, rgb = random_points(cameras, count)
    else:
        xyz, rgb = points_between(cameras, scale * bounds, count)
    return {"points3D_xyz": torch.from_numpy(xyz), "points3D_rgb": torch.from_numpy(rgb), "points3D_random": True}


def _read(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [N, 3] float64 and colours [N, 3] uint8 of a file, without points that are no numbers.

    Raises ``UserError`` for another kind of file, and if all its points are no numbers.
    """
    if file.suffix.lower() == ".ply":
        points, colors = read_ply_points(file)
    elif file.suffix.lower() in (".bin", ".txt") or not file.is_file():
        points, colors = read_colmap_points(file)
    else:
        raise UserError(
            f"the seed points {file} have a format that cannot be read: save them as a .ply, and name that in "
            "ply_file_path."
        )
    known = np.isfinite(points).all(axis=1)
    if known.all():
        return points, colors
    if not known.any():
        raise UserError(f"the seed points {file} are no numbers: export them again, or remove the key.")
    say(f"{np.count_nonzero(~known)} of the {len(points)} seed points in {file} are no numbers: they are left out.")
    return points[known], colors[known]


def random_points(cameras: Sequence[Camera], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample points uniformly in a ball around ``_point_of_interest``.

    Its radius is half the cameras' median distance from that point. Points are used if at least half of the views see
    them, or, where frusta overlap less, as many as see the best tenth. Returns positions [count, 3] float32 and colours
    [count, 3] uint8, mid-grey.
    """
    rotations, centers = _poses(cameras)
    focus = _point_of_interest(rotations, centers)
    radius = 0.5 * float(np.median(np.linalg.norm(centers - focus, axis=1)))
    generator = np.random.default_rng(SEED)
    batch = 1 << 14

    def sample() -> tuple[np.ndarray, np.ndarray]:
        directions = generator.normal(size=(batch, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = focus + radius * directions * np.cbrt(generator.uniform(size=(batch, 1)))
        return points, _share_of_views(points, rotations, centers, cameras)

    return _seen_by_many(sample, count)


def points_between(cameras: Sequence[Camera], bounds: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample points within the cameras' depths, uniform in each image and in inverse depth.

    bounds: [V, 2] nearest and farthest depth of each view. Points are chosen and returned as in ``random_points``.
    """
    rotations, centers = _poses(cameras)
    to_rays = np.stack([np.linalg.inv(camera.K.double().numpy()) for camera in cameras])
    sizes = np.array([(camera.width, camera.height) for camera in cameras], float)
    generator = np.random.default_rng(SEED)

    def sample() -> tuple[np.ndarray, np.ndarray]:
        view = generator.integers(len(cameras), size=1 << 14)
        pixel = np.append(generator.uniform(size=(len(view), 2)) * sizes[view], np.ones((len(view), 1)), axis=1)
        near, far = bounds[view].T
        depth = 1.0 / (1.0 / far + generator.uniform(size=len(view)) * (1.0 / near - 1.0 / far))
        local = np.einsum("nij,nj->ni", to_rays[view], pixel) * depth[:, None]
        points = np.einsum("nji,nj->ni", rotations[view], local) + centers[view]
        return points, _share_of_views(points, rotations, centers, cameras)

    return _seen_by_many(sample, count)


def _poses(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations [V, 3, 3], world to camera, and the centres [V, 3]; float64."""
    rotations = np.stack([camera.rotation.double().numpy() for camera in cameras])
    return rotations, np.stack([camera.center.double().numpy() for camera in cameras])


def _seen_by_many(sample: Callable[[], tuple[np.ndarray, np.ndarray]], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` of the sampled points that many views see. sample: returns points and their shares of views."""
    points, share = sample()
    threshold = min(0.5, float(np.quantile(share, 0.9)))
    chosen = [points[share >= threshold]]
    while sum(map(len, chosen)) < count:
        points, share = sample()
        chosen.append(points[share >= threshold])
    xyz = np.concatenate(chosen)[:count].astype(np.float32)
    return xyz, np.full((count, 3), 128, np.uint8)


def _within_bounds(points: np.ndarray, cameras: Sequence[Camera], bounds: np.ndarray) -> float:
    """Return the share of points [P, 3] in some view's image and, within a tenth, its depths (bounds [V, 2])."""
    within = np.zeros(len(points), bool)
    for camera, (near, far) in zip(cameras, bounds, strict=True):
        local = (points - camera.center.double().numpy()) @ camera.rotation.double().numpy().T
        x, y, w = camera.K.double().numpy() @ local.T
        inside = (x >= 0) & (x < camera.width * w) & (y >= 0) & (y < camera.height * w)
        within |= inside & (w > 0.9 * near) & (w < 1.1 * far)
    return float(within.mean()) if len(points) else 0.0


def _seen_by_any(points: np.ndarray, cameras: Sequence[Camera]) -> bool:
    """Return whether points [P, 3] may belong to the scene: some lie near the cameras, or in an image."""
    rotations, centers = _poses(cameras)
    middle = centers.mean(0)
    reach = float(np.linalg.norm(centers - middle, axis=1).max()) or 1.0
    away = np.linalg.norm(points - middle, axis=1)
    if not len(points) or (away < _FAR * reach).any():
        return True
    some = points[away < _TOO_FAR * reach]
    some = some[:: max(1, len(some) // 2000)]
    return bool((_share_of_views(some, rotations, centers, cameras) > 0).any())


def _torn(points: np.ndarray) -> str | None:
    """Return a description of points [P, 3] float64 that were written in single precision, else None."""
    if not np.array_equal(points, points.astype(np.float32)):
        return None
    step = float(np.spacing(np.float32(np.abs(points).max())))
    return f"in single precision, which at such coordinates has steps of {step:g}"


def _point_of_interest(rotations: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the point [3] closest to all optical axes in the least-squares sense.

    If the axes are almost parallel, or the point lies behind half of the cameras, as for views that look outwards, it
    is instead a point in front of the cameras' mean, at 4 times the radius of the set of cameras.
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
    """Return the share [P] of the cameras in whose image each point [P, 3] falls."""
    seen = np.zeros(len(points))
    for rotation, center, camera in zip(rotations, centers, cameras, strict=True):
        x, y, w = camera.K.double().numpy() @ rotation @ (points - center).T
        seen += (w > 0) & (x >= 0) & (x < camera.width * w) & (y >= 0) & (y < camera.height * w)
    return seen / len(cameras)
