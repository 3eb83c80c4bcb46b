"""A surface from an object's own depth: truncated signed distances of many views, averaged in a sparse voxel grid.

Open3D's ``VoxelBlockGrid`` fuses; this module chooses the voxels and renders the views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import hides, lift, project
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth, surfel_inputs
from beags_plugin.surfaces.close_up import close_up
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.surfaces.item import Viewpoints
from beags_plugin.system.open3d_kernels import open3d_kernels

BLOCK = 16
"""Voxels along a side of the blocks that Open3D allocates as a whole."""
FEWEST, MOST, VOXELS_PER_PIXEL = 48, 128, 1.25
"""Voxels along the longest side of an object by default."""
PIXELS_PER_VOXEL = 2
"""Resolution of the renders: discs smaller than a pixel are rendered a pixel wide, too near on slanted surfaces."""
_VOXEL_BYTES = 20  # distance, weight and three colours, float32 each
_STRIDE = 4  # Open3D searches blocks at every fourth pixel.
_SOLID = 0.5  # least alpha at which the median depth exists


@dataclass(frozen=True)
class Mesh:
    """Triangles with a colour per vertex.

    vertices: [V, 3] float64, world units. faces: [F, 3] int64, counter-clockwise from outside.
    colors: [V, 3] float32, 0..1, as in the photos (sRGB). voxel: side of the voxels it was made from, world units.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    voxel: float


def voxel_size(low: Tensor, high: Tensor, resolution: int, truncation: float, memory_mb: float) -> float:
    """Return the longest side over ``resolution``, or more where the grid might need more than ``memory_mb``.

    The bound counts every block that the box and the truncation around it touch, as if all were filled; a surface
    fills a small part of them. low, high: [3], world units. Returns world units.
    """
    sides = (high - low).double()
    voxel = float(sides.max()) / resolution
    while _grid_mb(sides, voxel, truncation) > memory_mb:
        voxel *= 1.05
    return voxel


def _grid_mb(sides: Tensor, voxel: float, truncation: float) -> float:
    # Two more blocks: the box starts and ends anywhere in one.
    blocks = math.prod(math.ceil(float(side) / voxel / BLOCK + 2 * truncation / BLOCK) + 2 for side in sides)
    return blocks * BLOCK**3 * _VOXEL_BYTES / 1e6


def suitable_resolution(surfels: Surfels, cameras: Sequence[Camera]) -> int:
    """Return voxels along the longest side of a box: ``VOXELS_PER_PIXEL`` in the photo that shows it largest.

    Finer voxels would cost time and hold no more detail than the photos. cameras: those of the photos, not close-ups.
    """
    low, high = bounding_box(surfels)
    middle, side = (low + high)[None] / 2, float((high - low).max())
    depths = (float(project(middle, camera.to(torch.float64))[1]) for camera in cameras)
    pixels = [side * camera.focal / z for camera, z in zip(cameras, depths, strict=True) if z > side / 2]
    return MOST if not pixels else min(MOST, max(FEWEST, math.ceil(VOXELS_PER_PIXEL * max(pixels))))


@torch.no_grad()
def fuse(
    surfels: Surfels,
    views: Viewpoints,
    resolution: int,
    truncation: float,
    memory_mb: float,
    min_views: int,
    on_render: Callable[[int], None] = lambda done: None,
) -> Mesh:
    """Fuse the surface that at least ``min_views`` of the views show of an object rendered alone, or in its scene.

    surfels: N Gaussians, in the frame of the views. resolution: voxels along the longest side of their box; renders are
    close-ups of it, ``PIXELS_PER_VOXEL`` times as many pixels long. truncation: voxels on either side of the surface
    that a view changes. memory_mb: bound of the grid, 10^6 bytes. on_render: receives the number of views done. Returns
    a mesh, perhaps without faces, whose order does not depend on the number of threads.
    """
    low, high = bounding_box(surfels)
    if not bool((high > low).any()):
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32), 0.0)
    voxel = voxel_size(low, high, resolution, truncation, memory_mb)
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32), voxel)
    grid, seen = _new_grid(), False
    for done, camera in enumerate(views.cameras, start=1):
        close = close_up(camera, low, high, views.settings.near, PIXELS_PER_VOXEL * resolution)
        depth, color = _draw(surfels, close, views, low - truncation * voxel, high + truncation * voxel)
        if bool((depth > 0).any()):
            seen |= _integrate(grid, depth / voxel, color, _in_voxels(close, low, voxel), truncation)
        on_render(done)
    if not seen:  # Open3D raises an error for an empty grid.
        return nothing
    weight = min(min_views, len(views.cameras)) - 0.5
    mesh = grid.extract_triangle_mesh(weight_threshold=weight)
    if "positions" not in mesh.vertex or not len(mesh.vertex.positions):
        return nothing
    vertices = mesh.vertex.positions.numpy().astype(np.float64) * voxel + low.numpy()
    colors = np.clip(mesh.vertex.colors.numpy(), 0.0, 1.0)
    return sorted_mesh(Mesh(vertices, mesh.triangle.indices.numpy().astype(np.int64), colors, voxel))


