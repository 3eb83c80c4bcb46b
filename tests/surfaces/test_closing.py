"""Closing what no photo shows: boxes without a bottom, as meshes and as splats, and things that enclose nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

open3d = pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")

from disc_meshes import discs_on
from random_surfels import SETTINGS, camera_at

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import make_exporter
from beags_plugin.export.glb import glb_bytes
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.surfaces.closing import Closed, closed
from beags_plugin.surfaces.closing_gaussians import _within, gaussians_on, with_closing
from beags_plugin.surfaces.fusion import Mesh, decimated
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.meshing import MadeMesh

VOXEL, HALF = 0.02, 0.4
RED, BLUE = (0.8, 0.2, 0.2), (0.2, 0.2, 0.8)


def a_box(bottom: bool) -> Mesh:
    """A box of side 0.8 about the origin in small triangles, red where x is below 0 and blue elsewhere."""
    box = trimesh.creation.box((2 * HALF,) * 3)
    for _ in range(4):
        box = box.subdivide()
    faces, vertices = np.array(box.faces), np.array(box.vertices)
    if not bottom:
        faces = faces[(vertices[faces][:, :, 2] > 0.01 - HALF).any(axis=1)]
    return Mesh(vertices, faces, np.where(vertices[:, :1] < 0, RED, BLUE).astype(np.float32), VOXEL)


def closed_box() -> Closed:
    found = closed(a_box(bottom=False))
    assert found is not None
    return found


EYES = [(2, 1, 1.5), (-1, 2, 1.2), (-2, -1, 1.5), (1, -2, 1.3), (1.5, 1.6, 2.0), (-1.2, -1.5, 1.9), (0.3, 0.2, 2.4)]


def item_of(surfels: Surfels, close: bool = True) -> ExportItem:
    views = Viewpoints([camera_at(eye) for eye in EYES], make_rasterizer("auto"), SETTINGS)
    return ExportItem("box", surfels, torch.full((len(surfels),), 3, dtype=torch.int32), views, close=close)


def test_a_box_without_bottom_is_closed_flat_and_keeps_its_sides():
    open_box = a_box(bottom=False)
    assert not trimesh.Trimesh(open_box.vertices, open_box.faces).is_watertight
    found = closed_box()
    few = decimated(found.mesh, 2000)
    for mesh in (found.mesh, few):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert solid.is_watertight and solid.is_winding_consistent
        assert solid.volume == pytest.approx((2 * HALF) ** 3, rel=0.03)
        assert np.abs(solid.bounds - [[-HALF] * 3, [HALF] * 3]).max() < 2 * VOXEL
        invented = found.invented_at(mesh.vertices)
        assert np.abs(mesh.vertices[invented][:, 2] + HALF).max() < 2 * VOXEL
        assert 0.1 < MadeMesh(mesh, 0.0, invented).facts()["closed_share"] < 0.2  # one of six sides
    assert np.array_equal(found.invented_at(found.mesh.vertices), found.invented)


def test_a_closed_mesh_stays_so_where_readers_join_vertices_of_one_place(monkeypatch):
    """Readers of .stl must join them: the ragged rim of a hole draws several corners towards one place."""
    ragged = a_box(bottom=False)
    chips = np.random.default_rng(0).random(len(ragged.faces)) < 0.1
    ragged = replace(ragged, faces=ragged.faces[~(chips & (ragged.vertices[ragged.faces][:, :, 2] < 0.3).all(axis=1))])

    def watertight() -> bool:
        found = closed(ragged)
        assert found is not None
        as_read = found.mesh.vertices[found.mesh.faces].reshape(-1, 3).astype(np.float32)
        joined = trimesh.Trimesh(as_read, np.arange(len(as_read)).reshape(-1, 3), process=True)
        return joined.is_watertight

    assert watertight()
    monkeypatch.setattr("beags_plugin.surfaces.closing._ONTO", 1.0)
    assert not watertight()


def test_a_closed_hole_has_the_colours_of_its_rim():
    """Red on one side, blue on the other, and between them no edge."""
    found = closed_box()
    bottom, red = found.mesh.vertices[found.invented], found.mesh.colors[found.invented][:, 0]
    left, right = bottom[:, 0] < 0.05 - HALF, bottom[:, 0] > HALF - 0.05
    assert red[left].mean() > 0.7 and red[right].mean() < 0.3
    middle = (np.abs(bottom[:, 0]) < 0.03) & (np.abs(bottom[:, 1]) < 0.2)
    assert middle.sum() > 10 and np.abs(red[middle] - 0.5).max() < 0.1


def test_gaussians_close_the_hole_and_are_its_only_new_ones():
    surfels = discs_on(a_box(bottom=False))
    more = gaussians_on(closed_box(), surfels, 0.0)
    assert 50 < len(more) < 2000 and more.sh_degree == 1 and not more.sh_rest.any()
    assert (more.means[:, 2] + HALF).abs().max() < 2 * VOXEL
    normals = rotation_from_quat(more.quats)[:, :, 2]
    inner = more.means[:, :2].abs().amax(dim=1) < HALF - 0.1
    assert inner.any() and normals[inner, 2].max() < -0.99  # outwards
    assert more.log_scales[inner].mean() > more.log_scales[~inner].mean() and opacities(more.opacity_logits).min() > 0.9
    again = gaussians_on(closed_box(), surfels, 0.0)
    assert torch.equal(again.means, more.means) and torch.equal(again.sh_dc, more.sh_dc)
    coarse = gaussians_on(closed_box(), surfels, 0.06)  # a pixel of three voxels
    assert 20 < len(coarse) < len(more) and coarse.means[:, :2].abs().max() < more.means[:, :2].abs().max()
    camera = camera_at((0.2, 0.3, -3.0))
    rasterizer = make_rasterizer("auto")

    def depth(part: Surfels) -> torch.Tensor:
        drawn = rasterizer.rasterize(surfel_inputs(part, camera), camera, SETTINGS, torch.zeros(3))
        assert drawn.median_depth is not None
        return torch.where(drawn.alpha > 0.5, drawn.median_depth, 0.0)

    whole = depth(discs_on(a_box(bottom=True)))
    both = Surfels(**{name: torch.cat([getattr(surfels, name), each]) for name, each in vars(more).items()})
    there = whole > 0
    assert ((depth(surfels) - whole)[there].abs() > 0.1).float().mean() > 0.4  # it shows its inside
    assert ((depth(both) - whole)[there].abs() > 0.05).float().mean() < 0.02
    assert ((depth(both) > 0) != there).float().sum() < 0.06 * there.sum()  # It hardly reaches beyond.


def test_gaussians_that_close_keep_clear_of_the_outline():
    """The distance exceeds that of half transparency, where they would lift the object's own faint edge above 1/2."""
    own, sigma = discs_on(a_box(bottom=True)), 0.12
    x = HALF - sigma * torch.tensor([-1.0, 1.5, 4.0])
    means = torch.stack([x, torch.zeros(3), torch.full((3,), HALF)], dim=1)
    more = Surfels.of(
        means, torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 3), torch.full((3, 2), float(np.log(sigma))),
        torch.full((3,), 6.0), torch.zeros(3, 4, 3),
    )  # fmt: skip
    views = Viewpoints([camera_at((0.01, 0.0, 3.0))], make_rasterizer("auto"), SETTINGS)
    assert _within(more, own, views, 0.0).tolist() == [False, False, True]


