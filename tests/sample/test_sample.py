"""The sample scene: exact, consistent between its products and its views, decided by its seed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scene_distances import distance, from_background

from beags_plugin.core.cameras import viewmat_from_opengl
from beags_plugin.sample import FAMILIES
from beags_plugin.sample.arrangement import make_still
from beags_plugin.sample.lighting import Light
from beags_plugin.sample.solids import Ball, Cone, Solid, Tube, slab
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import make_views, render_view

WIDTH, HEIGHT = 96, 72


SOLIDS = {
    "cone": Solid((Cone(0.5, 0.8), *slab(2, 0.0, 0.8)), bound=0.8),
    "ring": Solid((Tube(0.6), *slab(2, -0.2, 0.2)), (Tube(0.4),), 0.7),
    "bowl": Solid((Ball(0.7), *slab(2, -0.65, 0.1)), (Ball(0.6),), 0.7),
    "box": Solid((*slab(0, -0.3, 0.3), *slab(1, -0.4, 0.4), *slab(2, -0.5, 0.5)), bound=0.75),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_first_hits_match_marching(name):
    """Against fine steps along each ray through the inside test, which shares no code with the intersections."""
    solid = SOLIDS[name]
    generator = np.random.default_rng(1)
    origins = generator.normal(size=(60, 3))
    origins *= 2.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = generator.uniform(-0.5, 0.5, (60, 3)) - origins
    t = np.linspace(0.0, 2.0, 8001)
    points = origins[:, None] + t[:, None] * directions[:, None]
    inside = (solid.distance(points.reshape(-1, 3)) < 0.0).reshape(60, -1)
    found = solid.first_hit(origins, directions)
    assert 15 < inside.any(axis=1).sum() < 60
    clear = ~(np.isfinite(found) ^ inside.any(axis=1))
    assert clear.sum() >= 59  # a grazing ray may slip between the steps
    hit = inside.any(axis=1) & np.isfinite(found)
    close = np.abs(found[hit] - t[inside.argmax(axis=1)[hit]]) < 2.0 / 8000 + 1e-9
    assert close.sum() >= hit.sum() - 1
    assert np.abs(solid.distance((origins + found[:, None] * directions)[hit])).max() < 1e-9
    assert np.array_equal(solid.occludes(origins, directions), np.isfinite(found))


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_outward_and_unit(name):
    solid = SOLIDS[name]
    directions = np.random.default_rng(2).uniform(-0.3, 0.3, (200, 3)) - np.array([[1.2, 0.9, 1.4]])
    origin = np.array([[1.2, 0.9, 1.4]])
    t = solid.first_hit(origin, directions)
    points = (origin + t[:, None] * directions)[np.isfinite(t)]
    normals = solid.normals(points)
    assert len(points) > 50
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (solid.distance(points + 1e-6 * normals) > 0.0).all()
    assert (solid.distance(points - 1e-6 * normals) < 0.0).all()
    assert (np.einsum("ni,ni->n", normals, directions[np.isfinite(t)]) < 0.0).all()  # first hits face the eye


@pytest.mark.parametrize("seed", range(6))
def test_objects_touch_and_do_not_interpenetrate(seed):
    still = make_still(seed)
    touched = set()
    for contact in still.contacts:
        touched |= {contact.first, contact.second}
        for class_id in (contact.first, contact.second):
            if class_id == 0:
                assert abs(contact.point[2]) < 1e-9
            else:
                assert abs(distance(still.things[class_id - 1], contact.point[None])[0]) < 1e-9
    assert touched == set(range(len(still.things) + 1))
    generator = np.random.default_rng(seed)
    points = generator.uniform([-1.2, -1.2, -0.05], [1.2, 1.2, 1.1], (120_000, 3))  # smaller objects need more of them
    distances = np.stack([distance(thing, points) for thing in still.things])
    inside = distances < -1e-9
    assert (inside.sum(axis=1) > 20).all()
    assert inside.sum(axis=0).max() == 1
    assert points[inside.any(axis=0), 2].min() > 0.0


def lifted(view, picture):
    """[H, W, 3] world points from the depth, by the OpenCV camera of the core."""
    viewmat = viewmat_from_opengl(torch.from_numpy(view.camera_to_world)).numpy()
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    ray = np.stack([(x - view.cx) / view.focal, (y - view.cy) / view.focal, np.ones_like(x)], axis=-1)
    camera = ray * picture.depth[..., None]
    return (camera - viewmat[:3, 3]) @ viewmat[:3, :3]


def nearest_around(depth):
    """The least depth in each pixel's 3x3 neighbourhood."""
    padded = np.pad(depth, 1, mode="edge")
    return np.min([padded[i : i + HEIGHT, j : j + WIDTH] for i in range(3) for j in range(3)], axis=0)


def test_depth_lies_on_the_labelled_surface(scene):
    still, views, pictures = scene
    for view, picture in zip(views[::5], pictures[::5], strict=True):
        points = lifted(view, picture)
        for class_id, thing in enumerate(still.things, start=1):
            on_it = points[picture.labels == class_id]
            assert np.abs(distance(thing, on_it)).max(initial=0.0) < 1e-5
        assert (from_background(still, points[picture.labels == 0]) < 1e-5).all()


