"""The room: exact masks, real contacts, closed walls, and places that photos hardly show."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from open3d.core import Tensor
from scene_distances import distance

from beags_benchmarks.experiments.scenes import SEEDS
from beags_plugin.core.cameras import viewmat_from_opengl
from beags_plugin.sample.desk import make_desk
from beags_plugin.sample.meshes import Mesh, block, extrude, lathe, sweep
from beags_plugin.sample.room import make_room, room_views
from beags_plugin.sample.room_light import RoomLight
from beags_plugin.sample.solids import turned
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import render_view

LEANING = {("book", "crate"), ("star", "crate"), ("spoon", "mug"), ("ball", "basket")}
TOUCHING = {("book", "crate"), ("star", "crate"), ("mug", "crate"), ("vase", "crate"), ("ball", "crate")}


def volume(mesh):
    corners = mesh.vertices[mesh.triangles]
    return np.linalg.det(corners).sum() / 6.0


def test_meshes_are_closed_and_face_outwards():
    turn = np.linspace(0.0, np.pi, 33)
    square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    ball = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    ball[[0, -1], 0] = 0.0
    for part, expected, within in [
        (block(0.5, 1.0, -1.0, 2.0), 6.0, 1e-12),
        (extrude(square, 0.5 * square, 0.0, 1.0), 3.0, 1e-12),
        (lathe(ball), 4.0 / 3.0 * np.pi, 0.02),
        (sweep(np.stack([3.0 * turn, 0.0 * turn], axis=1), 0.1, 64), 0.03 * np.pi**2, 2e-3),
    ]:
        mesh = Mesh(part)
        assert volume(mesh) == pytest.approx(expected, rel=within)
        _, vertex = np.unique(mesh.vertices.round(9), axis=0, return_inverse=True)
        ends = vertex.ravel()[mesh.triangles[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2)
        assert sorted(map(tuple, ends)) == sorted(map(tuple, ends[:, ::-1]))  # each edge once in either direction


@pytest.fixture(scope="module", params=SEEDS["choosing"])
def room(request):
    return request.param, make_room(request.param)


@pytest.mark.parametrize("seed", SEEDS["choosing"])
@pytest.mark.parametrize(("make", "touching"), [(make_room, LEANING), (make_desk, TOUCHING)])
def test_things_touch_where_they_should_and_nowhere_run_into_one_another(make, touching, seed):
    made = make(seed)
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


def rasterized(view, things):
    """Depth of each thing at the pixel centres, [L, H, W]: triangles projected one by one, in float64."""
    viewmat = viewmat_from_opengl(torch.from_numpy(view.camera_to_world)).numpy()
    depth = np.full((len(things), view.height, view.width), np.inf)
    for thing, plane in zip(things, depth, strict=True):
        world = thing.solid.vertices @ thing.rotation.T + thing.position
        camera = world @ viewmat[:3, :3].T + viewmat[:3, 3]
        assert camera[:, 2].min() > 0.2
        pixels = camera[:, :2] / camera[:, 2:] * view.focal + [view.cx, view.cy]
        for triangle in thing.solid.triangles:
            corner, z = pixels[triangle], camera[triangle, 2]
            (x0, y0), (x1, y1) = np.ceil(corner.min(0) - 0.5).astype(int), np.floor(corner.max(0) - 0.5).astype(int)
            x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, view.width - 1), min(y1, view.height - 1)
            if x0 > x1 or y0 > y1:
                continue
            x, y = np.meshgrid(np.arange(x0, x1 + 1) + 0.5, np.arange(y0, y1 + 1) + 0.5)
            solution = np.linalg.solve(
                np.vstack([corner.T, np.ones(3)]), np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
            )
            found = np.where((solution >= 0.0).all(axis=0), 1.0 / (solution.T @ (1.0 / z)), np.inf).reshape(x.shape)
            part = plane[y0 : y1 + 1, x0 : x1 + 1]
            np.minimum(part, found, out=part)
    return depth


def test_masks_silhouettes_and_depth_are_those_of_projected_triangles(room):
    seed, made = room
    light = RoomLight(made, 4, 4)
    for view in room_views(seed, 96, 72, 2, 1)[::2]:
        picture = render_view(made, light, view, 1)
        depth = rasterized(view, made.things)
        wrong = (np.isfinite(depth) != picture.silhouettes).sum()
        assert picture.silhouettes.sum() > 400 and wrong <= 2  # a pixel centre may lie on an edge
        nearest, labels = depth.min(axis=0), np.where(np.isfinite(depth.min(axis=0)), depth.argmin(axis=0) + 1, 0)
        assert (labels != picture.labels).sum() <= 2
        same = (labels == picture.labels) & (labels > 0)
        assert np.abs(nearest - picture.depth)[same].max() < 1e-5


def test_every_ray_ends_in_the_room_and_cameras_stand_free(room):
    seed, made = room
    generator = np.random.default_rng(seed)
    for view in room_views(seed, 96, 72, 60, 12):
        directions = generator.normal(size=(500, 3))
        hits, _ = first_hits(made, view.center, directions)
        points = view.center + hits.t[:, None] * directions
        assert (hits.t > 0.0).all() and (np.abs(made.shell.to_local(points)) <= made.shell.half + 1e-9).all()
        assert (hits.t * np.linalg.norm(directions, axis=1)).min() > 0.25
        assert (np.abs(made.shell.to_local(view.center[None])) < made.shell.half - 0.25).all()


def test_some_held_out_views_show_what_hardly_any_photo_shows(room):
    seed, made = room
    views = room_views(seed, 24, 18, 60, 12)
    photos = [view for view in views if view.split == "train"]
    x, y = np.indices((24, 18)).reshape(2, -1) + 0.5
    shares = []
    for view in views:
        if view.split == "test":
            hits, _ = first_hits(made, view.center, directions := view.directions(x, y))
            points = view.center + hits.t[:, None] * directions
            shares.append(np.mean(sum(shown(made, photo, points) for photo in photos) < 3))
    assert min(shares) < 0.02 and max(shares) > 0.15 and 0.03 < np.mean(shares) < 0.15


def shown(scene, view, points):
    """[N] bool, whether a view shows the world points [N, 3]."""
    local = (points - view.center) @ view.camera_to_world[:3, :3]
    x, y = view.cx - view.focal * local[:, 0] / local[:, 2], view.cy + view.focal * local[:, 1] / local[:, 2]
    inside = np.flatnonzero((local[:, 2] < 0.0) & (x > 0.0) & (x < view.width) & (y > 0.0) & (y < view.height))
    hits, _ = first_hits(scene, view.center, points[inside] - view.center)
    seen = np.zeros(len(points), dtype=bool)
    seen[inside] = hits.t > 0.995
    return seen


def test_rooms_of_different_seeds_differ():
    first, second = make_room(0), make_room(1)
    for one, other in zip(first.things, second.things, strict=True):
        assert one.name == other.name and not np.allclose(one.position, other.position)
        assert one.solid.vertices.shape == other.solid.vertices.shape
        assert not np.allclose(one.solid.vertices, other.solid.vertices)
    assert not np.allclose(first.shell.half, second.shell.half)
