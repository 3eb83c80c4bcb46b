"""Mask sources: each file format gives the map that it was written from; bad input is told in one sentence."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import HEIGHT, WIDTH, write_image, write_transforms
from PIL import Image
from run_folders import write_scene, write_trained

from beags_plugin.cli import main
from beags_plugin.core.cameras import Camera
from beags_plugin.data.files import photo_names
from beags_plugin.errors import UserError
from beags_plugin.masks.classes import read_class_map
from beags_plugin.masks.rims import snap_to_edges
from beags_plugin.masks.sources import MASK_SOURCES
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene
from beags_plugin.masks.sources.coco import CocoSource, decoded
from beags_plugin.masks.sources.grabcut import GrabCutSource, carry, cut_by_box
from beags_plugin.masks.sources.id_images import GaussianGroupingSource, IdImagesSource
from beags_plugin.masks.sources.langsplat import LangSplatSource
from beags_plugin.masks.sources.matching import PhotoNames
from beags_plugin.masks.sources.object_images import ObjectImagesSource
from beags_plugin.masks.sources.prompts import Prompt, read_prompts
from beags_plugin.plugin.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.made_masks import make_masks
from beags_plugin.rasterizers.interface import IGNORE


def scene_of(root: Path, count: int = 4) -> SourceScene:
    photos = []
    for index in range(count):
        path = root / f"images/v{index}.png"
        write_image(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        photos.append(Photo(path.stem, path, WIDTH, HEIGHT))
    return SourceScene(root, photos)


def truth(index: int) -> np.ndarray:
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2:8, 1 + index : 7 + index], ids[5:11, 10:16] = 1, 2
    return ids


def maps_of(made: MadeMasks) -> list[np.ndarray | None]:
    return list(made.maps)


def make(source, scene) -> tuple[dict[int, str], list[np.ndarray | None]]:
    made = source.make(scene, lambda done, total: None)
    return dict(made.names), maps_of(made)


def test_every_source_can_be_named_without_its_library():
    assert set(MASK_SOURCES.names()) >= {
        "coco", "gaussian-grouping", "grabcut", "id-images", "langsplat", "object-images", "sam2",
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
    with pytest.raises(UserError, match="holds no image named as one"):
        make(GaussianGroupingSource(), scene)


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


def test_langsplat_segments_are_matched_by_features(tmp_path):
    scene = scene_of(tmp_path)
    generator = np.random.default_rng(0)
    features = np.eye(8)[:3]
    for index in range(3):
        order = generator.permutation(3)  # segments are numbered anew in each view
        maps = np.full((4, HEIGHT, WIDTH), -1)
        for exact in (1, 2):
            maps[3][truth(index) == exact] = int(np.flatnonzero(order == exact)[0])
        rows = features[order] + 0.02 * generator.normal(size=(3, 8))
        (tmp_path / "language_features").mkdir(exist_ok=True)
        np.save(tmp_path / f"language_features/v{index}_s.npy", maps)
        np.save(tmp_path / f"language_features/v{index}_f.npy", rows)
    names, maps = make(LangSplatSource(), scene)
    assert len(names) == 3 and maps[3] is None
    pairs = {p for i in range(3) for p in zip(maps[i].ravel().tolist(), truth(i).ravel().tolist(), strict=True)}
    assert len(pairs) == 3 and (IGNORE, 0) in pairs
    (tmp_path / "language_features/v1_f.npy").write_bytes(b"no array")
    with pytest.raises(UserError, match="v1_f.npy cannot be read as an array"):
        make(LangSplatSource(), scene)
    (tmp_path / "language_features/v1_f.npy").unlink()
    with pytest.raises(UserError, match="segments of two views cannot be matched"):
        make(LangSplatSource(), scene)


def test_prompts_are_read_and_mistakes_told(tmp_path):
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
        ({"objects": [{"name": "a", "id": math.inf, "text": "a"}]}, "object 1 .* is wrong"),
        ({"objects": [entry, {**entry, "name": "other"}]}, "the same id"),
        ({"objects": [{**entry, "id": 70000}]}, "not in 1..65534"),
    ):
        path.write_text(json.dumps(wrong))
        with pytest.raises(UserError, match=message):
            read_prompts(path)


def coloured(width: int = 90, height: int = 70, left: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """A photo of a red disc on a textured grey ground, and the disc's mask."""
    generator = np.random.default_rng(left)
    row, column = np.mgrid[:height, :width] + 0.5
    disc = (row - 35) ** 2 + (column - left) ** 2 < 15**2
    photo = np.where(disc[..., None], (190, 50, 40), (110, 120, 115)) + generator.integers(-12, 12, (height, width, 3))
    return photo.astype(np.uint8), disc


