"""Faces where objects touch: which places another object hides, and what closes them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")

from disc_meshes import discs_on
from random_surfels import SETTINGS, camera_at
from scipy.ndimage import binary_fill_holes

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.surfaces.closing_gaussians import joined
from beags_plugin.surfaces.contact_faces import ContactFaces, Witnesses, contact_faces
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions

BOX, BLOCK = 1, 2
NAMES = {0: "background", BOX: "box", BLOCK: "block"}
GREY = (0.5, 0.5, 0.5)
EYES = [(2.2 * np.cos(angle), 2.2 * np.sin(angle), 2.0) for angle in np.arange(8) * np.pi / 4 + 0.3]
VIEWS = Viewpoints([camera_at(eye) for eye in EYES], make_rasterizer("auto"), SETTINGS)


def box_mesh(side: float, middle: float) -> Mesh:
    """A box about (0, 0, middle)."""
    box = trimesh.creation.box((side,) * 3)
    for _ in range(4):
        box = box.subdivide()
    vertices = np.array(box.vertices) + [0.0, 0.0, middle]
    return Mesh(vertices, np.array(box.faces), np.tile(np.float32(GREY), (len(vertices), 1)), 0.02)


def is_open(discs: Surfels) -> torch.Tensor:
    """Return which discs of the box or the block no photo shows: undersides, and the lid below the block."""
    x, y, z = discs.means.T
    return (z < 0.01 - 0.4) | ((z - 0.4).abs() < 0.01) & (torch.maximum(x.abs(), y.abs()) < 0.15)


def stacked() -> tuple[Surfels, torch.Tensor, Surfels]:
    """A block on a box, their class ids, and what is missing of them: the face where they touch and the underside."""
    whole = joined(box := discs_on(box_mesh(0.8, 0.0)), block := discs_on(box_mesh(0.3, 0.55)))
    ids = torch.tensor([BOX] * len(box) + [BLOCK] * len(block), dtype=torch.int32)
    missing = is_open(whole)
    return whole[~missing], ids[~missing], whole[missing & (ids == BOX)]


def shown_classes(surfels, class_ids, views) -> list[torch.Tensor]:
    """The exact labels of all views: the class of what they show."""
    found = []
    for camera in views.cameras:
        depths = []
        for class_id in (BOX, BLOCK):
            part = geometry_inputs(surfels[class_ids == class_id])
            depth = views.rasterizer.rasterize(part, camera, SETTINGS, torch.zeros(3)).median_depth
            depths.append(torch.where(depth > 0, depth, torch.inf))
        nearest = torch.stack(depths)
        label = nearest.argmin(dim=0).int() + 1
        found.append(torch.where(nearest.amin(dim=0).isfinite(), label, 0).int())
    return found


def closed_scene(monkeypatch, surfels, ids, labels) -> ContactFaces:
    """The scene's contact faces, where closing makes all that is missing of the box."""
    missing = stacked()[2]

    def closing(item, options):
        assert item.views.cameras is VIEWS.cameras and item.views.scene is surfels
        assert len(item.surfels) == int((ids == item.class_ids[0]).sum())
        return (missing if item.name == "box" else missing[:0]), ""

    monkeypatch.setattr("beags_plugin.surfaces.contact_faces.closing_gaussians", closing)
    seen: list[tuple[int, int]] = []
    found = contact_faces(
        surfels, Membership(ids), NAMES, VIEWS, labels, MeshOptions(), lambda done, total: seen.append((done, total))
    )
    assert {total for _, total in seen} == {2 + len(VIEWS.cameras)}
    assert [done for done, _ in seen] == list(range(2 + len(VIEWS.cameras) + 1))
    return found


def test_the_lid_below_a_block_is_closed_and_no_underside(monkeypatch):
    surfels, ids, missing = stacked()
    found = closed_scene(monkeypatch, surfels, ids, shown_classes(surfels, ids, VIEWS))
    assert found.class_ids.unique().tolist() == [BOX] and len(found.class_ids) == len(found.surfels)
    lid = missing[missing.means[:, 2] > 0]
    assert len(found.surfels) > 0.9 * len(lid) > 20
    assert float(found.surfels.means[:, 2].min()) > 0.39  # nobody looks at the box from below