def test_an_item_is_closed_and_says_which_gaussians_are_invented():
    item = item_of(discs_on(a_box(bottom=False)))
    found, added = with_closing(item, MeshOptions(resolution=48, min_views=1))
    assert added.gaussians == len(found.surfels) - len(item.surfels) > 20 and not added.doubt
    assert found.invented is not None and torch.equal(found.surfels[~found.invented].means, item.surfels.means)
    assert found.class_ids.unique().tolist() == [3] and len(found.class_ids) == len(found.surfels)
    assert found.surfels.means[found.invented][:, 2].quantile(0.9) < 0.05 - HALF
    assert str(added) == f"{added.gaussians} more close what no photo shows"
    top, none = with_closing(replace(item, shared={}), MeshOptions(resolution=48, min_views=8))  # all see the top alone
    assert len(top.surfels) == len(item.surfels) and "encloses nothing" in str(none)


def test_a_closed_surface_that_wants_no_gaussian_adds_none(monkeypatch):
    item = item_of(discs_on(a_box(bottom=False)))
    monkeypatch.setattr("beags_plugin.surfaces.closing_gaussians.gaussians_on", lambda solid, like, pixel: like[:0])
    found, added = with_closing(item, MeshOptions(resolution=48, min_views=1))
    assert str(added) == "nothing to close" and len(found.surfels) == len(item.surfels)
    assert found.invented is not None and not found.invented.any()


