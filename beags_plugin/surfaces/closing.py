"""Closed surfaces: what a surface with holes encloses, by its winding numbers on a voxel grid.

The winding number of an open surface is 1/2 on a flat disc that would close a flat hole, and on a smooth sheet across
any other, so its level 1/2 closes all holes at once, whatever the mesh is like (Jacobson et al., "Robust inside-outside
segmentation using generalized winding numbers", 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.surface import area_vectors, in_voxels, surface_of

MOST_CELLS = 128
"""Along the longest side of the grid: its Fourier transform of twice as many takes about 1 GB."""
_MARGIN = 4  # cells around the surface; beyond them lies the outside
_NEAR = 1.5  # cells: what is nearer to the given surface is put onto it, what is farther off was invented
_ONTO = 0.95  # of the way: all of it puts several corners into one place of a rim, and files forget which is which
_LEVEL = 0.5
_KEPT = 0.5  # share of the given surface that the closed one keeps at least; less, and it encloses crumbs alone


@dataclass(frozen=True)
class Closed:
    """A closed mesh of at least one face; invented: [V] bool, vertices that no view showed."""

    mesh: Mesh
    invented: np.ndarray

    def invented_at(self, points: np.ndarray) -> np.ndarray:
        """Return [P] bool, whether the surface at its nearest to points [P, 3] is invented."""
        return _nearest(self.mesh, points, self.invented[:, None])[1][:, 0] > 0.5


def closed(mesh: Mesh) -> Closed | None:
    """Return the closed surface around what a mesh of at least one face encloses, holes spanned smoothly.

    Vertices near the mesh lie on it and have its colour there; from these the colours of the others are interpolated
    (harmonically), so that closed holes are coloured from their rims. Walls thinner than a cell, the mesh's voxel or a
    128th of its longest side, may be lost. None if the mesh encloses next to nothing, as a flat sheet does.
    """
    from skimage.measure import marching_cubes

    low = mesh.vertices.min(axis=0)
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    cell = max(mesh.voxel, longest / MOST_CELLS)
    low = low - _MARGIN * cell
    shape = tuple(math.ceil(side / cell) + 2 * _MARGIN + 1 for side in np.ptp(mesh.vertices, axis=0))
    winding = np.pad(_winding_numbers(mesh, low, cell, shape), 1)  # outside is 0: no surface ends at the border
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
    there, _ = _nearest(Mesh(places, faces, colors, mesh.voxel), mesh.vertices, colors)
    if (np.linalg.norm(there - mesh.vertices, axis=1) < _NEAR * cell).mean() < _KEPT:
        return None
    return Closed(Mesh(places, faces, _from_rims(faces, colors, near), mesh.voxel), ~near)


def _from_rims(faces: np.ndarray, colors: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return [V, 3] float32: colours of given [V] vertices as they are, each other one the mean of its neighbours.

    Vertices that hang together with no given one keep theirs.
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
    found: Any = spsolve(rows[:, free].tocsc(), -(rows[:, ~free] @ colors[~free].astype(np.float64)))
    colors = colors.copy()
    colors[free] = np.clip(np.reshape(found, (-1, 3)), 0.0, 1.0)
    return colors


def _winding_numbers(mesh: Mesh, low: np.ndarray, cell: float, shape: tuple[int, ...]) -> np.ndarray:
    """Return winding numbers [X, Y, Z] float32 at the corners of cells, low [3] the first.

    Faces are dipoles, shared out to the corners of their cells; the sum over all is a convolution.
    """
    from scipy.fft import irfftn, next_fast_len, rfftn

    dipoles = np.zeros((3, *shape), np.float32)
    at = (mesh.vertices[mesh.faces].mean(axis=1) - low) / cell
    first = np.floor(at).astype(np.int64)
    part, strength = at - first, area_vectors(mesh) / cell**2
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        flat = np.ravel_multi_index(tuple((first + corner).T), shape)
        for axis in range(3):
            dipoles[axis] += np.bincount(flat, share * strength[:, axis], math.prod(shape)).reshape(shape)
    size: Any = tuple(next_fast_len(2 * side - 1, real=True) for side in shape)
    steps: Any = np.meshgrid(*(np.fft.fftfreq(side, 1.0 / side).astype(np.float32) for side in size), indexing="ij")
    distance = np.sqrt(sum(step * step for step in steps))
    distance[0, 0, 0] = np.inf  # a dipole does nothing at its own place
    total: Any = 0.0
    for axis in range(3):
        kernel = -steps[axis] / (4.0 * np.pi * distance**3)  # of the way from the point to the dipole
        found: Any = rfftn(dipoles[axis], size)
        total = total + found * rfftn(kernel)
    numbers: Any = irfftn(total, size)
    return numbers[tuple(slice(side) for side in shape)]


def _nearest(mesh: Mesh, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [P, 3] on a mesh that are nearest to points [P, 3], and there the values [P, d] float32 that
    its vertices have [V, d]."""
    found = surface_of(mesh).compute_closest_points(in_voxels(mesh, points))
    face = found["primitive_ids"].numpy().astype(np.int64)
    u, v = found["primitive_uvs"].numpy().astype(np.float64).T
    corners = np.stack([1.0 - u - v, u, v], axis=1)
    places, there = (np.einsum("pc,pcd->pd", corners, each[mesh.faces[face]]) for each in (mesh.vertices, values))
    return places, there.astype(np.float32)