def test_grabcut_finds_the_object_in_its_box_and_repeats_itself():
    photo, disc = coloured()
    prompt = Prompt((12, 17, 48, 53))
    found = cut_by_box(photo, prompt)
    assert (found & disc).sum() / (found | disc).sum() > 0.95
    np.testing.assert_array_equal(found, cut_by_box(photo, prompt))
    with pytest.raises(UserError, match="outside its image"):
        cut_by_box(photo, Prompt((200, 10, 220, 30)))


class Wall:
    """Three cameras side by side before a wall at depth 2: what one sees at x another sees ``shift`` pixels farther."""

    def __init__(self, root: Path, known: int = 3) -> None:
        self.photos, self.discs = [], []
        for index in range(3):
            photo, disc = coloured(left=30 + 10 * index)
            path = root / f"images/v{index}.png"
            write_image(path, photo)
            self.photos.append(Photo(path.stem, path, 90, 70))
            self.discs.append(disc)
        self.images = [photo.path for photo in self.photos[:known]]
        K = torch.tensor([[100.0, 0, 45], [0, 100.0, 35], [0, 0, 1]])
        self.cameras = []
        for index in range(known):
            viewmat = torch.eye(4)
            viewmat[0, 3] = 0.2 * index  # 10 pixels at depth 2
            self.cameras.append(Camera(viewmat, K, 90, 70))

    def depth(self, view: int) -> torch.Tensor:
        return torch.full((70, 90), 2.0)

    def to_straight(self, class_map: np.ndarray, view: int) -> np.ndarray:
        return class_map

    def to_photo(self, class_map: np.ndarray, view: int) -> np.ndarray:
        return class_map


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
    for disc, class_map in zip(wall.discs, maps, strict=True):
        assert class_map is not None and set(np.unique(class_map)) == {0, 7}
        found = class_map == 7
        assert (found & disc).sum() / (found | disc).sum() > 0.95
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
    assert ((more[2] == 1) & wall.discs[2]).sum() / ((more[2] == 1) | wall.discs[2]).sum() > 0.95
    for a, b in zip(usual[:2], more[:2], strict=True):
        np.testing.assert_array_equal(a, b)


def test_rims_snap_to_the_edge_of_the_photo():
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


def test_the_command_writes_masks_that_training_finds(tmp_path, capsys):
    write_transforms(tmp_path)
    for index in range(9):
        write_image(tmp_path / f"objects/cup/v{index:02d}.png", np.uint8(255) * (truth(0) == 1))
    arguments = ["masks", "make", "--data", str(tmp_path), "--source", "object-images", "--options", "folder=objects"]
    main(arguments)
    out = capsys.readouterr().out
    assert "9 masks of 9 views, 1 objects" in out and (tmp_path / "made.png").exists()
    metadata = BeagsDataParserConfig(data=tmp_path).setup().get_dataparser_outputs("train").metadata
    assert metadata["classes"] == {0: "background", 1: "cup"} and all(metadata["class_map_filenames"])
    np.testing.assert_array_equal(read_class_map(tmp_path / "masks/v03.png"), truth(0) == 1)
    extra = tmp_path / "objects"
    for index in range(5, 9):
        (extra / f"cup/v{index:02d}.png").unlink()
    write_image(tmp_path / "masks/other/v08.png", truth(0))
    main([*arguments, "--overwrite"])
    assert "5 masks of 9 views" in capsys.readouterr().out
    assert sorted(path.stem for path in (tmp_path / "masks").rglob("*.png")) == [f"v{i:02d}" for i in range(5)]
    kept = {path: path.read_bytes() for path in (*(tmp_path / "masks").glob("*.png"), tmp_path / "classes.json")}
    write_image(extra / "cup/v04.png", np.zeros((3, 3), np.uint8))  # found out after those before it are made
    with pytest.raises(SystemExit):
        main([*arguments, "--overwrite"])
    write_image(extra / "cup/v04.png", truth(0))
    write_image(extra / "background/v03.png", truth(0))
    with pytest.raises(SystemExit):
        main([*arguments, "--overwrite"])
    assert "the name 'background' to two classes" in " ".join(capsys.readouterr().out.split())
    assert all(path.read_bytes() == content for path, content in kept.items())
    assert not list(tmp_path.glob(".masks_*"))
    for wrong, message in (
        (arguments, "has masks or a classes.json already"),
        ([*arguments[:5], "nothing"], "there is no mask source 'nothing'"),
        ([*arguments[:-1], "color=red"], "has no option 'color=red'"),
        ([*arguments[:5], "grabcut", "--overwrite"], "needs the scene's depth"),
    ):
        with pytest.raises(SystemExit):
            main(wrong)
        assert message in " ".join(capsys.readouterr().out.split())