def test_a_hole_that_lies_open_stays_open(monkeypatch):
    """With the block far below the scene every view looks into the hole."""
    surfels, ids, _ = stacked()
    labels = [torch.where(label == BLOCK, 0, label) for label in shown_classes(surfels, ids, VIEWS)]
    surfels.means[ids == BLOCK] -= 30.0
    found = closed_scene(monkeypatch, surfels, ids, labels)
    assert len(found.surfels) == len(found.class_ids) == 0


@pytest.mark.slow("fuses the surfaces of a whole scene")
def test_the_box_is_closed_and_not_lined_within():
    """Nothing is patched: drawn alone, the box shows its inside through the hole, which could pass for its surface."""
    surfels, ids, _ = stacked()
    views = Viewpoints([camera_at(eye, pixels=192) for eye in EYES], make_rasterizer("auto"), SETTINGS)
    options = MeshOptions(resolution=96, min_views=1)
    labels = shown_classes(surfels, ids, views)
    found = contact_faces(surfels, Membership(ids), NAMES, views, labels, options, lambda done, total: None)
    assert found.class_ids.unique().tolist() == [BOX]
    assert float(found.surfels.means.abs().max()) < 0.4, "inside the box"
    above = camera_at((0.3, 0.2, 3.0), pixels=192)

    def pierced(box: Surfels) -> int:
        alpha = VIEWS.rasterizer.rasterize(geometry_inputs(box), above, SETTINGS, torch.zeros(3)).alpha > 0.5
        return int((binary_fill_holes(alpha.numpy()) & ~alpha.numpy()).sum())

    box = surfels[ids == BOX]
    assert pierced(joined(box, found.surfels)) < 0.1 * pierced(box)
    assert float(found.surfels.means[:, 2].min()) > 0.3


def test_an_object_alone_touches_nothing_and_no_surface_is_made(monkeypatch):
    surfels, ids, _ = stacked()
    labels = shown_classes(surfels, ids, VIEWS)
    monkeypatch.setattr("beags_plugin.surfaces.contact_faces.closing_gaussians", lambda *_: 1 / 0)
    alone = surfels[ids == BLOCK], Membership(ids[ids == BLOCK])
    assert not len(contact_faces(*alone, NAMES, VIEWS, labels, MeshOptions(), print).surfels)


def test_views_without_labels_say_nothing(monkeypatch):
    surfels, ids, _ = stacked()
    assert not len(closed_scene(monkeypatch, surfels, ids, [None] * len(EYES)).surfels)


@pytest.mark.parametrize(
    ("shown", "depth", "hidden", "open_"),
    [
        (BLOCK, 1.9, 1, 0),  # The neighbour lies before the place.
        (BLOCK, 2.02, 0, 0),  # It lies just behind, within the error of depths.
        (BLOCK, 2.2, 0, 1),  # The view looks through.
        (0, 1.9, 0, 1),  # The background lies before it.
        (0, 2.0, 0, 0),  # It lies at the place: undecided.
        (0, 0.0, 0, 1),  # Nothing is there at all.
        (BOX, 1.9, 0, 0),  # Its own object hides it.
        (BOX, 2.0, 0, 1),  # Its own object has a surface there.
        (IGNORE, 1.9, 0, 0),
    ],
)
def test_what_a_view_says_of_a_place(shown, depth, hidden, open_):
    place = discs_on(box_mesh(0.8, 0.0))[:1]
    place.means[:], place.quats[:] = 0.0, torch.tensor([1.0, 0.0, 0.0, 0.0])  # It faces up.
    witnesses = Witnesses(place, torch.tensor([BOX], dtype=torch.int32))
    for eye in ((0.01, 0.0, 2.0), (0.01, 0.0, -2.0), (2.0, 0.0, 0.01)):  # eyes above, below and beside it
        camera = camera_at(eye)
        size = camera.height, camera.width
        witnesses.add(camera, torch.full(size, shown, dtype=torch.int32), torch.full(size, depth))
    assert (int(witnesses.hidden), int(witnesses.open)) == (hidden, open_)
    assert not witnesses.in_contact().any()  # one view is not enough
    witnesses.add(camera_at((0.0, 0.01, 2.0)), torch.full(size, shown, dtype=torch.int32), torch.full(size, depth))
    assert witnesses.in_contact().tolist() == [hidden > 0]
