"""The desk: closed meshes, real contacts, and the same photo by whichever way its rays are cast."""

from __future__ import annotations

import numpy as np
import pytest
from scene_distances import assert_touching

from beags_plugin.sample.desk import DeskLight, desk_views, make_desk
from beags_plugin.sample.light_map import LightMap, smooth_normals
from beags_plugin.sample.meshes import Mesh, block, extrude, lathe, sweep
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import pixel_directions, render_image

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


@pytest.mark.parametrize("seed", range(3))
def test_things_touch_where_they_should_and_nowhere_run_into_one_another(seed):
    assert_touching(make_desk(seed), TOUCHING)


@pytest.fixture(scope="module")
def desk():
    made = make_desk(0)
    return made, DeskLight(made), desk_views(0, 96, 72, 5, 1)


def test_light_on_a_triangle_is_interpolated_exactly_where_it_is_linear():
    mesh = Mesh(block(0.3, 0.2, -0.1, 0.4))
    slope = np.array([[0.5, 0.2, 0.1], [-0.3, 0.4, 0.7], [0.2, -0.6, 0.3]])
    light = LightMap(mesh, 0.07, lambda points, normals: points @ slope)
    generator = np.random.default_rng(0)
    weights = generator.dirichlet([1.0] * 3, (40, len(mesh.triangles)))
    points = np.einsum("stk,tkd->std", weights, mesh.vertices[mesh.triangles])
    for point, weight in zip(points, weights, strict=True):
        assert np.allclose(light.at(np.arange(len(point)), weight[:, 1:]), point @ slope, atol=1e-6)
        assert np.allclose(light.read(point, -mesh.face_normals), point @ slope, atol=1e-5)


def test_turned_shapes_have_round_normals_and_boxes_have_edges():
    polar = np.linspace(0.0, np.pi, 33)
    ball = np.stack([np.sin(polar), -np.cos(polar)], axis=1)
    ball[[0, -1], 0] = 0.0
    round_, box = Mesh(lathe(ball)), Mesh(block(0.3, 0.2, -0.1, 0.4))
    assert np.abs(smooth_normals(round_) - round_.vertices[round_.triangles]).max() < 0.02  # faces are off by 0.05
    assert np.array_equal(smooth_normals(box), np.repeat(box.face_normals[:, None], 3, axis=1))


def test_photos_are_the_same_by_one_cast_as_by_a_cast_for_each_object(desk):
    made, light, views = desk
    view = views[2]
    directions = pixel_directions(view)
    hits, _ = first_hits(made, view.center, directions)
    points = view.center + hits.t[:, None] * directions
    expected = light.colours(points, hits.surface, directions, view.center)
    off = np.abs(light.seen(view.center, directions) - expected).max(axis=1)
    assert (off > 0.02).mean() < 0.002  # rays on an edge, which rounding moves to its other side
    assert np.median(off) < 1e-4
    image = render_image(made, light, view, 1)
    assert np.abs(image.reshape(-1, 3) / 255.0 - np.minimum(expected, 1.0) ** (1 / 2.2)).mean() < 0.003


def test_cameras_stand_all_around_in_the_room_and_show_every_object_whole(desk):
    made, _, _ = desk
    views = desk_views(0, 96, 72, 30, 6)
    places = np.stack([view.center for view in views])
    azimuth = np.sort(np.arctan2(places[:, 1], places[:, 0]))
    assert np.diff(np.append(azimuth, azimuth[0] + 2.0 * np.pi)).max() < 0.6
    assert np.abs(made.shell.to_local(places) / made.shell.half).max() < 0.99
    for thing in made.things:
        corners = thing.solid.vertices @ thing.rotation.T + thing.position
        inside = []
        for view in views:
            local = (corners - view.center) @ view.camera_to_world[:3, :3]
            x, y = view.focal * local[:, :2].T / -local[:, 2]
            inside.append(((np.abs(x) < 0.47 * view.width) & (np.abs(y) < 0.47 * view.height)).all())
        assert np.mean(inside) > 0.5, thing.name
