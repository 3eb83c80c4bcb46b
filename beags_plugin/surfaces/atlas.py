"""Unwrap a mesh: its charts in a square image (xatlas), and the place on the mesh that each texel shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.surface import corner_weights
from beags_plugin.system.open3d_kernels import open3d_kernels

GAP = 2  # texels between charts, which are filled with the colours of the nearest texel in a chart
SMALLEST = 128  # least side of an image whose size is chosen here
_LEAST = 0.8  # least share of the required side, so that a small excess does not double the power of two
_RAYS = 1 << 17  # texels that are looked up at a time


@dataclass(frozen=True)
class Atlas:
    """A mesh cut along seams.

    source: [W] int64, the mesh's vertex of each vertex of the atlas. faces: [F, 3] int64. uv: [W, 2] float64, 0..1 from
    the left and from the top of the image, as in glTF. size: side of the image in texels.
    """

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    size: int


@dataclass(frozen=True)
class Texels:
    """The T texels whose centre lies in a chart: rows, columns [T] int32, and their places on the mesh.

    faces: [T] int32, the rows of ``corners`` [F, 3] int64, the mesh's vertices. uvs: [T, 2] float32, Open3D's
    coordinates in the face.
    """

    rows: np.ndarray
    columns: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    corners: np.ndarray

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return [T, d] float64, ``values`` [V, d] of the mesh's vertices interpolated."""
        result = np.empty((len(self.faces), values.shape[1]))
        for first in range(0, len(result), _RAYS):
            part = slice(first, first + _RAYS)
            of_corners = values[self.corners[self.faces[part]]]
            np.einsum("tc,tcd->td", corner_weights(self.uvs[part]), of_corners, out=result[part])
        return result


def unwrapped(mesh: Mesh, size: int, density: float = 0.0) -> Atlas:
    """Cut a mesh of at least one face into charts and pack them into an image of ``size`` x ``size`` texels.

    density: texels per unit of the mesh. The image's side is then a power of two, at most ``size``, that gives 0.8 to
    1.6 times as many. 0 fills the image. Many small charts leave most of an image to the gaps between them, so its size
    alone does not determine the density.
    """
    import xatlas

    places = (mesh.vertices - mesh.vertices.mean(axis=0)) / mesh.voxel
    pack = xatlas.PackOptions()
    pack.padding, pack.bilinear, pack.create_image = GAP, True, False
    pack.resolution, pack.texels_per_unit = (0, density * mesh.voxel) if density else (size, 0.0)
    atlas = xatlas.Atlas()
    atlas.add_mesh(places.astype(np.float32), mesh.faces.astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack)
    source, faces, uv = atlas[0]
    side = max(atlas.width, atlas.height, 1)  # xatlas may exceed the size slightly, or return 0 without area.
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
    columns, height = np.arange(atlas.size) + 0.5, max(1, _RAYS // atlas.size)
    strips = []
    for first in range(0, atlas.size, height):
        rows = np.arange(first, min(first + height, atlas.size)) + 0.5
        rays = np.zeros((len(rows), len(columns), 6), np.float32)
        rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = columns, rows[:, None], 1.0, -1.0
        hit = scene.cast_rays(tensor(rays))
        in_chart = np.isfinite(hit["t_hit"].numpy())
        row, column = np.nonzero(in_chart)
        face, uvs = hit["primitive_ids"].numpy()[in_chart], hit["primitive_uvs"].numpy()[in_chart]
        strips.append(((row + first).astype(np.int32), column.astype(np.int32), face.astype(np.int32), uvs))
    row, column, face, uvs = (np.concatenate(each) for each in zip(*strips, strict=True))
    return Texels(row, column, face, uvs, atlas.source[atlas.faces])


def picture(atlas: Atlas, at: Texels, colors: np.ndarray) -> np.ndarray:
    """Return the image [size, size, 3] uint8 of colours [T, 3] in 0..1; between charts, that of the nearest texel.

    The filled gaps keep seams invisible when the image is interpolated or made smaller.
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
