"""How far points are from the surfaces of a generated scene, exactly, by nothing that traced it."""

from __future__ import annotations

import numpy as np
from open3d.core import Tensor

from beags_plugin.sample.arrangement import DOME_RADIUS, Still
from beags_plugin.sample.meshes import Mesh
from beags_plugin.sample.room import Room
from beags_plugin.sample.solids import turned


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


def assert_touching(made: Room, touching: set[tuple[str, str]]) -> None:
    """Things touch in these pairs and on the table, exactly, and nowhere run into one another or into walls."""
    names = made.class_names
    for contact in made.contacts:
        for class_id in (contact.first, contact.second):
            off = distance(made.things[class_id - 1], contact.point[None])[0] if class_id else contact.point[2]
            assert abs(off) < 1e-9
    assert {(names[c.first], names[c.second]) for c in made.contacts if c.second} == touching
    assert set(names) - {0} == {c.first for c in made.contacts}
    generator = np.random.default_rng(0)
    for thing in made.things:
        corners = thing.solid.vertices[thing.solid.triangles]
        weights = generator.dirichlet([1.0] * 3, len(corners))
        points = turned(np.einsum("tc,tck->tk", weights, corners), thing.rotation.T) + thing.position
        assert points[:, 2].min() > -1e-9 and np.abs(made.shell.to_local(points)[:, :2]).max() < 3.5
        for other in made.things:
            if other is not thing:
                local = Tensor(other.to_local(points).astype(np.float32))
                inside = points[other.solid.caster.compute_occupancy(local, nsamples=3).numpy() > 0]
                assert len(inside) == 0 or distance(other, inside).max() < 1e-4, (thing.name, other.name)