@pytest.mark.parametrize("count", [1, 10])
def test_a_few_gaussians_are_closed_or_told_why_not(count):
    generator = torch.Generator().manual_seed(count)
    few = Surfels.of(
        0.2 * torch.randn(count, 3, generator=generator), torch.randn(count, 4, generator=generator),
        torch.full((count, 2), -2.0), torch.full((count,), 3.0), torch.zeros(count, 1, 3),
    )  # fmt: skip
    found, added = with_closing(item_of(few), MeshOptions(resolution=32))
    assert found.invented is not None and int(found.invented.sum()) == added.gaussians
    assert torch.equal(found.surfels[~found.invented].means, few.means) and all(
        bool(values.isfinite().all()) for values in vars(found.surfels).values()
    )
    faint = replace(few, opacity_logits=torch.full((count,), -3.0))
    found, added = with_closing(item_of(faint), MeshOptions(resolution=32))
    assert str(added) == "nothing closed, as no surface of 'box' is seen in 3 training views"
    assert len(found.surfels) == count and found.invented is not None and not found.invented.any()


@pytest.mark.parametrize("rough", [0.0, 0.005])
def test_what_encloses_nothing_is_refused_in_one_sentence(tmp_path, rough):
    """A sheet that is flat, and one so rough that crumbs of it enclose something; a bent one encloses a lens."""
    sheet = a_sheet(lambda x, y: rough * np.random.default_rng(0).normal(size=x.shape))
    assert closed(sheet) is None
    item = item_of(discs_on(a_box(bottom=False)))
    item.shared["fused", (128, 6.0, 500.0, 3)] = sheet
    with pytest.raises(NothingToExport, match="of 'box' encloses nothing, so it cannot be closed: export it without"):
        make_exporter("glb", resolution=128).write(tmp_path / "box.glb", item)
    assert not list(tmp_path.iterdir())
    _, added = with_closing(item, MeshOptions(resolution=128))
    assert str(added) == "nothing closed, as the surface of 'box' encloses nothing, so it cannot be closed"


def test_a_bent_sheet_is_closed_though_half_of_it_is_hole():
    found = closed(a_sheet(lambda x, y: np.sqrt(np.maximum(0.6 - x * x - y * y, 0.0))))
    assert found is not None and 0.3 < found.invented.mean() < 0.6
    solid = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False)
    assert solid.is_watertight and solid.volume > 0.1


def a_sheet(height: Callable[[np.ndarray, np.ndarray], np.ndarray], cells: int = 96) -> Mesh:
    """z = height(x, y) above a unit square."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(-0.5, 0.5, cells + 1)]))
    row = cells + 1
    first = (np.arange(cells)[:, None] * row + np.arange(cells)).ravel()
    faces = np.concatenate([[first, first + 1, first + row], [first + 1, first + row + 1, first + row]], axis=1).T
    return Mesh(np.stack([x, y, height(x, y)], axis=1), faces, np.full((row**2, 3), 0.5, np.float32), 1 / cells)


@pytest.mark.parametrize("close", [False, True])
def test_a_glb_marks_invented_vertices(tmp_path, close):
    """The mark is an attribute of glTF's own naming, which another project reads."""
    item = item_of(discs_on(a_box(bottom=False)), close)
    facts = make_exporter("glb", resolution=48, min_views=1).write(tmp_path / "box.glb", item)
    (read,) = trimesh.load(tmp_path / "box.glb", process=False).geometry.values()
    assert ("closed_share" in facts) == ("_INVENTED" in read.vertex_attributes) == close
    assert trimesh.Trimesh(read.vertices, read.faces, process=False).is_watertight == close
    if close:
        invented = np.ravel(read.vertex_attributes["_INVENTED"]) > 0
        assert invented.any() and np.abs(read.vertices[invented][:, 1] + HALF).max() < 0.1  # y is up
        assert 0.05 < facts["closed_share"] < 0.25


def test_the_attribute_of_a_glb_is_allowed_by_the_standard():
    """Section 3.7.2.1: application-specific names begin with an underscore and are not of unsigned int."""
    box = a_box(bottom=True)
    raw = glb_bytes(box, "box", None, np.arange(len(box.vertices)) % 2 == 0)
    content = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    accessor = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["_INVENTED"]]
    assert (accessor["componentType"], accessor["type"], accessor["count"]) == (5126, "SCALAR", len(box.vertices))
