"""The room: exact masks, real contacts, closed walls, and places that photos hardly show."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scene_distances import assert_touching

from beags_benchmarks.experiments.scenes import SEEDS
from beags_benchmarks.samples.room import TracedLight, make_room, room_views
from beags_plugin.core.cameras import viewmat_from_opengl
from beags_plugin.sample.desk import DeskLight, desk_views, make_desk
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import pixel_directions, render_view

LEANING = {("book", "crate"), ("star", "crate"), ("spoon", "mug"), ("ball", "basket")}


@pytest.fixture(scope="module", params=SEEDS["choosing"])
def room(request):
    return request.param, make_room(request.param)


def test_things_touch_where_they_should_and_nowhere_run_into_one_another(room):
    assert_touching(room[1], LEANING)


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
    light = TracedLight(made, 4, 4)
    for view in room_views(seed, 96, 72, 2, 1)[:1]:
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
    points = []
    for view in views:
        if view.split == "test":
            hits, _ = first_hits(made, view.center, directions := view.directions(x, y))
            points.append(view.center + hits.t[:, None] * directions)
    hardly = sum(shown(made, photo, np.concatenate(points)) for photo in photos) < 3
    shares = hardly.reshape(len(points), -1).mean(axis=1)
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


def test_light_that_the_desk_bakes_is_that_of_the_room(fine_light):
    made = make_desk(0)
    light, direct, views = DeskLight(made), TracedLight(made), desk_views(0, 96, 72, 5, 1)
    for view in views[::3]:
        directions = pixel_directions(view)
        hits, _ = first_hits(made, view.center, directions)
        points = view.center + hits.t[:, None] * directions
        baked = light.colours(points, hits.surface, directions, view.center)
        # Each of four rays sees by its own share of the lamp.
        place, part, way = (np.repeat(each, 4, axis=0) for each in (points, hits.surface, directions))
        expected = direct.colours(place, part, way, view.center).reshape(-1, 4, 3).mean(axis=1)
        assert np.median(np.abs(baked - expected)) < 0.01 * np.median(expected)
        assert abs(baked.mean() / expected.mean() - 1.0) < 0.01


def test_rooms_of_different_seeds_differ():
    first, second = make_room(0), make_room(1)
    for one, other in zip(first.things, second.things, strict=True):
        assert one.name == other.name and not np.allclose(one.position, other.position)
        assert one.solid.vertices.shape == other.solid.vertices.shape
        assert not np.allclose(one.solid.vertices, other.solid.vertices)
    assert not np.allclose(first.shell.half, second.shell.half)
