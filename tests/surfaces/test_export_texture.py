"""Textures: a box with known colours, photographed with known exposures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

open3d = pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")

from photographed_box import EXPOSURES, EYES, VOXEL, a_box, camera_from, light_at, photo_of

from beags_plugin.export.glb import glb_bytes
from beags_plugin.surfaces.atlas import picture, texels, unwrapped
from beags_plugin.surfaces.baking import Places, baked, without_edge
from beags_plugin.surfaces.color import linear_from_srgb, srgb_from_linear
from beags_plugin.surfaces.fusion import Mesh, decimated
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import area_vectors, vertex_normals
from beags_plugin.surfaces.surface_alignment import _moved, outline_iou, placed
from beags_plugin.surfaces.texture import textured


@pytest.fixture(scope="module")
def box() -> Mesh:
    return a_box()


def photos_of(box: Mesh, **options) -> list[Photo]:
    return [photo_of(box, camera_from(eye), e, **options) for eye, e in zip(EYES, EXPOSURES, strict=True)]


def places_of(box: Mesh) -> Places:
    middles, areas = box.vertices[box.faces].mean(axis=1), area_vectors(box)
    return Places(middles, areas / np.linalg.norm(areas, axis=1, keepdims=True), 0.01)


def test_exposures_are_evened_out_and_colours_are_those_of_the_places(box):
    places = places_of(box)
    found = baked(places, box, photos_of(box), np.full((len(places.points), 3), 0.9))
    relative = EXPOSURES / np.exp(np.log(EXPOSURES).mean())
    assert np.abs(found.exposures / relative[:, None] - 1).max() < 0.02
    top = places.points[:, 2] > 0.39
    below = places.points[:, 2] < -0.39
    assert found.seen[top].mean() > 0.9 and not found.seen[below].any()
    right = srgb_from_linear(light_at(places.points) * np.exp(np.log(EXPOSURES).mean()))
    assert np.abs(found.colors - right)[found.seen].mean() < 0.005
    assert np.abs(found.colors[below] - 0.9).max() < 1e-6  # No photo shows these, so the splats' colour stays.


def test_parts_of_a_surface_have_the_same_colours_as_the_whole(box, monkeypatch):
    places, prior = places_of(box), np.random.default_rng(0).random((len(box.faces), 3))
    whole, at = baked(places, box, photos_of(box), prior), texels(unwrapped(box, 128))
    corners = at.of(box.vertices)
    monkeypatch.setattr("beags_plugin.surfaces.baking._PART", 7)
    monkeypatch.setattr("beags_plugin.surfaces.atlas._RAYS", 1000)
    parts, again = baked(places, box, photos_of(box), prior), texels(unwrapped(box, 128))
    assert whole.seen.any() and not whole.seen.all() and np.array_equal(parts.seen, whole.seen)
    assert np.abs(parts.colors - whole.colors).max() < 1e-12
    assert np.abs(again.of(box.vertices) - corners).max() < 1e-12
    assert np.array_equal(again.rows, at.rows) and np.array_equal(again.columns, at.columns)


@pytest.mark.parametrize("edge", range(6))
def test_the_edge_of_a_mask_is_as_wide_as_given(edge):
    mask = np.random.default_rng(edge).random((40, 30)) < 0.97
    around = np.pad(mask, edge, constant_values=True)
    windows = np.lib.stride_tricks.sliding_window_view(around, (2 * edge + 1, 2 * edge + 1))
    assert np.array_equal(without_edge(mask, edge), windows.all(axis=(2, 3)))


def test_what_stands_before_the_object_leaves_no_colour(box):
    places = places_of(box)
    found = baked(places, box, photos_of(box, screen=True), np.full((len(places.points), 3), 0.5))
    red = (found.colors[:, 0] > 0.85) & (found.colors[:, 1] < 0.2)
    assert found.seen.mean() > 0.4 and not red.any()


def test_the_object_hides_itself():
    """A place behind a wall that looks at the camera is not seen through it."""
    wall = a_box()
    far = Mesh(wall.vertices + [3.0, 0.0, 0.0], wall.faces, wall.colors, VOXEL)
    both = Mesh(
        np.concatenate([wall.vertices, far.vertices]), np.concatenate([wall.faces, far.faces + len(wall.vertices)]),
        np.concatenate([wall.colors, far.colors]), VOXEL,
    )  # fmt: skip
    photo = photo_of(wall, camera_from((-3.0, 0.01, 0.0)), 1.0)
    photo = Photo(
        photo.camera, photo.image, lambda: torch.ones(160, 160, dtype=torch.bool), lambda: torch.zeros(160, 160)
    )
    behind = Places(np.array([[2.6, 0.0, 0.0], [-0.4, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]] * 2), 0.01)
    assert baked(behind, both, [photo], np.full((2, 3), 0.5)).seen.tolist() == [False, True]


def test_a_texture_shows_the_photos_at_every_place(box):
    """Read back as a reader of glTF reads it: at the uv of a face, between texels, also at seams."""
    texture = textured(box, photos_of(box), 512)
    atlas = texture.atlas
    assert np.array_equal(atlas.source[atlas.faces], box.faces) and atlas.size == 512
    assert texture.image.shape == (512, 512, 3) and atlas.uv.min() >= 0 and atlas.uv.max() <= 1
    corners = box.vertices[box.faces]
    top = (corners[:, :, 2] > 0.39).all(axis=1) & (np.abs(corners[:, :, :2]).max(axis=(1, 2)) < 0.35)
    for weights in ([1 / 3, 1 / 3, 1 / 3], [0.9, 0.1, 0.0]):  # middles of faces, and their edges
        at = np.einsum("c,fcd->fd", weights, atlas.uv[atlas.faces[top]]) * 512 - 0.5
        column, row = np.round(at).astype(int).T
        shown = linear_from_srgb(texture.image[row, column] / 255)
        place = np.einsum("c,fcd->fd", weights, corners[top])
        assert np.abs(shown - light_at(place) * np.exp(np.log(EXPOSURES).mean())).mean() < 0.012


def test_texels_lie_where_the_picture_says_and_gaps_are_filled(box):
    few = decimated(box, 200)
    atlas = unwrapped(few, 128)
    at = texels(atlas)
    assert 0.3 < len(at.rows) / 128**2 < 0.95
    image = picture(atlas, at, 0.5 + at.of(few.vertices))
    assert np.abs(image[at.rows, at.columns] / 255 - 0.5 - at.of(few.vertices)).max() < 0.01
    empty = np.ones((128, 128), bool)
    empty[at.rows, at.columns] = False
    assert image[empty].any(axis=1).all()  # no black
    again = unwrapped(few, 128)
    assert np.array_equal(again.uv, atlas.uv) and np.array_equal(again.faces, atlas.faces)


@pytest.mark.parametrize("with_texture", [False, True])
def test_a_glb_is_read_by_another_project(box, tmp_path, with_texture):
    texture = textured(box, photos_of(box), 128) if with_texture else None
    (tmp_path / "box.glb").write_bytes(glb_bytes(box, "box", texture))
    (read,) = trimesh.load(tmp_path / "box.glb", process=False).geometry.values()
    source = np.arange(len(box.vertices)) if texture is None else texture.atlas.source
    y_up = box.vertices[source][:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert np.allclose(read.vertices, y_up, atol=1e-6)
    normals = vertex_normals(box)[source][:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert np.allclose(read.vertex_normals, normals, atol=1e-6)
    if texture is not None:
        picture_read = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
        assert np.array_equal(picture_read, texture.image)
        assert np.allclose(read.visual.uv, texture.atlas.uv * [1, -1] + [0, 1], atol=1e-6)  # its v goes upwards
    raw = (tmp_path / "box.glb").read_bytes()
    content = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    assert all(view["byteOffset"] % 4 == 0 for view in content["bufferViews"])
    assert content["buffers"][0]["byteLength"] == len(raw) - 28 - int.from_bytes(raw[12:16], "little")


PIXEL = 2.7 / 192  # approximate size of the photos' pixels at the box


@pytest.mark.parametrize("inwards", [1.0, -1.0])
def test_photos_place_a_surface_that_lies_a_pixel_off(box, inwards):
    """Exposures differ; the bottom, which no photo sees, goes along with what is beside it."""
    off = replace(box, vertices=box.vertices - inwards * PIXEL * vertex_normals(box))
    steps: list[tuple[int, int]] = []
    aligned, pixels = placed(off, photos_of(box), lambda *counts: steps.append(counts))
    assert pixels == pytest.approx(inwards, abs=0.35) and steps[-1] == (42, 42)
    assert np.array_equal(aligned.faces, box.faces)
    seen = box.vertices[:, 2] > -0.38
    flat = seen & (np.sort(np.abs(box.vertices), axis=1)[:, 1] < 0.3)  # Edges have normals between two faces.
    before, after = (np.abs(np.abs(each.vertices).max(axis=1) - 0.4)[flat] / PIXEL for each in (off, aligned))
    assert before.min() > 0.9 and np.median(after) < 0.25 and np.quantile(after, 0.9) < 0.5
    assert np.array_equal(placed(off, photos_of(box))[0].vertices, aligned.vertices)


def test_a_reflection_behind_a_surface_does_not_draw_it_in(box):
    """Photos agree about what lies behind it, as highlights of glossy things do, but their masks show its outline."""
    outside = photos_of(box)
    behind = replace(box, vertices=box.vertices * (1 - 1.2 * PIXEL / 0.4))
    glossy = [replace(photo, image=inner.image) for photo, inner in zip(outside, photos_of(behind), strict=True)]
    moved = _moved(box, glossy, lambda done: None)
    assert moved is not None
    drawn_in, pixels = moved
    assert pixels < -0.6 and outline_iou(drawn_in, outside) < outline_iou(box, outside) - 0.01
    assert placed(box, glossy) == (box, 0.0)


def test_an_outline_is_compared_with_masks_where_nothing_hides_it(box):
    seen, screened = photos_of(box), photos_of(box, screen=True)
    assert outline_iou(box, seen) > 0.97
    half = [replace(photo, own=lambda own=photo.own: own() & (torch.arange(160) >= 80)) for photo in seen]
    assert outline_iou(box, half) == pytest.approx(0.5, abs=0.05)
    hidden = [replace(photo, depth=screen.depth) for photo, screen in zip(half, screened, strict=True)]
    assert outline_iou(box, hidden) > 0.96
    nothing = [replace(photo, own=lambda: torch.zeros(160, 160, dtype=torch.bool)) for photo in seen]
    assert outline_iou(box, nothing) == 0.0


def test_a_surface_of_one_colour_or_of_two_photos_stays(box):
    grey = Mesh(box.vertices, box.faces, box.colors, VOXEL)
    plain = [replace(photo, image=lambda: torch.full((160, 160, 3), 0.4)) for photo in photos_of(box)]
    assert abs(placed(grey, plain)[1]) < 0.05
    assert placed(box, photos_of(box)[:2]) == (box, 0.0)
