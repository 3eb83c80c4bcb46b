"""The source ``cut``: prompts in a file to masks of all training views."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from data_folders import write_image
from source_scenes import make
from touching_solids import SETTINGS, pixel_of, solids, views

from beags_plugin.core.membership import Membership
from beags_plugin.masks.sources.base import Photo, SourceScene
from beags_plugin.masks.sources.cut import CutSource, DrawnSource
from beags_plugin.masks.sources.prompts import read_prompts
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

COLOURED = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
POINTS = {"low": (-0.2, 0.0, 0.25), "high": (0.15, 0.0, 0.5), "floor": (-0.7, 0.3, 0.0)}


class Solids:
    """The geometry of a run of the touching solids, whose input frame is half as large."""

    def __init__(self, root) -> None:
        self.cameras = views()
        self.rasterizer, self.settings = make_rasterizer("auto"), SETTINGS
        self._surfels, self.owner = solids(COLOURED)
        self.photos = []
        for index, camera in enumerate(self.cameras):
            path = root / f"images/v{index}.png"
            write_image(path, np.zeros((camera.height, camera.width, 3), np.uint8))
            self.photos.append(Photo(path.stem, path, camera.width, camera.height))
        self.images = [photo.path for photo in self.photos]

    def surfels(self):
        return self._surfels

    def input_means(self):
        return self._surfels.means.double() / 2

    def to_straight(self, labels: np.ndarray, view: int) -> np.ndarray:
        return labels

    def to_photo(self, labels: np.ndarray, view: int) -> np.ndarray:
        return labels

    def exact(self, view: int) -> np.ndarray:
        inputs = geometry_inputs(self._surfels, self.owner.int())
        light = self.rasterizer.class_channels(inputs, self.cameras[view], self.settings, 3)
        return torch.where(light.amax(dim=-1) > 0.5, light.argmax(dim=-1), 0).numpy()

    def pixel(self, view: int, name: str) -> list[int]:
        row, column = pixel_of(self.cameras[view], POINTS[name])
        return [column, row]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return Solids(tmp_path_factory.mktemp("solids"))


def scene_with(run, folder, objects, photos=None) -> SourceScene:
    (folder / "prompts.json").write_text(json.dumps({"objects": objects}))
    return SourceScene(folder, photos or run.photos, run)


def low(run, view: int = 3, **more):
    return {"name": "low", "id": 7, "prompts": [{"view": f"v{view}", "points": [run.pixel(view, "low")], **more}]}


def test_objects_are_drawn_into_all_training_views_behind_what_hides_them(run, tmp_path):
    """Each object's points lie beside the other, so that none needs more than the floor's."""
    objects = [low(run, outside=[run.pixel(3, "floor")])]
    objects.append({"name": "high", "prompts": [{"view": "v3", "points": [run.pixel(3, "high")]}]})
    photos = [replace(photo, trained=index != 6) for index, photo in enumerate(run.photos)]
    names, maps = make(CutSource(), scene_with(run, tmp_path, objects, photos))
    assert names == {0: "background", 7: "low", 2: "high"}
    for view, labels in enumerate(maps):
        if view == 6:
            assert labels is None
            continue
        exact = run.exact(view)
        assert labels is not None and labels.dtype == np.uint16
        for class_id, number in ((7, 1), (2, 2)):
            found, truth = labels == class_id, exact == number
            if truth.sum() > 50:
                assert (found & truth).sum() / (found | truth).sum() > 0.9


@pytest.mark.parametrize("class_ids", [(1, 2), (2, 1)])
def test_of_objects_that_share_gaussians_the_smaller_is_drawn(run, tmp_path, class_ids):
    """The cut of both solids took the low block too, as a table's takes what stands on it."""
    both, block = run.owner >= 1, run.owner == 1
    large, small = class_ids
    members = Membership.of_masks({large: both, small: block}, torch.zeros(len(both), dtype=torch.int32))
    source = DrawnSource(members, {0: "background", large: "both", small: "low"})
    _, maps = make(source, SourceScene(tmp_path, run.photos, run))
    alone = Membership.of_masks({5: both}, torch.zeros(len(both), dtype=torch.int32))
    _, outlines = make(DrawnSource(alone, {5: "both"}), SourceScene(tmp_path, run.photos, run))
    assert sum((run.exact(view) == 1).sum() for view in range(len(maps))) > 500
    for view, (labels, outline) in enumerate(zip(maps, outlines, strict=True)):
        exact = run.exact(view) == 1
        found = labels == small
        assert (found & exact).sum() >= 0.95 * (found | exact).sum()
        assert ((labels != 0) == (outline != 0)).all(), "no gap between the two"


def test_a_stroke_is_points_along_it(run, tmp_path):
    first, last = run.pixel(3, "low"), run.pixel(3, "high")
    stroke = {"name": "both", "prompts": [{"view": "v3", "strokes": [[first, last]]}]}
    _, maps = make(CutSource(), scene_with(run, tmp_path, [stroke]))
    (prompted,) = read_prompts(tmp_path / "prompts.json")
    points = np.array(prompted.prompts["v3"].points)
    assert points[0].tolist() == first and points[-1].tolist() == last and all(prompted.prompts["v3"].inside)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= 4.0
    found, truth = maps[3] == 1, run.exact(3) > 0
    assert (found & truth).sum() / (found | truth).sum() > 0.9


