"""Mask sources: each file format gives the labels that it was written from; bad input is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, write_image
from PIL import Image
from source_scenes import make, scene_of, truth

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.sources import MASK_SOURCES
from beags_plugin.masks.sources.coco import CocoSource, decoded
from beags_plugin.masks.sources.id_images import GaussianGroupingSource, IdImagesSource
from beags_plugin.masks.sources.object_images import ObjectImagesSource
from beags_plugin.masks.sources.prompts import Prompt, read_prompts
from beags_plugin.system.errors import UserError


def test_every_source_can_be_named_without_its_library():
    assert set(MASK_SOURCES.names()) >= {
        "coco", "gaussian-grouping", "id-images", "object-images", "salient",
        "sam2",
    }  # fmt: skip
    for name in MASK_SOURCES.names():
        kind = MASK_SOURCES.get(name)
        assert kind().unavailable() is None or "pip install" in kind().unavailable()


def test_id_images_and_colours_and_rare_ids(tmp_path):
    scene = scene_of(tmp_path)
    colors = np.array([(0, 0, 0), (250, 10, 10), (10, 250, 10)], np.uint8)
    for index in range(3):
        ids = truth(index)
        if index == 0:
            ids[0, 0] = 77
        write_image(tmp_path / f"masks/v{index}.png", ids)
        write_image(tmp_path / f"painted/v{index}.png", colors[truth(index)])
    (tmp_path / "n.json").write_text('{"1": "cup", "2": "box"}')
    names, maps = make(IdImagesSource(names=Path("n.json")), scene)
    assert names == {0: "background", 1: "cup", 2: "box", 77: "class_77"} and maps[3] is None
    assert maps[0] is not None and maps[0][0, 0] == 77
    names, maps = make(IdImagesSource(least_views=2), scene)
    assert 77 not in names and all(np.array_equal(maps[i], truth(i)) for i in range(3))
    names, maps = make(IdImagesSource(folder=Path("painted"), colors=True), scene)
    assert len(names) == 3
    for index in range(3):
        found, exact = maps[index], truth(index)
        assert found is not None
        pairs = set(zip(found.ravel().tolist(), exact.ravel().tolist(), strict=True))
        assert len(pairs) == 3 and (0, 0) in pairs  # one id for each colour, in all views
    assert {p for i in range(3) for p in zip(maps[i].ravel().tolist(), truth(i).ravel().tolist())} == pairs  # noqa: B905
    painted = tmp_path / "painted/v1.png"
    painted.write_bytes(painted.read_bytes()[:60])
    with pytest.raises(UserError, match="v1.png cannot be read as an image"):
        make(IdImagesSource(folder=Path("painted"), colors=True), scene)
    painted.unlink()
    Image.fromarray(colors[truth(1)]).save(tmp_path / "painted/v1.jpg")
    with pytest.raises(UserError, match="is a JPEG, which blurs the colours"):
        make(IdImagesSource(folder=Path("painted"), colors=True), scene)
    with pytest.raises(UserError, match="holds no image with the name of a photo"):
        make(GaussianGroupingSource(), scene)


def test_ids_of_gaussian_groupings_tracker(tmp_path):
    """8-bit grey as DEVA writes it: ids of no order up to 255, many of them in a view or two only."""
    scene, own = scene_of(tmp_path), np.array([0, 37, 255], np.uint8)
    for index in range(4):
        ids = own[truth(index)]
        ids[11, 0] = 201 + index  # one view each
        ids[11, 19] = 90 if index < 2 else 0
        write_image(tmp_path / f"object_mask/v{index}.png", ids)
    made = GaussianGroupingSource().make(scene, lambda done, total: None)
    assert dict(made.names) == {0: "background", 37: "class_37", 255: "class_255"}
    assert made.notes == ["5 ids in fewer than 3 views became background."]
    for index, class_map in enumerate(made.maps):
        assert class_map is not None
        np.testing.assert_array_equal(class_map, own[truth(index)])
    names, maps = make(GaussianGroupingSource(least_views=2), scene)
    assert set(names) == {0, 37, 90, 255} and maps[1] is not None and maps[1][11, 19] == 90 and maps[1][11, 0] == 0


def test_one_image_per_object_in_either_order(tmp_path):
    scene = scene_of(tmp_path)
    for index in range(2):
        cup = np.uint8(255) * (truth(index) > 0)  # the cup's mask covers the box's: the smaller is seen
        box = np.uint8(255) * (truth(index) == 2)
        for first, second, mask in (("cup", f"v{index}", cup), ("box", f"v{index}", box)):
            write_image(tmp_path / f"a/{first}/{second}.png", mask)
            write_image(tmp_path / f"b/{second}/{first}.png", mask)
    for folder in ("a", "b"):
        names, maps = make(ObjectImagesSource(Path(folder)), scene)
        assert names == {0: "background", 1: "box", 2: "cup"} and maps[2:] == [None, None]
        for index in range(2):
            np.testing.assert_array_equal(maps[index], np.array([0, 2, 1])[truth(index)])
    untold = np.where(truth(0) == 0, np.uint8(128), np.uint8(255))  # Nobody can tell where the cup ends.
    write_image(tmp_path / "a/cup/v0.png", untold)
    _, maps = make(ObjectImagesSource(Path("a")), scene)
    np.testing.assert_array_equal(maps[0], np.array([IGNORE, 2, 1])[truth(0)])


def runs(mask: np.ndarray) -> list[int]:
    """Uncompressed COCO run lengths: column by column, zeros first."""
    flat = mask.T.ravel().astype(int)
    edges = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], edges, [len(flat)]])).tolist()
    return lengths if flat[0] == 0 else [0, *lengths]


def test_coco_run_lengths_polygons_and_instances(tmp_path):
    from pycocotools import mask as library

    scene = scene_of(tmp_path)
    annotations = []
    for index in range(2):
        first, second = truth(index) == 1, truth(index) == 2
        packed = library.encode(np.asfortranarray(second.astype(np.uint8)))
        for track, counts in ((1, runs(first)), (2, packed["counts"].decode())):
            segmentation = {"size": [HEIGHT, WIDTH], "counts": counts}
            annotations.append({"image_id": index, "category_id": 5, "track_id": track, "segmentation": segmentation})
    content = {
        "images": [{"id": i, "file_name": f"some/v{i}.png"} for i in range(3)],
        "categories": [{"id": 5, "name": "thing"}],
        "annotations": annotations,
    }
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    names, maps = make(CocoSource(by="instance"), scene)
    assert names == {0: "background", 1: "thing_1", 2: "thing_2"}
    assert all(np.array_equal(maps[i], truth(i)) for i in range(2))
    assert maps[2] is not None and not maps[2].any() and maps[3] is None  # no object in v2; v3 is not annotated
    names, maps = make(CocoSource(), scene)
    assert names == {0: "background", 1: "thing"} and np.array_equal(maps[0], truth(0) > 0)
    for entry, track in zip(annotations, (1, "two", 1, "two"), strict=True):
        entry["track_id"] = track
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    names, maps = make(CocoSource(by="instance"), scene)
    assert names == {0: "background", 1: "thing_1", 2: "thing_two"} and np.array_equal(maps[1], truth(1))
    annotations[0]["track_id"] = [1]
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="neither a whole number nor a word"):
        make(CocoSource(by="instance"), scene)
    square = decoded([[2, 3, 8, 3, 8, 9, 2, 9]], (HEIGHT, WIDTH), "x")
    assert square[3:9, 2:8].all() and square.sum() == 36
    for wrong, message in (
        ({"size": [3, 3], "counts": [9]}, "is 3x3 pixels but its image is 20x12"),
        ({"size": [HEIGHT, WIDTH], "counts": [3]}, "neither RLE nor polygons"),
        (None, "neither RLE nor polygons"),
    ):
        with pytest.raises(UserError, match=message):
            decoded(wrong, (HEIGHT, WIDTH), "file")


def test_prompts_are_read_and_mistakes_refused(tmp_path):
    path = tmp_path / "prompts.json"
    entry = {"name": "cup", "id": 4, "text": "a cup", "prompts": [
        {"view": "v1", "box": [1, 2, 5, 6], "points": [[2, 3]], "outside": [[9, 9], [8, 8]]}]}  # fmt: skip
    path.write_text(json.dumps({"objects": [entry, {"name": "box", "text": "a box"}]}))
    cup, box = read_prompts(path)
    assert (cup.class_id, cup.name, cup.text) == (4, "cup", "a cup") and (box.class_id, box.prompts) == (2, {})
    assert cup.prompts["v1"] == Prompt((1, 2, 5, 6), ((2, 3), (9, 9), (8, 8)), (True, False, False))
    for wrong, message in (
        ({"objects": []}, 'no list "objects"'),
        ({"objects": [{"prompts": []}]}, "object 1 .* is wrong"),
        ({"objects": [{"name": "a"}]}, "neither prompts nor a text"),
        ({"objects": [{"name": "a", "prompts": [{"view": "v", "box": [5, 0, 1, 1]}]}]}, "left, top, right, bottom"),
        ({"objects": [{"name": "a", "prompts": [{"view": "v", "box": [0, 0, math.inf, 1]}]}]}, "left, top, right"),
        ({"objects": [{"name": "a", "prompts": [{"view": "v", "points": [[math.nan, 1]]}]}]}, "the points .* are not"),
        ({"objects": [{"name": "a", "prompts": [{"view": "v", "outside": [[1, 1]]}]}]}, "or points on the object"),
        ({"objects": [{"name": "a", "id": math.inf, "text": "a"}]}, "object 1 .* is wrong"),
        ({"objects": [entry, {**entry, "name": "other"}]}, "the same id"),
        ({"objects": [{**entry, "id": 70000}]}, "not in 1..65534"),
    ):
        path.write_text(json.dumps(wrong))
        with pytest.raises(UserError, match=message):
            read_prompts(path)
