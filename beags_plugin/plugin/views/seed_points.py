"""Points from which training starts: read from a file, or drawn where the cameras look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from beags_plugin.core.cameras import Camera
from beags_plugin.data.dataset import Dataset, PoseTable
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.colmap_files import read_colmap_points
from beags_plugin.system.reading.ply import read_ply_points

if TYPE_CHECKING:
    from beags_plugin.plugin.views.poses import PosedViews

SEED = 0
"""Of the points that are drawn where the data brings none."""


def starting_points(scene: Dataset, views: PosedViews, count: int) -> dict[str, Any]:
    """The seed points of a scene in the world of its cameras, or ``count`` drawn ones where it has none.

    Returns ``points3D_xyz`` [P, 3] float32, ``points3D_rgb`` [P, 3] uint8 and ``points3D_random``, whether they are
    drawn: between the depths that the poses come with, if they do. Points of a file are taken only if they are where
    these depths say. Raises ``UserError`` for a file that cannot be read.
    """
    given = views.outputs.metadata
    found = {name: given.get(name) for name in ("points3D_xyz", "points3D_rgb")}
    cameras = [camera_from_nerfstudio(views.cameras, index) for index in range(len(views.images))]
    bounds = scene.poses.bounds if isinstance(scene.poses, PoseTable) else None
    scale = views.outputs.dataparser_scale
    if scene.seed_points is not None:
        reader = read_ply_points if scene.seed_points.suffix == ".ply" else read_colmap_points
        points, colors = reader(scene.seed_points)
        transform = views.outputs.dataparser_transform
        moved = (torch.from_numpy(points) @ transform[:, :3].T + transform[:, 3]) * scale
        if bounds is None or _within_bounds(moved.numpy(), cameras, scale * bounds) > 0.9:
            found = {"points3D_xyz": moved, "points3D_rgb": torch.from_numpy(colors)}
        else:
            CONSOLE.print(f"{scene.seed_points} is not used: its points do not lie where the poses look.", markup=False)
    if found["points3D_xyz"] is not None and len(found["points3D_xyz"]) > 0:
        return {**found, "points3D_random": False}
    if bounds is None:
        xyz, rgb = random_points(cameras, count)
    else:
        xyz, rgb = points_between(cameras, scale * bounds, count)
    return {"points3D_xyz": torch.from_numpy(xyz), "points3D_rgb": torch.from_numpy(rgb), "points3D_random": True}


def random_points(cameras: Sequence[Camera], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the cameras' common view, for scenes without seed points.

    Drawn uniformly in the ball around the cameras' point of interest (see ``_point_of_interest``) whose radius is half
    the cameras' median distance from it, and kept where at least half of the views see them (or as many views as
    see the best tenth, where frusta overlap less than that).

    Returns positions [count, 3] float32 and colours [count, 3] uint8, mid-grey.
    """
    rotations = np.stack([camera.rotation.double().numpy() for camera in cameras])
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    focus = _point_of_interest(rotations, centers)
    radius = 0.5 * float(np.median(np.linalg.norm(centers - focus, axis=1)))
    generator = np.random.default_rng(SEED)
    batch = 1 << 14

    def draw() -> tuple[np.ndarray, np.ndarray]:
        directions = generator.normal(size=(batch, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = focus + radius * directions * np.cbrt(generator.uniform(size=(batch, 1)))
        return points, _share_of_views(points, rotations, centers, cameras)

    return _seen_by_many(draw, count)


def points_between(cameras: Sequence[Camera], bounds: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the cameras' common view and within their depths, uniform in each image and in inverse depth.

    bounds: [V, 2] nearest and farthest depth of each view. Kept are points that at least half of the views see (or as
    many as see the best tenth). Returns positions [count, 3] float32 and colours [count, 3] uint8, mid-grey.
    """
    rotations = np.stack([camera.rotation.double().numpy() for camera in cameras])
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    to_rays = np.stack([np.linalg.inv(camera.K.double().numpy()) for camera in cameras])
    sizes = np.array([(camera.width, camera.height) for camera in cameras], float)
    generator = np.random.default_rng(SEED)

    def draw() -> tuple[np.ndarray, np.ndarray]:
        view = generator.integers(len(cameras), size=1 << 14)
        pixel = np.append(generator.uniform(size=(len(view), 2)) * sizes[view], np.ones((len(view), 1)), axis=1)
        near, far = bounds[view].T
        depth = 1.0 / (1.0 / far + generator.uniform(size=len(view)) * (1.0 / near - 1.0 / far))
        local = np.einsum("nij,nj->ni", to_rays[view], pixel) * depth[:, None]
        points = np.einsum("nji,nj->ni", rotations[view], local) + centers[view]
        return points, _share_of_views(points, rotations, centers, cameras)

    return _seen_by_many(draw, count)


def _seen_by_many(draw: Callable[[], tuple[np.ndarray, np.ndarray]], count: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` of the points that ``draw`` gives with their share of views, those of large share; mid-grey colours."""
    points, share = draw()
    threshold = min(0.5, float(np.quantile(share, 0.9)))
    kept = [points[share >= threshold]]
    while sum(map(len, kept)) < count:
        points, share = draw()
        kept.append(points[share >= threshold])
    xyz = np.concatenate(kept)[:count].astype(np.float32)
    return xyz, np.full((count, 3), 128, np.uint8)


def _within_bounds(points: np.ndarray, cameras: Sequence[Camera], bounds: np.ndarray) -> float:
    """Share of the points [P, 3] that some view has in its image and within its depths [V, 2], give or take a tenth."""
    found = np.zeros(len(points), bool)
    for camera, (near, far) in zip(cameras, bounds, strict=True):
        local = (points - camera.center.double().numpy()) @ camera.rotation.double().numpy().T
        x, y, w = camera.K.double().numpy() @ local.T
        inside = (x >= 0) & (x < camera.width * w) & (y >= 0) & (y < camera.height * w)
        found |= inside & (w > 0.9 * near) & (w < 1.1 * far)
    return float(found.mean()) if len(points) else 0.0


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