@dataclass(frozen=True)
class Scripted(MaskSource):
    """Masks of all views, those of ``aside`` only to look at; breaks off before the view ``breaks``."""

    aside: tuple[int, ...] = ()
    breaks: int = 99

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        def maps():
            for index in range(len(scene.photos)):
                if index == self.breaks:
                    raise UserError("broken off")
                yield truth(0).astype(np.uint16)

        return MadeMasks({0: "background", 1: "cup", 2: "box"}, maps(), [], frozenset(self.aside))


def test_masks_to_look_at_are_guarded_and_whole_as_the_others(tmp_path):
    write_transforms(tmp_path)
    data = BeagsDataParserConfig(data=tmp_path)
    lines = " ".join(make_masks(data, Scripted(aside=(0, 8))))
    assert "7 masks of 9 views, 2 objects" in lines and "2 masks of held-out views, only to look at" in lines
    aside = tmp_path / "masks_to_look_at"
    assert sorted(path.name for path in aside.iterdir()) == ["v00.png", "v08.png"]
    for path in (*(tmp_path / "masks").iterdir(), tmp_path / "classes.json"):
        path.unlink()
    with pytest.raises(UserError, match=r"already \(masks_to_look_at/v0[08].png\): add --overwrite"):
        make_masks(data, Scripted())
    kept = {path: path.read_bytes() for path in aside.iterdir()}
    with pytest.raises(UserError, match="broken off"):
        make_masks(data, Scripted(aside=(0, 1), breaks=4), overwrite=True)
    assert {path: path.read_bytes() for path in aside.iterdir()} == kept and not list((tmp_path / "masks").iterdir())
    make_masks(data, Scripted(), overwrite=True)
    assert not list(aside.iterdir()) and len(list((tmp_path / "masks").iterdir())) == 9  # none of a former run stays
    with pytest.raises(UserError, match="gave no mask"):
        make_masks(data, Scripted(aside=tuple(range(9))), overwrite=True)


@pytest.mark.parametrize("lens", [{}, {"k1": -0.12, "k2": 0.02}])
def test_reprojection_of_a_run_writes_masks_of_the_photos_size(tmp_path, lens, capsys):
    data = write_scene(tmp_path / "scene")
    if lens:
        meta = json.loads((data / "transforms.json").read_text())
        (data / "transforms.json").write_text(json.dumps({**meta, **lens}))
    config = write_trained(tmp_path / "run", data)
    method, output = ("auto" if lens else "pairwise"), str(tmp_path / "out")
    main(["masks", "reproject", "--load-config", str(config), "--method", method, "--output", output])
    assert ("reprojection pairwise: 7 views have" in " ".join(capsys.readouterr().out.split())) == (method == "auto")
    masks = sorted((tmp_path / "out/masks").glob("*.png"))
    assert [path.stem for path in masks] == [f"v{index:02d}" for index in range(1, 8)]
    assert all(read_class_map(path).shape == (HEIGHT, WIDTH) for path in masks)
    assert (tmp_path / "out/before_after.png").exists() and (tmp_path / "out/confidence/v01.png").exists()
    confidence = [read_class_map(tmp_path / "out/confidence" / path.name) for path in masks]
    assert all(values.shape == (HEIGHT, WIDTH) and values.max() > 0 for values in confidence)
    for mask, values in zip(masks, confidence, strict=True):
        unlabelled = read_class_map(mask) == IGNORE
        assert not values[unlabelled].any()  # where the straight view does not reach, or nothing voted
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["method"] == "pairwise"
    before = read_class_map(data / "masks/v01.png")
    after = read_class_map(masks[0])
    if not lens:
        assert report["views"][0]["changed"] == int((before != after).sum())
    main(["masks", "check", "--load-config", str(config), "--masks-path", str(tmp_path / "out/masks"),
          "--output", str(tmp_path / "check")])  # fmt: skip
    assert (tmp_path / "check/report.json").exists()


