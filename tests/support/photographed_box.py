"""A box with known colours, photographed with known exposures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import pixel_rays
from beags_plugin.surfaces.color import srgb_from_linear
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo

VOXEL = 0.02
EXPOSURES = np.array([0.7, 0.9, 1.0, 1.1, 1.3, 1.05])


def light_at(points: np.ndarray) -> np.ndarray:
    """Light of each place, between 0.2 and 0.6."""
    return 0.4 + 0.2 * np.sin(9.0 * points + np.array([0.0, 1.0, 2.0]))


def a_box(bottom: bool = True) -> Mesh:
    """A box of side 0.8 about the origin in small triangles, of a wrong, even colour."""
    import trimesh

    box = trimesh.creation.box((0.8, 0.8, 0.8))
    for _ in range(4):
        box = box.subdivide()
    faces, vertices = np.array(box.faces), np.array(box.vertices)
    if not bottom:
        faces = faces[(vertices[faces][:, :, 2] > -0.39).any(axis=1)]
    return Mesh(vertices, faces, np.full((len(vertices), 3), 0.9, np.float32), VOXEL)


def camera_from(eye: tuple[float, float, float], size: int = 160) -> Camera:
    forward = -np.array(eye) / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1.0]])
    return Camera(torch.from_numpy(viewmat).float(), K, size, size)


def photo_of(
    mesh: Mesh,
    camera: Camera,
    exposure: float = 1.0,
    screen: bool = False,
    light: Callable[[np.ndarray], np.ndarray] = light_at,
    rays: int = 1,
) -> Photo:
    """Photograph the mesh; screen: something red stands before its left half. light: [P, 3] of places [P, 3].

    rays: along a side of each pixel, whose light is their mean.
    """
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    fine = Camera(
        camera.viewmat, camera.K * torch.tensor([[rays], [rays], [1.0]]), rays * camera.width, rays * camera.height
    )
    ways = (pixel_rays(fine, torch.zeros(1)).reshape(-1, 3) @ camera.rotation).numpy()
    origin = camera.center.numpy()
    t = scene.cast_rays(tensor(np.concatenate([np.broadcast_to(origin, ways.shape), ways], axis=1)))["t_hit"].numpy()
    hit = np.isfinite(t)
    shown = np.zeros((len(t), 3))
    shown[hit] = exposure * light(origin + ways[hit] * t[hit, None])
    shape = (camera.height, rays, camera.width, rays)
    image = torch.from_numpy(srgb_from_linear(shown.reshape(*shape, 3).mean(axis=(1, 3)))).float()
    middle = slice(rays // 2, None, rays)
    depth = torch.from_numpy(np.where(hit, t, 0.0).reshape(shape[0] * rays, -1)[middle, middle]).float()
    own = torch.from_numpy(hit.reshape(shape).all(axis=(1, 3)))
    if screen:  # the mask says nothing of it, the depth does
        image[:, : camera.width // 2] = torch.tensor([1.0, 0.0, 0.0])
        depth[:, : camera.width // 2] = 1.0
    return Photo(camera, lambda: image, lambda: own, lambda: depth)


EYES = [(2, 1, 1.5), (-1, 2, 1.2), (-2, -1, 1.5), (1, -2, 1.3), (1.5, 1.6, 2.0), (-1.2, -1.5, 1.9)]
