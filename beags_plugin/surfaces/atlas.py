"""A mesh laid out flat: its charts in a square picture (xatlas), and which place of the mesh each texel shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.system.open3d_kernels import open3d_kernels

GAP = 2  # texels between charts; what is between them is filled with the colours of the nearest
SMALLEST = 128  # side of a picture that is as large as it needs to be
_LEAST = 0.8  # of the side that it needs, so that it need not be a power of two larger for little
_ROWS = 256  # of texels that are looked up at a time


@dataclass(frozen=True)
class Atlas:
    """A mesh cut along seams.

    source: [W] int64, the mesh's vertex of each vertex of the atlas. faces: [F, 3] int64. uv: [W, 2] float64, 0..1 from
    the left and from the top of the picture, as in glTF. size: side of the picture in texels.
    """

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    size: int


@dataclass(frozen=True)
class Texels:
    """The T texels whose middle lies in a chart: rows, columns [T] int64, and where they are on the mesh.

    corners: [T, 3] int64, the mesh's vertices of their face. weights: [T, 3] float64 of these.
    """

    rows: np.ndarray
    columns: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return [T, d] float64, ``values`` [V, d] of the mesh's vertices interpolated."""
        return np.einsum("tc,tcd->td", self.weights, values[self.corners])


def unwrapped(mesh: Mesh, size: int, density: float = 0.0) -> Atlas:
    """Cut a mesh of at least one face into charts and pack them into a picture of ``size`` x ``size`` texels.

    density: texels along a side of the mesh's unit, of which there may be 0.8 to 1.6 times as many in the power of two
    that such a picture has for its side, ``size`` at most; 0 fills the picture. With many small charts most of a
    picture is gaps between them, so that its size alone says little of its texels.
    """
    import xatlas

    atlas = xatlas.Atlas()
    places = (mesh.vertices - mesh.vertices.mean(axis=0)) / mesh.voxel
    atlas.add_mesh(places.astype(np.float32), mesh.faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.padding, pack.bilinear, pack.create_image = GAP, True, False
    pack.resolution, pack.texels_per_unit = (0, density * mesh.voxel) if density else (size, 0.0)
    atlas.generate(xatlas.ChartOptions(), pack)
    source, faces, uv = atlas[0]
    side = max(atlas.width, atlas.height, 1)  # xatlas may take a little more than it was asked to, or none: no area
    if density:
        whole = max(SMALLEST, 2 ** math.ceil(math.log2(_LEAST * side)))
        if whole > size:
            return unwrapped(mesh, size)
        size = whole
    uv = uv.astype(np.float64) * [atlas.width / side, atlas.height / side]
    return Atlas(source.astype(np.int64), faces.astype(np.int64), uv, size)


def texels(atlas: Atlas) -> Texels:
    """Return the texels of the charts, row by row."""
    open3d = open3d_kernels()

    scene, tensor = open3d.t.geometry.RaycastingScene(), open3d.core.Tensor
    flat = np.concatenate([atlas.size * atlas.uv, np.zeros((len(atlas.uv), 1))], axis=1)
    scene.add_triangles(tensor(flat.astype(np.float32)), tensor(atlas.faces.astype(np.uint32)))
    columns = np.arange(atlas.size) + 0.5
    found = []
    for first in range(0, atlas.size, _ROWS):
        rows = np.arange(first, min(first + _ROWS, atlas.size)) + 0.5
        rays = np.zeros((len(rows), len(columns), 6), np.float32)
        rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = columns, rows[:, None], 1.0, -1.0
        hit = scene.cast_rays(tensor(rays))
        there = np.isfinite(hit["t_hit"].numpy())
        row, column = np.nonzero(there)
        face = hit["primitive_ids"].numpy()[there].astype(np.int64)
        u, v = hit["primitive_uvs"].numpy()[there].astype(np.float64).T
        weights = np.stack([1.0 - u - v, u, v], axis=1)
        found.append((row + first, column, atlas.source[atlas.faces[face]], weights))
    return Texels(*(np.concatenate(each) for each in zip(*found, strict=True)))


def picture(atlas: Atlas, at: Texels, colors: np.ndarray) -> np.ndarray:
    """Return the picture [size, size, 3] uint8 of colours [T, 3] in 0..1; between charts, that of the nearest texel.

    So nothing shines through at seams when a picture is interpolated or made smaller.
    """
    from scipy.ndimage import distance_transform_edt

    image = np.zeros((atlas.size, atlas.size, 3), np.uint8)
    empty = np.ones(image.shape[:2], bool)
    image[at.rows, at.columns] = np.round(255.0 * np.clip(colors, 0.0, 1.0))
    empty[at.rows, at.columns] = False
    if empty.all():
        return image
    nearest: Any = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return image[tuple(nearest)]