def test_the_check_of_a_run_takes_its_options_and_what_replaces_them(tmp_path):
    from beags_plugin.plugin.extract import read_scene
    from beags_plugin.plugin.masks_check import options_beside
    from beags_plugin.plugin.reprojected_run import ReprojectionOptions, data_of_run

    data = write_scene(tmp_path / "scene")
    config = write_trained(tmp_path / "run", data)
    own = options_beside(config, None)
    assert own.data == data and own.orientation_method == "none"  # as the run was trained
    (data / "masks").rename(data / "others")
    parser = options_beside(config, None, masks_path=Path("others"), ignore_ids=(2,), layout=None)
    assert (parser.layout, parser.orientation_method) == (own.layout, "none")
    manager = data_of_run(read_scene(config), config, ReprojectionOptions(run_size=True, parser=parser))
    labels = manager.views("train")[0].labels
    assert labels is not None and set(labels.unique().tolist()) == {0, 1, IGNORE}
    main(["masks", "check", "--load-config", str(config), "--masks-path", "others", "--output", str(tmp_path / "out")])
    assert json.loads((tmp_path / "out/report.json").read_text())["coverage"][0]["pixels"]["2"] == 16


def scene_of_folders(root: Path, names=("left/v0", "left/v1", "right/v0", "right/v2")) -> SourceScene:
    """Photos of two cameras; v0 is the stem of two."""
    photos = []
    for name in names:
        path = root / f"images/{name}.png"
        write_image(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        photos.append(Photo(name, path, WIDTH, HEIGHT))
    return SourceScene(root, photos)


def mask_at(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT, WIDTH), value, np.uint8)).save(path)


def values_of(maps) -> list[int | None]:
    return [None if class_map is None else int(class_map.max()) for class_map in maps]


def test_names_of_photos_and_what_other_names_mean():
    assert photo_names([Path("/a/images/l/1.jpg"), Path("/a/images/r/1.jpg")]) == ["l/1", "r/1"]
    assert photo_names([Path("/a/images/1.jpg"), Path("/a/images/x.y.png")]) == ["1", "x.y"]
    names = PhotoNames(["left/v0", "left/v1", "right/v0", "x.y"])
    assert (
        names.candidates("left/v0") == names.candidates("left\\v0.JPG") == names.candidates("images/left/v0.jpg") == [0]
    )
    assert names.candidates("v0") == names.candidates("v0.png") == [0, 2] and names.candidates("v1") == [1]
    assert names.candidates("elsewhere/v0.png") == names.candidates("right/v1") == []  # another folder, another photo
    assert names.in_other_folders("elsewhere/v0.png") == [0, 2] and names.in_other_folders("right/v1.jpg") == [1]
    assert names.in_other_folders("v0") == names.in_other_folders("right/v0") == names.in_other_folders("w") == []
    assert names.candidates("x.y") == names.candidates("images/x.y.png") == [3] and names.candidates("w") == []
    assert names.candidates("t/v0") == []  # "t/v0" ends "left/v0" as text, but is no part of its path
    assert names.find("right/v0", "it") == 2 and names.find("w", "it") is None
    with pytest.raises(UserError, match="it names the view 'v0', which could be left/v0 or right/v0: give more of"):
        names.find("v0", "it")
    with pytest.raises(UserError, match="it names the view 'right/v1', but the photo of that name is left/v1: correct"):
        names.find("right/v1", "it")


