"""Close surfaces with holes by their winding numbers on a voxel grid.

The winding number of an open surface is 1/2 on a flat disc that would close a flat hole, and on a smooth sheet across
any other hole, so its level 1/2 closes all holes at once, for any mesh (Jacobson et al., "Robust inside-outside
segmentation using generalized winding numbers", 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.surface import area_vectors, corner_weights, in_voxels, surface_of

MOST_CELLS = 128
"""Largest number of cells along the longest side; the Fourier transform of twice as many takes about half a GB."""
_MARGIN = 4  # cells around the surface
_NEAR = 1.5  # distance in cells from the given surface below which a vertex is moved onto it; others are invented
_ONTO = 0.95  # share of the way to the surface; the whole way would merge vertices at a rim
_LEVEL = 0.5
_KEPT = 0.5  # least share of the given surface that is near the closed one; below it, only crumbs are enclosed


@dataclass(frozen=True)
class Closed:
    """A closed mesh of at least one face; invented: [V] bool, vertices that no view showed."""

    mesh: Mesh
    invented: np.ndarray

    def invented_at(self, points: np.ndarray) -> np.ndarray:
        """Return [P] bool, whether the surface is invented where it is nearest to points [P, 3]."""
        return _nearest(self.mesh, points, self.invented[:, None])[1][:, 0] > 0.5


def closed(mesh: Mesh) -> Closed | None:
    """Return the closed surface of the space that a mesh of at least one face encloses, with smooth sheets over holes.

    Vertices near the mesh lie on it and have its colours. The others get theirs by harmonic interpolation, so that
    closed holes are coloured from their rims. Walls thinner than a cell, which is the mesh's voxel or a 128th of its
    longest side, may be lost. Returns None if the mesh encloses hardly anything, as a flat sheet does.
    """
    from skimage.measure import marching_cubes

    low = mesh.vertices.min(axis=0)
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    cell = max(mesh.voxel, longest / MOST_CELLS)
    low = low - _MARGIN * cell
    shape = tuple(math.ceil(side / cell) + 2 * _MARGIN + 1 for side in np.ptp(mesh.vertices, axis=0))
    winding = np.pad(_winding_numbers(mesh, low, cell, shape), 1)  # The border of zeros keeps the surface closed.
    if not winding.max() > _LEVEL:
        return None
    vertices, faces, _, _ = marching_cubes(winding, _LEVEL, gradient_direction="ascent", allow_degenerate=False)
    if not len(faces):
        return None
    places = low + (vertices.astype(np.float64) - 1.0) * cell
    nearest, colors = _nearest(mesh, places, mesh.colors)
    near = np.linalg.norm(nearest - places, axis=1) < _NEAR * cell
    places[near] += _ONTO * (nearest[near] - places[near])
    faces = faces.astype(np.int64)
    back, _ = _nearest(Mesh(places, faces, colors, mesh.voxel), mesh.vertices, colors)
    if (np.linalg.norm(back - mesh.vertices, axis=1) < _NEAR * cell).mean() < _KEPT:
        return None
    return Closed(Mesh(places, faces, _from_rims(faces, colors, near), mesh.voxel), ~near)


def _from_rims(faces: np.ndarray, colors: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return [V, 3] float32: the colours of ``given`` [V] bool vertices; the others have the mean of their neighbours.

    Vertices that are connected to no given one keep their colours.
    """
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import spsolve

    count = len(given)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([edges, edges[:, ::-1]])
    linked: Any = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    _, part = connected_components(linked, directed=False)
    free = ~given & (np.bincount(part, given) > 0)[part]
    if not free.any():
        return colors
    laplacian: Any = diags_array(linked.sum(axis=1)) - linked
    rows = laplacian.tocsr()[free]
    solution: Any = spsolve(rows[:, free].tocsc(), -(rows[:, ~free] @ colors[~free].astype(np.float64)))
    colors = colors.copy()
    colors[free] = np.clip(np.reshape(solution, (-1, 3)), 0.0, 1.0)
    return colors


