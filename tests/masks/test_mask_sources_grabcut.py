"""GrabCut from boxes: its cuts, labels carried by depth, and outlines that snap to edges."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from source_scenes import Wall, coloured, make

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.snapping import snap_to_edges
from beags_plugin.masks.sources.base import SourceScene
from beags_plugin.masks.sources.grabcut import GrabCutSource, carry, cut_by_box
from beags_plugin.masks.sources.prompts import Prompt
from beags_plugin.system.errors import UserError


def overlap(found: np.ndarray, exact: np.ndarray) -> float:
    return (found & exact).sum() / (found | exact).sum()


def test_grabcut_finds_the_object_in_its_box_and_repeats_itself():
    photo, disc = coloured()
    prompt = Prompt((12, 17, 48, 53))
    found = cut_by_box(photo, prompt)
    assert overlap(found, disc) > 0.95
    np.testing.assert_array_equal(found, cut_by_box(photo, prompt))
    with pytest.raises(UserError, match="outside its image"):
        cut_by_box(photo, Prompt((200, 10, 220, 30)))


def test_labels_are_carried_by_depth(tmp_path):
    wall = Wall(tmp_path)
    given = (7 * wall.discs[0]).astype(np.uint16)
    for index, (labels, sure) in enumerate(carry(wall, range(3), [given, None, None], [7], 0.02)):
        known = labels != IGNORE
        np.testing.assert_array_equal((labels == 7)[known], wall.discs[index][known])
        assert known[:, 10 * index :].all() and not known[:, : 10 * index].any() and sure[known].all()


def test_grabcut_fills_the_other_views(tmp_path):
    wall = Wall(tmp_path)
    prompts = {"objects": [{"name": "disc", "id": 7, "prompts": [{"view": "v0", "box": [12, 17, 48, 53]}]}]}
    (tmp_path / "prompts.json").write_text(json.dumps(prompts))
    names, maps = make(GrabCutSource(), SourceScene(tmp_path, wall.photos, wall))
    assert names == {0: "background", 7: "disc"}
    for disc, labels in zip(wall.discs, maps, strict=True):
        assert labels is not None and set(np.unique(labels)) == {0, 7} and overlap(labels == 7, disc) > 0.95
    held_out = SourceScene(tmp_path, wall.photos, Wall(tmp_path, known=2))
    prompts["objects"][0]["prompts"][0]["view"] = "v2"
    (tmp_path / "prompts.json").write_text(json.dumps(prompts))
    with pytest.raises(UserError, match="prompts in v2, which is held out"):
        make(GrabCutSource(), held_out)
    photos = [replace(photo, trained=index < 2) for index, photo in enumerate(wall.photos)]
    with pytest.raises(UserError, match="prompts in v2, which is held out"):
        make(GrabCutSource(), SourceScene(tmp_path, photos, wall))
    with pytest.raises(UserError, match="was trained on .*elsewhere.*, which is no image of"):
        make(GrabCutSource(), SourceScene(tmp_path, wall.photos, Wall(tmp_path / "elsewhere")))


def test_held_out_views_get_masks_to_look_at_that_do_not_vote(tmp_path):
    wall = Wall(tmp_path)
    prompts = {"objects": [{"name": "disc", "prompts": [{"view": "v0", "box": [12, 17, 48, 53]}]}]}
    (tmp_path / "prompts.json").write_text(json.dumps(prompts))
    photos = [replace(photo, trained=index < 2) for index, photo in enumerate(wall.photos)]
    made = {
        held_out: GrabCutSource(held_out=held_out).make(SourceScene(tmp_path, photos, wall), lambda *_: None)
        for held_out in (False, True)
    }
    usual, more = (list(made[held_out].maps) for held_out in (False, True))
    assert made[True].to_look_at == {2} and not made[False].to_look_at
    assert usual[2] is None and more[2] is not None
    assert overlap(more[2] == 1, wall.discs[2]) > 0.95
    for a, b in zip(usual[:2], more[:2], strict=True):
        np.testing.assert_array_equal(a, b)


def test_outlines_snap_to_the_edge_of_the_photo():
    photo, disc = coloured()
    exact = disc.astype(np.uint16)
    ragged = exact.copy()
    row, column = np.mgrid[:70, :90]
    bumps = (row // 4 + column // 4) % 2 == 0
    from scipy import ndimage

    ragged[ndimage.binary_dilation(disc, iterations=2) & bumps] = 1
    ragged[0, 0] = IGNORE
    snapped = snap_to_edges(ragged, photo, 4)
    assert snapped[0, 0] == IGNORE
    snapped[0, 0] = 0
    assert (snapped != exact).sum() < 0.4 * (ragged != exact).sum()
    far = ndimage.distance_transform_edt(~(ndimage.binary_dilation(disc, iterations=3) & ~ndimage.binary_erosion(disc)))
    assert not ((snapped != ragged) & (far > 8))[5:].any()
    np.testing.assert_array_equal(snap_to_edges(ragged, photo, 0), ragged)


def test_plain_opencv_has_no_guided_filter(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    # Plain opencv, installed over contrib, leaves such a shell.
    monkeypatch.setattr(cv2, "ximgproc", type("shell", (), {}))
    labels = np.zeros((8, 9), np.uint16)
    labels[2:5] = 1
    with pytest.raises(UserError, match="run beags doctor"):
        snap_to_edges(labels, np.zeros((8, 9, 3), np.uint8), 2)
