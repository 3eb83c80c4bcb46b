"""Things of the sample's still life covered with small opaque discs: splats whose exact surface is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.lifting import pixel_rays
from beags_plugin.core.surfels import Surfels
from beags_plugin.sample.arrangement import make_still
from beags_plugin.sample.scene import Thing
from beags_plugin.sample.solids import Solid
from beags_plugin.sample.views import View
from beags_plugin.surfaces.close_up import close_up

C0 = 0.28209479177387814  # the constant spherical harmonic


def thing_called(name: str) -> Thing[Solid]:
    return next(thing for thing in make_still(1).things if thing.name == name)


def camera_of(view: View) -> Camera:
    K = torch.tensor([[view.focal, 0, view.cx], [0, view.focal, view.cy], [0, 0, 1]]).float()
    return Camera(viewmat_from_opengl(torch.from_numpy(view.camera_to_world)).float(), K, view.width, view.height)


def hits(thing: Thing[Solid], camera: Camera) -> np.ndarray:
    """Return world points of the thing's surface under the pixels of a view, [P, 3]; computed by ray casting."""
    rays = pixel_rays(camera, torch.zeros(1, dtype=torch.float64)).reshape(-1, 3).numpy()
    directions = rays @ camera.rotation.double().numpy()
    origin = camera.center.double().numpy()[None]
    t = thing.solid.first_hit(np.repeat(thing.to_local(origin), len(rays), axis=0), directions @ thing.rotation)
    return origin + directions[np.isfinite(t)] * t[np.isfinite(t), None]


def color_at(points: np.ndarray) -> np.ndarray:
    """Return a colour for each place, sRGB 0..1."""
    return 0.5 + 0.35 * np.sin(7.0 * points + np.array([0.0, 1.0, 2.0]))


def covered(thing: Thing[Solid], cameras: Sequence[Camera], radius: float = 0.003) -> Surfels:
    """Cover the thing evenly with small opaque discs where the views see it, in ``color_at``'s colours.

    radius: one sigma of a disc; there is one in each cube of this size, and a bit, that the surface passes through.
    """
    low, high = torch.from_numpy(thing.position - 0.25), torch.from_numpy(thing.position + 0.25)
    points = np.concatenate([hits(thing, close_up(camera, low, high, 0.05, 160)) for camera in cameras])
    points = points[np.random.default_rng(0).permutation(len(points))]
    _, first = np.unique(np.floor(points / (1.3 * radius)), axis=0, return_index=True)
    points = points[np.sort(first)]
    normals = thing.solid.normals(thing.to_local(points)) @ thing.rotation.T
    # the rotation that takes z to the normal: half way between them, turned by 180 degrees
    half = torch.nn.functional.normalize(torch.from_numpy(normals) + torch.tensor([1e-6, 0.0, 1.0]), dim=1)
    count = len(points)
    return Surfels.of(
        torch.from_numpy(points).float(),
        torch.cat([torch.zeros(count, 1), half.float()], dim=1),
        torch.full((count, 2), float(np.log(radius))),
        torch.full((count,), 4.0),
        torch.from_numpy((color_at(points) - 0.5) / C0).float()[:, None],
    )
