"""Meshes of objects: against the sample's exact surfaces, and read back by other programs' readers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

open3d = pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")

from covered_things import camera_of, color_at, covered, hits, thing_called
from scene_distances import distance
from scipy.spatial import cKDTree

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import make_exporter
from beags_plugin.export.mesh import GlbExporter
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.sample.scene import Thing
from beags_plugin.sample.views import make_views
from beags_plugin.surfaces import fusion
from beags_plugin.surfaces.close_up import close_up
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.surfaces.fusion import (
    Mesh,
    _grid_mb,
    decimated,
    sorted_mesh,
    suitable_resolution,
    voxel_size,
    without_small_parts,
)
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.errors import UserError

OPTIONS: dict[str, Any] = {
    "resolution": 96,
    "truncation": 4.0,
    "triangles": 1_000_000,
}  # the cup's wall is 9 voxels thick: its two sides stay apart


def cameras(count: int = 24) -> list[Camera]:
    return [camera_of(view) for view in make_views(2, 64, 48, count, 1) if view.split == "train"]


@pytest.fixture(scope="module")
def thing() -> Thing:
    return thing_called("cup")


@pytest.fixture(scope="module")
def item(thing) -> ExportItem:
    """The cup covered with small opaque discs where the views see it."""
    views = cameras()
    surfels = covered(thing, views)
    viewpoints = Viewpoints(views, make_rasterizer("auto"), RasterSettings(0.05, 50.0))
    return ExportItem("cup", surfels, torch.ones(len(surfels), dtype=torch.int32), viewpoints)


@pytest.fixture(scope="module")
def mesh(item) -> Mesh:
    return GlbExporter(**OPTIONS).made(item).mesh


def test_vertices_lie_on_the_exact_surface(thing, mesh):
    assert mesh.voxel == pytest.approx(2 * 0.18 / 96, rel=0.15)
    off = np.abs(distance(thing, mesh.vertices))
    # Some vertices lie outside: discs stick out at sharp edges.
    assert np.quantile(off, 0.9) < mesh.voxel and off.max() < 4 * mesh.voxel
    assert np.median(off) < 0.5 * mesh.voxel


def test_the_mesh_covers_what_the_views_see(thing, item, mesh):
    tree = cKDTree(mesh.vertices)
    seen = np.concatenate([hits(thing, camera) for camera in item.views.cameras[::4]])
    assert len(seen) > 200
    assert np.quantile(tree.query(seen)[0], 0.98) < 2 * mesh.voxel


def test_faces_look_outwards_and_colours_are_those_of_the_place(thing, mesh):
    corners = mesh.vertices[mesh.faces]
    middle = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)  # some faces are needles
    out = distance(thing, middle + 0.5 * mesh.voxel * normals)
    assert (out > distance(thing, middle)).mean() > 0.95
    assert np.abs(mesh.colors - color_at(mesh.vertices)).mean() < 0.02


def test_a_glb_is_read_back(item, mesh, tmp_path):
    facts = make_exporter("glb", **OPTIONS).write(tmp_path / "cup.glb", item)
    assert facts == {
        "vertices": len(mesh.vertices), "triangles": len(mesh.faces), "voxel": mesh.voxel,
        "texture": "none, as no photos were given",
    }  # fmt: skip
    (read,) = trimesh.load(tmp_path / "cup.glb", process=False).geometry.values()
    y_up = np.stack([mesh.vertices[:, 0], mesh.vertices[:, 2], -mesh.vertices[:, 1]], axis=1)
    assert np.allclose(read.vertices, y_up, atol=1e-6) and np.array_equal(read.faces, mesh.faces)
    other = open3d.io.read_triangle_mesh(str(tmp_path / "cup.glb"))
    tree = cKDTree(np.asarray(other.vertices))  # this reader may renumber
    distance, index = tree.query(y_up)
    assert distance.max() < 1e-6
    # glTF's vertex colours are linear
    colors = np.asarray(other.vertex_colors)[index]
    assert np.abs(colors - linear_from_srgb(mesh.colors)).max() < 2e-3
    raw = (tmp_path / "cup.glb").read_bytes()
    content = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    assert "KHR_materials_unlit" in content["materials"][0]["extensions"]


def test_an_obj_is_read_back(item, mesh, tmp_path):
    make_exporter("obj", **OPTIONS).write(tmp_path / "cup.obj", item)
    read = trimesh.load_mesh(tmp_path / "cup.obj", process=False, maintain_order=True)
    assert np.allclose(read.vertices, mesh.vertices, atol=1e-6) and np.array_equal(read.faces, mesh.faces)
    assert np.abs(read.visual.vertex_colors[:, :3] / 255.0 - mesh.colors).max() < 3e-3


def test_a_view_of_a_few_pixels_adds_nothing(item, mesh, monkeypatch):
    """Open3D looks for blocks at every fourth pixel of lines and columns, and ends with an error if none is solid."""
    draw, calls = fusion._draw, iter(range(1000))

    def drawn(*args):
        depth, color = draw(*args)
        if next(calls) == 0:
            place = (depth.nonzero()[0] // 4 * 4 + 1).tolist()
            value = float(depth.max())
            depth = torch.zeros_like(depth)
            depth[tuple(place)] = value
        return depth, color

    monkeypatch.setattr(fusion, "_draw", drawn)
    found = GlbExporter(**OPTIONS).made(replace(item, shared={})).mesh
    assert next(calls) > 20 and len(found.faces) == pytest.approx(len(mesh.faces), rel=0.1)


def test_both_file_types_share_one_mesh(item):
    glb, obj = (make_exporter(name, **OPTIONS) for name in ("glb", "obj"))
    assert glb.made(item) is obj.made(item)


@pytest.mark.slow("fuses a voxel grid of hundreds of MB")
def test_fewer_faces_keep_bounds_surface_and_colours(thing, item, mesh):
    few = decimated(mesh, 3000)
    assert 2900 <= len(few.faces) <= 3000 < len(mesh.faces) / 10 and len(few.vertices) == len(np.unique(few.faces))
    for end in (np.min, np.max):
        assert np.abs(end(few.vertices, axis=0) - end(mesh.vertices, axis=0)).max() < mesh.voxel
    assert np.quantile(np.abs(distance(thing, few.vertices)), 0.9) < mesh.voxel
    assert np.abs(few.colors - color_at(few.vertices)).mean() < 0.02
    again = decimated(mesh, 3000)
    assert np.array_equal(again.vertices, few.vertices) and np.array_equal(again.faces, few.faces)


def test_a_small_object_gets_few_faces_and_the_option_another_number(item):
    """Faces in proportion to the Gaussians, as a cup of 400 is not drawn better by 100,000."""
    discs = item.surfels[::100]
    some = replace(item, surfels=replace(discs, log_scales=discs.log_scales + 2.5), shared={})
    for options, most in (({}, 20 * len(some.surfels)), ({"triangles": 1000}, 1000)):
        assert 0.97 * most <= len(GlbExporter(resolution=64, **options).made(some).mesh.faces) <= most


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_scale_of_a_scene_changes_nothing(item, mesh, scale):
    surfels, views = item.surfels, item.views

    def scaled(camera: Camera) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] *= scale
        return replace(camera, viewmat=viewmat)

    large = replace(surfels, means=scale * surfels.means, log_scales=surfels.log_scales + float(np.log(scale)))
    settings = RasterSettings(scale * views.settings.near, scale * views.settings.far)
    views = Viewpoints([scaled(camera) for camera in views.cameras], views.rasterizer, settings)
    other = GlbExporter(**OPTIONS).made(replace(item, surfels=large, views=views, shared={})).mesh
    assert other.voxel == pytest.approx(scale * mesh.voxel, rel=1e-5)
    # The bits differ: a pixel's depth may be that of the neighbouring disc.
    distance, _ = cKDTree(mesh.vertices).query(other.vertices / scale)
    assert np.quantile(distance, 0.99) < 0.1 * mesh.voxel


def test_the_same_mesh_for_any_number_of_threads(item, mesh):
    threads = torch.get_num_threads()
    for count in (1, 4):
        torch.set_num_threads(count)
        try:
            again = GlbExporter(**OPTIONS).made(replace(item, shared={})).mesh
        finally:
            torch.set_num_threads(threads)
        for name in ("vertices", "faces", "colors"):
            assert np.array_equal(getattr(again, name), getattr(mesh, name)), name


def test_the_order_of_vertices_and_faces_is_a_matter_of_their_places():
    generator = np.random.default_rng(1)
    vertices, colors = generator.random((9, 3)), generator.random((9, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [8, 7, 0]])
    order = generator.permutation(9)
    renumbered = np.argsort(order)[faces][::-1]
    other = Mesh(vertices[order], np.roll(renumbered, 1, axis=1), colors[order], 0.1)
    one, two = sorted_mesh(Mesh(vertices, faces, colors, 0.1)), sorted_mesh(other)
    for name in ("vertices", "faces", "colors"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    areas = [np.cross(m.vertices[m.faces[:, 1]] - m.vertices[m.faces[:, 0]],
                      m.vertices[m.faces[:, 2]] - m.vertices[m.faces[:, 0]]).sum(axis=0)
             for m in (one, Mesh(vertices, faces, colors, 0.1))]  # fmt: skip
    assert np.allclose(*areas)  # no face was turned over


def test_small_loose_parts_are_left_out():
    fan = [[0, i, i + 1] for i in range(1, 11)]
    faces = np.array([*fan, [12, 13, 14]])
    vertices = np.random.default_rng(2).random((16, 3))  # the last belongs to no face
    mesh = Mesh(vertices, faces, vertices.astype(np.float32), 0.1)
    kept = without_small_parts(mesh, 0.2)
    assert np.array_equal(kept.vertices, vertices[:12]) and np.array_equal(kept.faces, fan)
    assert np.array_equal(kept.vertices[kept.faces], mesh.vertices[mesh.faces[:10]])
    both = without_small_parts(mesh, 0.1)
    assert len(both.vertices) == 15 and np.array_equal(both.vertices[both.faces], mesh.vertices[mesh.faces])


def test_voxels_grow_to_keep_the_memory():
    low, high = torch.zeros(3), torch.tensor([2.0, 1.0, 0.5])
    assert voxel_size(low, high, 128, 8.0, 1e6) == 2.0 / 128
    voxel = voxel_size(low, high, 4096, 8.0, 200.0)
    assert voxel > 2.0 / 4096 and 100 < _grid_mb(high, voxel, 8.0) <= 200


@pytest.mark.slow("fuses a voxel grid of hundreds of MB")
def test_the_grid_keeps_its_bound(item, monkeypatch):
    """All blocks that Open3D allocates, at 20 bytes a voxel, stay within the bound."""
    from beags_plugin.surfaces import fusion

    grids = []
    make = fusion._new_grid
    monkeypatch.setattr(fusion, "_new_grid", lambda: grids.append(make()) or grids[-1])
    mesh = GlbExporter(resolution=400, memory_mb=60.0).made(replace(item, shared={})).mesh
    low, high = bounding_box(item.surfels)
    assert mesh.voxel > float((high - low).max()) / 400
    assert 0 < grids[0].hashmap().size() * 16**3 * 20 / 1e6 < 60.0


def test_a_close_up_sees_the_same_larger():
    camera = cameras()[3]
    low, high = torch.tensor([0.1, -0.2, 0.0]), torch.tensor([0.4, 0.0, 0.3])
    close = close_up(camera, low, high, 0.05, 100)
    assert max(close.width, close.height) == 100
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))
    xy, _ = project(corners, close)
    assert xy.min() >= 1.9 and (xy.amax(dim=0) <= torch.tensor([close.width, close.height]) - 1.9).all()
    before, _ = project(corners, camera)
    zoom = close.K[0, 0] / camera.K[0, 0]
    assert torch.allclose(xy[1:] - xy[:1], zoom * (before[1:] - before[:1]), atol=1e-2)
    inside = close_up(camera, camera.center - 1, camera.center + 1, 0.05, 100)  # the camera is in the box
    assert (inside.width, inside.height) == (100, 75)
    assert torch.allclose(inside.K[0, 0], camera.K[0, 0] * 100 / 64)


def test_what_no_view_shows_is_refused(item):
    behind = replace(item, surfels=replace(item.surfels, means=item.surfels.means + 1000.0), shared={})
    with pytest.raises(NothingToExport, match="no surface of 'cup' is seen in 3 training views"):
        make_exporter("glb").write(None, behind)


@pytest.mark.parametrize(("focal", "voxels"), [(10.0, 48), (59.5, 75), (1000.0, 128)])
def test_voxels_are_as_fine_as_the_nearest_photo(focal, voxels):
    part = Surfels.of(
        torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        torch.full((2, 2), -9.0), torch.zeros(2), torch.zeros(2, 1, 3),
    )  # fmt: skip
    K = torch.tensor([[focal, 0.0, 50.0], [0.0, focal, 50.0], [0.0, 0.0, 1.0]])
    cameras = []
    for away in (2.0, 4.0, -3.0):  # the last one looks away from it
        viewmat = torch.eye(4)
        viewmat[2, 3] = away
        cameras.append(Camera(viewmat, K, 100, 100))
    assert suitable_resolution(part, cameras) == voxels  # 1.25 for each of 2 * focal / 2 pixels


def test_without_open3d_a_user_error_explains_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(UserError, match=r"the exporter 'obj' cannot run here: Open3D cannot be loaded .* pip install"):
        make_exporter("obj")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"resolution": 4}, "resolution is 4: give 8 to 4096 voxels"),
        ({"truncation": 0.5}, "truncation is 0.5: it must lie in 1..64"),
        ({"memory_mb": 1.0}, "memory_mb is 1.0: give the voxel grid at least 50 MB"),
        ({"min_views": 0}, "min_views is 0: a surface needs at least 1 view"),
        ({"triangles": 99}, "triangles is 99: give at least 100, or 0 for 20 for each Gaussian"),
        ({"smallest_part": float("nan")}, "smallest_part is nan: it must lie in 0..1"),
    ],
)
def test_wrong_options(options, sentence):
    with pytest.raises(UserError, match=sentence):
        MeshOptions(**options)


def test_a_depth_at_the_last_rows_alone_is_no_surface():
    """Open3D looks at no pixel of a last, smaller strip of rows, and ends with an error if there is none elsewhere."""
    grid, camera = fusion._new_grid(), cameras(1)[0]
    depth = torch.zeros(103, 64)
    depth[100, 8] = 40.0
    pose = fusion._in_voxels(camera, torch.zeros(3, dtype=torch.float64), 0.05)
    assert not fusion._integrate(grid, depth, torch.zeros(103, 64, 3), pose, 6.0)


def test_what_no_view_adds_to_has_no_surface(item, monkeypatch):
    monkeypatch.setattr(fusion, "_integrate", lambda *_: False)
    assert len(fusion.fuse(item.surfels, item.views, 16, 6.0, 500.0, 3).faces) == 0


def test_what_has_no_extent_has_no_surface(item):
    nothing = item.surfels[:3].clone()
    nothing.log_scales[:] = -torch.inf
    nothing.means[:] = nothing.means[:1].clone()
    for surfels in (nothing, replace(nothing, means=torch.full_like(nothing.means, torch.nan))):
        assert len(fusion.fuse(surfels, item.views, 16, 6.0, 500.0, 3).faces) == 0
