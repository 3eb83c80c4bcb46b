"""How far points are from the surfaces of a generated scene, exactly, by nothing that traced it."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.arrangement import DOME_RADIUS, Still
from beags_plugin.sample.meshes import Mesh
from beags_plugin.sample.room import Room


def distance(thing, points):
    """[N] distance of world points [N, 3] to a thing; of a solid a signed bound with exact zeros."""
    local = thing.to_local(points)
    return to_triangles(thing.solid, local) if isinstance(thing.solid, Mesh) else thing.solid.distance(local)


def to_triangles(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """[N] distance of points [N, 3] to the nearest of all triangles, in float64."""
    corners = mesh.vertices[mesh.triangles].transpose(1, 0, 2)  # [3, T, 3]
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.cross(sides[0], -sides[2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inwards = np.cross(normals, sides)
    found = np.empty(len(points))
    for i, point in enumerate(points):
        offset = point - corners
        inside = (np.einsum("etk,etk->et", offset, inwards) >= 0.0).all(axis=0)
        share = np.clip(np.einsum("etk,etk->et", offset, sides) / (sides**2).sum(axis=2), 0.0, 1.0)
        edges = np.linalg.norm(offset - share[..., None] * sides, axis=2).min()
        plane = np.abs(np.einsum("tk,tk->t", offset[0], normals))[inside].min(initial=np.inf)
        found[i] = min(edges, plane)
    return found


def from_background(scene, points):
    """[N] distances of world points [N, 3] to the ground and the dome, or to the walls and the furniture."""
    if isinstance(scene, Still):
        return np.minimum(np.abs(points[:, 2]), np.abs(np.linalg.norm(points, axis=1) - DOME_RADIUS))
    assert isinstance(scene, Room)
    found = np.abs(np.min(scene.shell.half - np.abs(scene.shell.to_local(points)), axis=1))
    for fixture in scene.fixtures:
        off = np.flatnonzero(found > 1e-5)  # most points are on the walls
        found[off] = np.minimum(found[off], distance(fixture, points[off]))
    return found