def _winding_numbers(mesh: Mesh, low: np.ndarray, cell: float, shape: tuple[int, ...]) -> np.ndarray:
    """Return winding numbers [X, Y, Z] float32 at the corners of cells, the first of which is low [3].

    Each face is a dipole, distributed over the corners of its cell; the sum over all dipoles is a convolution.
    """
    from scipy.fft import fft, ifft, irfft, next_fast_len, rfft

    at = (mesh.vertices[mesh.faces].mean(axis=1) - low) / cell
    first = np.floor(at).astype(np.int64)
    part, strength = at - first, area_vectors(mesh) / cell**2
    corners = list(np.ndindex(2, 2, 2))
    shares = np.stack([np.prod(np.where(corner, part, 1.0 - part), axis=1) for corner in corners])
    flat = np.stack([np.ravel_multi_index(tuple((first + corner).T), shape) for corner in corners])
    half: Any = tuple(next_fast_len(side, real=True) for side in shape)
    places = [np.arange(2 * side) for side in half[:2]]
    mirrored = [np.minimum(place, 2 * side - place) for place, side in zip(places, half, strict=False)]
    total: Any = 0.0
    for axis in range(3):
        dipoles = np.bincount(flat.ravel(), (shares * strength[:, axis]).ravel(), math.prod(shape))
        # One axis after the other: most lines of the padded grid are empty at first, and not needed in the end.
        transform: Any = rfft(dipoles.reshape(shape).astype(np.float32), 2 * half[2], axis=2)
        transform = fft(fft(transform, 2 * half[1], axis=1), 2 * half[0], axis=0)
        kernel = _kernel_transform(half, axis)[np.ix_(*mirrored)]
        if axis < 2:  # It is odd along its own axis.
            kernel *= np.expand_dims(np.where(places[axis] > half[axis], -1.0, 1.0), tuple({0, 1, 2} - {axis}))
        total = total + transform * kernel
    total = ifft(-1j * total, axis=0)
    total = ifft(total[: shape[0]], axis=1)
    numbers: Any = irfft(total[:, : shape[1]], 2 * half[2], axis=2)
    return numbers[:, :, : shape[2]]


def _kernel_transform(half: tuple[int, ...], axis: int) -> np.ndarray:
    """Return the Fourier transform of the field of a dipole along ``axis`` on a periodic grid, divided by -i.

    half: half the places along each side. The field is odd along its axis and even along the others, so that sine and
    cosine transforms of an eighth of the grid give an eighth of the frequencies, [half + 1] float32; the rest mirrors
    them. The field steps lead from the point to the dipole, and a dipole has no effect at its own position.
    """
    from scipy.fft import dct, dst

    steps: Any = np.meshgrid(*(np.arange(side + 1, dtype=np.float32) for side in half), indexing="ij", sparse=True)
    squared: Any = sum(step * step for step in steps)
    squared[0, 0, 0] = np.inf
    found: Any = -steps[axis] / (4.0 * np.pi * squared * np.sqrt(squared))
    for each in range(3):
        if each != axis:
            found = dct(found, type=1, axis=each)
        else:
            inner = (slice(None),) * axis + (slice(1, -1),)
            found[inner] = dst(found[inner], type=1, axis=axis)
            found[(slice(None),) * axis + ([0, -1],)] = 0.0
    return found


def _nearest(mesh: Mesh, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [P, 3] of a mesh nearest to points [P, 3], and its vertices' values [V, d] there, float32."""
    closest = surface_of(mesh).compute_closest_points(in_voxels(mesh, points))
    corners = mesh.faces[closest["primitive_ids"].numpy().astype(np.int64)]
    weights = corner_weights(closest["primitive_uvs"].numpy())
    places, interpolated = (np.einsum("pc,pcd->pd", weights, each[corners]) for each in (mesh.vertices, values))
    return places, interpolated.astype(np.float32)