def test_masks_of_equal_stems_are_told_apart_by_their_folders(tmp_path):
    scene = scene_of_folders(tmp_path)
    for value, name in enumerate(("left/v0", "v1", "right/v0"), 1):  # v1 is the stem of one photo only
        mask_at(tmp_path / f"masks/{name}.png", value)
    assert values_of(make(IdImagesSource(), scene)[1]) == [1, 2, 3, None]
    (tmp_path / "masks/right/v0.png").rename(tmp_path / "masks/v0.png")
    with pytest.raises(
        UserError, match=r"masks/v0.png could belong to left/v0 or right/v0: give it the path .* as left/v0\."
    ):
        make(IdImagesSource(), scene)
    mask_at(tmp_path / "masks/right/v0.png", 4)  # now both photos have their own: v0.png is nobody's
    assert values_of(make(IdImagesSource(), scene)[1]) == [1, 2, 4, None]
    mask_at(tmp_path / "masks/v2.png", 5)
    mask_at(tmp_path / "masks/of/right/v2.png", 6)
    with pytest.raises(UserError, match="of/right/v2.png and .*/v2.png could both belong to right/v2: remove one of"):
        make(IdImagesSource(), scene)


def test_a_folder_that_contradicts_the_photos_is_told(tmp_path):
    scene = scene_of_folders(tmp_path)
    mask_at(tmp_path / "masks/left/v1.png", 1)
    mask_at(tmp_path / "masks/left/v2.png", 2)  # v2 is a photo of the right camera only
    for source, folder, name in (
        (IdImagesSource(), "masks", "left/v2.png"),
        (ObjectImagesSource(Path("first")), "first", "cup/left/v2.png"),
        (ObjectImagesSource(Path("last")), "last", "left/v2/cup.png"),
    ):
        mask_at(tmp_path / folder / name, 2)
        with pytest.raises(UserError, match=f"{folder}/{name} has the name of right/v2 but not the folder: give it"):
            make(source, scene)
    mask_at(tmp_path / "masks/right/v2.png", 3)  # the photo has its own mask: the other one is nobody's
    assert values_of(make(IdImagesSource(), scene)[1]) == [None, 1, None, 3]
    mask_at(tmp_path / "numbered/right/v0/v1.png", 255)  # an object may be called as a photo elsewhere
    names, maps = make(ObjectImagesSource(Path("numbered")), scene)
    assert names == {0: "background", 1: "v1"} and values_of(maps) == [None, None, 1, None]


def test_two_files_of_one_name_are_told(tmp_path):
    scene = scene_of(tmp_path)
    for index in range(4):
        mask_at(tmp_path / f"masks/v{index}.png", 1)
    mask_at(tmp_path / "masks/v1.bmp", 2)
    with pytest.raises(UserError, match="masks/v1.bmp and .*masks/v1.png are two files for v1: remove one of them"):
        make(IdImagesSource(), scene)
    images = [{"id": i, "file_name": name} for i, name in enumerate(("v1.jpg", "v1.png"))]
    annotations = [{"image_id": i, "category_id": 1, "segmentation": [[2, 2, 9, 2, 9, 9]]} for i in range(2)]
    (tmp_path / "annotations.json").write_text(json.dumps({"images": images, "annotations": annotations}))
    with pytest.raises(UserError, match="v1.jpg of .* and the image v1.png of .* could both belong to v1: remove one"):
        make(CocoSource(), scene)
    pair = [Path("/a/v1.jpg"), Path("/a/v1.png")]
    with pytest.raises(UserError, match="/a/v1.jpg and /a/v1.png are both called v1, .*: rename one of them"):
        photo_names(pair)