def test_a_stroke_beside_the_object_keeps_off_what_it_crosses(run, tmp_path):
    row, column = pixel_of(run.cameras[3], (0.15, 0.25, 0.5))
    both = {"view": "v3", "strokes": [[run.pixel(3, "low"), run.pixel(3, "high")]]}
    _, wide = make(CutSource(), scene_with(run, tmp_path, [{"name": "one", "prompts": [both]}]))
    one = {"view": "v3", "strokes": [[run.pixel(3, "low")]]}  # This stroke has a single place, as a click.
    one["outside_strokes"] = [[run.pixel(3, "high"), [column, row]], [run.pixel(3, "floor")]]
    _, maps = make(CutSource(), scene_with(run, tmp_path, [{"name": "one", "prompts": [one]}]))
    (prompted,) = read_prompts(tmp_path / "prompts.json")
    assert sum(prompted.prompts["v3"].inside) == 1 < len(prompted.prompts["v3"].inside) - 2
    exact = run.exact(3)
    found, truth = maps[3] == 1, exact == 1
    assert (found & truth).sum() / (found | truth).sum() > 0.9
    high = exact == 2
    assert (wide[3][high] == 1).mean() > 0.9 and (maps[3][high] == 1).mean() < 0.05


@pytest.mark.parametrize(
    ("stroke", "message"),
    [
        ({"strokes": [[[20, 20], [500, 20]]]}, r"\[9\d, 20\] of one in v3 lies outside"),
        ({"strokes": [[[20, 20], [float("inf"), 20]]]}, "object 1 of the prompts .* is wrong"),
        ({"strokes": [[20, 20], [30, 30]]}, "object 1 of the prompts .* is wrong"),
        ({"strokes": [[]]}, "object 1 of the prompts .* is wrong"),
        ({"outside_strokes": [[[20, 20], [30, 20]]]}, "gives no point on one"),
    ],
)
def test_bad_strokes_end_with_a_sentence(run, tmp_path, stroke, message):
    with pytest.raises(UserError, match=message):
        make(CutSource(), scene_with(run, tmp_path, [{"name": "one", "prompts": [{"view": "v3", **stroke}]}]))


def test_a_stroke_on_the_object_that_crosses_one_beside_it_contradicts(run, tmp_path):
    one = {"view": "v3", "strokes": [[run.pixel(3, "low"), run.pixel(3, "high")]]}
    one["outside_strokes"] = [[run.pixel(3, "high"), run.pixel(3, "floor")]]
    with pytest.raises(UserError, match="is both on one and beside it: remove one"):
        make(CutSource(), scene_with(run, tmp_path, [{"name": "one", "prompts": [one]}]))


def test_space_is_that_of_the_input_poses(run, tmp_path):
    both = {"name": "both", "prompts": [{"view": "v3", "points": [run.pixel(3, "low"), run.pixel(3, "high")]}]}
    both["space"] = [{"plane": [0, 0, 1, 0.06]}]
    _, maps = make(CutSource(), scene_with(run, tmp_path, [both]))
    labels = maps[3]
    row, column = pixel_of(run.cameras[3], (-0.4, 0.0, 0.08))
    assert labels[row, column] == 0, "below the plane"
    row, column = pixel_of(run.cameras[3], (-0.4, 0.0, 0.2))
    assert labels[row, column] == 1


def test_a_cut_of_more_than_half_of_the_scene_is_said_and_no_other(run, tmp_path):
    floor = {"name": "floor", "prompts": [{"view": "v3", "points": [run.pixel(3, "floor")]}]}
    made = CutSource().make(scene_with(run, tmp_path, [low(run), floor]), lambda done, total: None)
    assert (run.owner == 0).double().mean() > 0.5
    (note,) = made.notes
    assert note.startswith("The cut of floor takes more than half of the scene (") and note.endswith("draw a box.")


BAD = {
    "no point on the object": (lambda run: low(run, points=[], box=[0, 0, 90, 80]), "gives no point on low"),
    "a view that does not exist": (lambda run: {**low(run), "prompts": [{"view": "v99", "points": [[1, 1]]}]}, "'v99'"),
    "a point outside of the image": (lambda run: low(run, outside=[[500, 3]]), r"\[500, 3\] of low in v3 lies outside"),
    "a box outside of the image": (lambda run: low(run, box=[500, 3, 600, 9]), "lies outside its image"),
    "contradicting points": (lambda run: low(run, outside=[run.pixel(3, "low")]), "is both on low and beside it"),
    "a point outside of its box": (lambda run: low(run, box=[0, 0, 5, 5]), "lies outside a box or another limit"),
    "a region that is none": (lambda run: {**low(run), "space": [{"sphere": [0, 0, 0, -1]}]}, "radius -1.0"),
    "a plane without normal": (lambda run: {**low(run), "space": [{"plane": [0, 0, 0, 1]}]}, "the normal of a plane"),
    "a box turned around": (lambda run: {**low(run), "space": [{"box": [[1, 1, 1], [0, 0, 0]]}]}, "is not a lower"),
    "a region unknown": (lambda run: {**low(run), "space": [{"cone": [0, 0, 0, 1]}]}, "none of box, sphere and plane"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_prompts_end_with_a_sentence(name, run, tmp_path):
    prompts, message = BAD[name]
    with pytest.raises(UserError, match=message):
        make(CutSource(), scene_with(run, tmp_path, [prompts(run)]))


def test_a_held_out_view_is_not_prompted(run, tmp_path):
    photos = [replace(photo, trained=index != 3) for index, photo in enumerate(run.photos)]
    with pytest.raises(UserError, match="prompts in v3, which is held out"):
        make(CutSource(), scene_with(run, tmp_path, [low(run)], photos))


def test_a_run_of_other_photos_is_refused(run, tmp_path):
    photos = [replace(photo, path=tmp_path / photo.path.name) for photo in run.photos]
    with pytest.raises(UserError, match="was trained on .*, which is no image of"):
        make(CutSource(), scene_with(run, tmp_path, [low(run)], photos))
