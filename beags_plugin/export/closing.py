"""Closed surfaces for printing: what a surface with holes encloses, by its winding numbers on a voxel grid.

The winding number of an open surface is 1/2 on a flat disc that would close a flat hole, and on a smooth sheet across
any other, so its level 1/2 closes all holes at once, whatever the mesh is like (Jacobson et al., "Robust inside-outside
segmentation using generalized winding numbers", 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.export.fusion import Mesh
from beags_plugin.export.surface import area_vectors, in_voxels, surface_of

MOST_CELLS = 128
"""Along the longest side of the grid: its Fourier transform of twice as many takes about 1 GB."""
_MARGIN = 4  # cells around the surface; beyond them lies the outside
_NEAR = 1.5  # cells: what is nearer to the given surface is put onto it, what is farther off was invented
_LEVEL = 0.5


@dataclass(frozen=True)
class Closed:
    """A closed mesh; invented: [V] bool, vertices that no view showed."""

    mesh: Mesh
    invented: np.ndarray

    @property
    def invented_share(self) -> float:
        """Return the share of the area whose corners are all invented."""
        areas = np.linalg.norm(area_vectors(self.mesh), axis=1)
        return float(areas[self.invented[self.mesh.faces].all(axis=1)].sum() / max(areas.sum(), 1e-300))


def closed(mesh: Mesh) -> Closed:
    """Return the closed surface around what a mesh of at least one face encloses, holes spanned smoothly.

    Vertices near the mesh lie on it; all take the colour of the mesh's nearest point, so that closed holes are coloured
    from their rims. Walls thinner than a cell, the mesh's voxel or a 128th of its longest side, may be lost.
    """
    from skimage.measure import marching_cubes

    low = mesh.vertices.min(axis=0)
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    cell = max(mesh.voxel, longest / MOST_CELLS)
    low = low - _MARGIN * cell
    shape = tuple(math.ceil(side / cell) + 2 * _MARGIN + 1 for side in np.ptp(mesh.vertices, axis=0))
    winding = np.pad(_winding_numbers(mesh, low, cell, shape), 1)  # outside is 0: no surface ends at the border
    vertices, faces, _, _ = marching_cubes(winding, _LEVEL, gradient_direction="ascent", allow_degenerate=False)
    places = low + (vertices.astype(np.float64) - 1.0) * cell
    nearest, colors = _nearest(mesh, places)
    apart = np.linalg.norm(nearest - places, axis=1)
    near = apart < _NEAR * cell
    places[near] = nearest[near]
    return Closed(Mesh(places, faces.astype(np.int64), colors, mesh.voxel), ~near)


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


def _nearest(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [P, 3] on a mesh that are nearest to points [P, 3], and its colours [P, 3] float32 there."""
    found = surface_of(mesh).compute_closest_points(in_voxels(mesh, points))
    face = found["primitive_ids"].numpy().astype(np.int64)
    u, v = found["primitive_uvs"].numpy().astype(np.float64).T
    corners = np.stack([1.0 - u - v, u, v], axis=1)
    places, colors = (np.einsum("pc,pcd->pd", corners, each[mesh.faces[face]]) for each in (mesh.vertices, mesh.colors))
    return places, colors.astype(np.float32)