def _new_grid() -> Any:
    """Return an empty ``VoxelBlockGrid`` of Open3D, whose unit is a voxel."""
    open3d = open3d_kernels()

    core = open3d.core
    return open3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=1.0,  # The scale of a scene then changes nothing.
        block_resolution=BLOCK,
        block_count=256,  # The grid grows.
        device=core.Device("CPU:0"),
    )


def _draw(surfels: Surfels, camera: Camera, views: Viewpoints, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Render median depth [H, W], 0 where alpha is low or outside the box low, high, and colour [H, W, 3]."""
    black = torch.zeros(3, dtype=surfels.means.dtype)
    render = views.rasterizer.rasterize(surfel_inputs(surfels, camera), camera, views.settings, black)
    own_depth = surface_depth(render, "median")
    points = lift(own_depth, camera)
    inside = ((points >= low) & (points <= high)).all(dim=-1) & (render.alpha > _SOLID)
    if views.scene is not None:
        whole = views.rasterizer.rasterize(geometry_inputs(views.scene), camera, views.settings, black)
        inside &= ~hides(surface_depth(whole, "median"), own_depth)
    depth = torch.where(inside, own_depth, 0.0)
    # Dividing by alpha removes the black background.
    return depth, (render.color / render.alpha.clamp(min=_SOLID)[..., None]).clamp(0.0, 1.0)


def _in_voxels(camera: Camera, low: Tensor, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (K [3, 3], viewmat [4, 4]) float64 of a camera in a world of origin ``low`` and unit ``voxel``.

    Open3D has pixel centres at whole numbers.
    """
    K, viewmat = camera.K.double().numpy().copy(), camera.viewmat.double().numpy().copy()
    K[:2, 2] -= 0.5
    viewmat[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ low.numpy()) / voxel
    return K, viewmat


def _integrate(grid: Any, depth: Tensor, color: Tensor, pose: tuple[np.ndarray, np.ndarray], truncation: float) -> bool:
    """Add a view to the grid; return whether that changed it."""
    open3d = open3d_kernels()

    K, viewmat = (open3d.core.Tensor(matrix) for matrix in pose)
    depth_image = open3d.t.geometry.Image(open3d.core.Tensor(depth.float().contiguous().numpy()))
    color_image = open3d.t.geometry.Image(open3d.core.Tensor(color.float().contiguous().numpy()))
    limit = float(depth.max()) + 1.0
    rows, columns = (_STRIDE * (side // _STRIDE) for side in depth.shape)  # Open3D reads no pixel beyond these.
    if not bool((depth[:rows:_STRIDE, :columns:_STRIDE] > 0).any()):
        return False  # Open3D would find no block in these few pixels, and raise an error.
    blocks = grid.compute_unique_block_coordinates(depth_image, K, viewmat, 1.0, limit, float(truncation))
    grid.integrate(blocks, depth_image, color_image, K, viewmat, 1.0, limit, float(truncation))
    return True


def sorted_mesh(mesh: Mesh) -> Mesh:
    """Return the mesh with vertices in the order of their positions and faces in that of their vertices.

    Determinism: Open3D's threads number both in any order.
    """
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[mesh.faces]
    first = faces.argmin(axis=1)  # Rotating each face to begin with its lowest vertex keeps its side.
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return Mesh(mesh.vertices[order], faces[np.lexsort(faces.T[::-1])], mesh.colors[order], mesh.voxel)


def without_small_parts(mesh: Mesh, share: float) -> Mesh:
    """Return the mesh without connected parts of fewer faces than ``share`` of the largest one's."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(mesh.faces):
        return mesh
    edges: Sequence[np.ndarray] = (mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]])
    rows, columns = np.concatenate(edges).T
    count = len(mesh.vertices)
    _, part = connected_components(coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(count, count)), False)
    sizes = np.bincount(part[mesh.faces[:, 0]], minlength=part.max() + 1)
    large = (sizes >= max(1.0, share * sizes.max()))[part]  # Vertices without faces are removed too.
    number = np.cumsum(large) - 1
    faces = mesh.faces[large[mesh.faces[:, 0]]]
    return Mesh(mesh.vertices[large], number[faces], mesh.colors[large], mesh.voxel)


def decimated(mesh: Mesh, most: int) -> Mesh:
    """Return the mesh with at most ``most`` faces: edges collapse where that moves the surface least."""
    if len(mesh.faces) <= most:
        return mesh
    open3d = open3d_kernels()

    origin = mesh.vertices.mean(axis=0)  # Quadrics lose digits far from the origin.
    full = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector((mesh.vertices - origin) / mesh.voxel),
        open3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
    )
    full.vertex_colors = open3d.utility.Vector3dVector(mesh.colors.astype(np.float64))
    few = full.simplify_quadric_decimation(most)  # Only this one of Open3D's two functions keeps colours.
    few.remove_unreferenced_vertices()
    vertices = np.asarray(few.vertices) * mesh.voxel + origin
    colors = np.asarray(few.vertex_colors, np.float32)
    return sorted_mesh(Mesh(vertices, np.asarray(few.triangles, np.int64), colors, mesh.voxel))