def test_views_agree_where_points_are_unoccluded(scene):
    _, views, pictures = scene
    compared = agreed = 0
    for source in (0, 4, 9):
        points = lifted(views[source], pictures[source]).reshape(-1, 3)
        labels = pictures[source].labels.ravel()
        for target in range(len(views)):
            viewmat = viewmat_from_opengl(torch.from_numpy(views[target].camera_to_world)).numpy()
            camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            front = camera[:, 2] > 0.1
            xy = camera[front, :2] / camera[front, 2:] * views[target].focal + [views[target].cx, views[target].cy]
            column, row = np.floor(xy).astype(int).T
            seen = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
            z, found = camera[front][seen, 2], pictures[target].depth[row[seen], column[seen]]
            visible = np.abs(z - found) < 0.01 * z
            same = pictures[target].labels[row[seen], column[seen]] == labels[front][seen]
            compared += visible.sum()
            agreed += (same & visible).sum()
            # Nothing is seen through: a surface point lies at or behind what some pixel next to it shows.
            assert np.mean(z > nearest_around(pictures[target].depth)[row[seen], column[seen]] - 0.02 * z) > 0.999
    assert compared > 20_000
    assert agreed > 0.97 * compared  # the rest are pixels on a rim


def test_silhouettes_hold_the_visible_masks(scene):
    still, _, pictures = scene
    occluded = unoccluded = 0
    for picture in pictures:
        for class_id in range(1, len(still.things) + 1):
            visible, silhouette = picture.labels == class_id, picture.silhouettes[class_id - 1]
            assert not (visible & ~silhouette).any()
            covered = picture.labels[silhouette & ~visible]
            assert (covered > 0).all()  # only another object hides an object
            occluded += len(covered) > 0
            unoccluded += silhouette.any() and len(covered) == 0
        assert np.array_equal(picture.silhouettes.any(axis=0), picture.labels > 0)
    assert occluded > 20
    assert unoccluded > 5


@pytest.mark.parametrize("family", FAMILIES.names())
@pytest.mark.parametrize("seed", range(4))
def test_every_object_is_seen_in_most_views(family, seed):
    scene = FAMILIES.get(family).scene(seed)
    x, y = np.indices((48, 36)).reshape(2, -1) + 0.5
    views = FAMILIES.get(family).views(seed, 48, 36, 14, 1)
    shown = [first_hits(scene, view.center, view.directions(x, y))[0] for view in views]
    for class_id in range(1, len(scene.things) + 1):
        assert sum((hits.surface == class_id).sum() >= 4 for hits in shown) > 0.5 * len(shown)


def test_images_are_exposed_and_textured(scene):
    _, _, pictures = scene
    for picture in pictures:
        assert picture.image.dtype == np.uint8 and picture.image.shape == (HEIGHT, WIDTH, 3)
        assert (picture.image == 255).all(axis=-1).mean() < 0.05
        assert picture.image.max(axis=-1).min() > 5
        for class_id in range(1, picture.labels.max() + 1):
            pixels = picture.image[picture.labels == class_id]
            assert len(pixels) < 30 or pixels.std(axis=0).max() > 8.0


def test_antialiasing_is_the_mean_of_finer_rays():
    still = make_still(0)
    light = Light(still, 2, 6)
    (view, _) = make_views(0, 16, 16, 1, 1)
    image = render_view(still, light, view, 3).image.astype(float)
    fine = type(view)(view.name, "train", view.camera_to_world, 3 * view.focal, 3 * view.cx, 3 * view.cy, 48, 48)
    linear = (render_view(still, light, fine, 1).image / 255.0) ** 2.2
    expected = 255.0 * linear.reshape(16, 3, 16, 3, 3).mean(axis=(1, 3)) ** (1 / 2.2)
    assert np.abs(image - expected).max() < 2.0  # the finer image was rounded to 8 bits


def test_seeds_change_everything_and_repeat():
    a, b, again = make_still(1), make_still(2), make_still(1)
    for thing, other, same in zip(a.things, b.things, again.things, strict=True):
        assert np.array_equal(thing.position, same.position) and thing.solid == same.solid
        assert not np.allclose(thing.position, other.position)
        assert not np.allclose(thing.texture.light, other.texture.light)
    for first, second in zip(make_views(1, 32, 24, 4, 2), make_views(2, 32, 24, 4, 2), strict=True):
        assert not np.allclose(first.camera_to_world, second.camera_to_world)


@pytest.mark.parametrize("family", FAMILIES.names())
@pytest.mark.parametrize(("train", "test"), [(60, 12), (5, 2), (1, 1), (3, 7)])
def test_views_are_split_and_rigid(family, train, test):
    views = FAMILIES.get(family).views(0, 64, 48, train, test)
    assert [v.split for v in views].count("train") == train
    assert [v.split for v in views].count("test") == test
    names = [v.name for v in views]
    assert names == sorted(names)
    for view in views:
        rotation = view.camera_to_world[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0.0
        assert 1.5 < np.linalg.norm(view.center) < 3.2 and view.center[2] > 0.3
        assert view.cx != 32 and view.cy != 24