def test_objects_and_coco_and_features_are_matched_by_folders_too(tmp_path):
    scene = scene_of_folders(tmp_path)
    for way, pattern in (("first", "cup/{}.png"), ("last", "{}/cup.png")):
        for value, name in ((0, "left/v0"), (255, "right/v0")):
            mask_at(tmp_path / way / pattern.format(name), value)
        assert values_of(make(ObjectImagesSource(Path(way)), scene)[1]) == [0, None, 1, None]
    images = [{"id": i, "file_name": f"{name}.jpg"} for i, name in enumerate(("left/v0", "images/right/v0", "v2"))]
    box = [[2, 2, 9, 2, 9, 9, 2, 9]]
    annotations = [{"image_id": i, "category_id": 1 + i, "segmentation": box} for i in range(3)]
    (tmp_path / "annotations.json").write_text(json.dumps({"images": images, "annotations": annotations}))
    assert values_of(make(CocoSource(), scene)[1]) == [1, None, 2, 3]
    images[0]["file_name"] = "v0.jpg"
    (tmp_path / "annotations.json").write_text(json.dumps({"images": images, "annotations": annotations}))
    with pytest.raises(UserError, match="the image v0.jpg of .*annotations.json could belong to left/v0 or right/v0"):
        make(CocoSource(), scene)
    for segment, name in ((0, "left/v0"), (-1, "right/v0")):
        path = tmp_path / f"language_features/{name}_s.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.full((4, HEIGHT, WIDTH), segment))
        np.save(path.with_name("v0_f.npy"), np.ones((1, 3)))
    maps = make(LangSplatSource(least_views=1), scene)[1]
    assert values_of(maps) == [1, None, IGNORE, None]


def test_prompts_name_views_by_folders(tmp_path):
    scene = scene_of_folders(tmp_path)
    assert scene.index_of("right/v0.png", "prompts.json") == 2 and scene.index_of("v2", "prompts.json") == 3
    with pytest.raises(UserError, match="prompts.json names the view 'v0', which could be left/v0 or right/v0"):
        scene.index_of("v0", "prompts.json")
    with pytest.raises(UserError, match="prompts.json names the view 'v9', but no image of"):
        scene.index_of("v9", "prompts.json")


def test_the_command_and_training_agree_on_photos_of_equal_stems(tmp_path, capsys):
    write_transforms(tmp_path, count=4)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    for frame in meta["frames"]:
        old = tmp_path / frame["file_path"]
        camera, number = ("left", "right")[int(old.stem[1:]) % 2], int(old.stem[1:]) // 2
        frame["file_path"] = f"images/{camera}/v{number}.png"
        (tmp_path / f"images/{camera}").mkdir(exist_ok=True)
        old.rename(tmp_path / frame["file_path"])
        mask_at(tmp_path / f"made/{camera}/v{number}.png", 1 + number + 2 * (camera == "right"))
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    arguments = ["masks", "make", "--data", str(tmp_path), "--source", "id-images", "--options", "folder=made"]
    main(arguments)
    assert "4 masks of 4 views, 4 objects" in capsys.readouterr().out
    expected = {"left/v0": 1, "left/v1": 2, "right/v0": 3, "right/v1": 4}
    outputs = BeagsDataParserConfig(data=tmp_path, eval_interval=0).setup().get_dataparser_outputs("train")
    found = {
        path.relative_to(tmp_path / "images").with_suffix("").as_posix(): int(read_class_map(mask).max())
        for path, mask in zip(outputs.image_filenames, outputs.metadata["class_map_filenames"], strict=True)
    }
    assert found == expected
    held_out = BeagsDataParserConfig(data=tmp_path, eval_interval=0, held_out=("right/v0",)).setup()
    (test,) = held_out.get_dataparser_outputs("test").image_filenames
    assert test == tmp_path / "images/right/v0.png"
    (tmp_path / "made/left/v0.png").rename(tmp_path / "made/v0.png")
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--overwrite"])
    assert ended.value.code == 2
    assert "made/v0.png could belong to left/v0 or right/v0" in " ".join(capsys.readouterr().out.split())


def test_the_geometry_of_a_run_has_its_held_out_views_too(tmp_path):
    from beags_plugin.plugin.made_masks import RunGeometry

    data = write_scene(tmp_path / "scene")
    geometry = RunGeometry(write_trained(tmp_path / "run", data))
    assert [path.stem for path in geometry.images] == [f"v{index:02d}" for index in (*range(1, 8), 0, 8)]
    ids = truth(0)
    for view in (0, 7, 8):
        camera = geometry.cameras[view]
        assert tuple(geometry.depth(view).shape) == (camera.height, camera.width)
        straight = geometry.to_straight(ids.astype(np.uint16), view)
        np.testing.assert_array_equal(geometry.to_photo(straight, view), ids)  # this scene has no lens distortion
