"""What ``beags bench paper`` finds on disk: small trees, complete and with every part missing once."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from data_folders import noise, write_image
from paper_trees import OBJECTS, SCENES, write_tree

from beags_benchmarks.experiments.paper.data_sets import read_data_sets
from beags_benchmarks.experiments.paper.on_disk import SceneOnDisk, Sizes, find_scene, find_scenes
from beags_benchmarks.experiments.paper.tables import missing_lines
from beags_benchmarks.experiments.scenes import SceneSize
from beags_plugin.masks.sources.prompts import read_prompts
from beags_plugin.system.errors import UserError

HELD_OUT = {"mip360": 2, "llff": 3, "lerf": 2, "3dovs": 2}
TRAINING = {"mip360": 8, "llff": 7, "lerf": 4, "3dovs": 4}


@pytest.fixture(scope="module")
def trees(tmp_path_factory):
    """The data root with a complete scene of each data set."""
    root = tmp_path_factory.mktemp("trees")
    for name in SCENES:
        write_tree(root, name)
    return root


def look(root: Path, name: str, output: Path | None = None, **sizes) -> SceneOnDisk:
    (data_set,) = read_data_sets([name])
    scene = SCENES[name]
    return find_scene(data_set, scene, data_set.folder(root) / scene, output or root / "out", Sizes(**sizes))


@pytest.mark.parametrize("name", SCENES)
def test_a_complete_scene_is_ready(trees, name):
    found = look(trees, name)
    assert found.missing == () and found.scene is not None
    noted = {  # these trees are small, and five prompts have no mask
        "mip360": [],
        "llff": ["images are 80 pixels wide, not 1600"],
        "lerf": ["no class is called 'green toy chair'"],
        "3dovs": ["images are 80 pixels wide, not 1600"],
    }[name]
    assert len(found.notes) == len(noted) and all(map(str.__contains__, found.notes, noted))
    assert found.size == SceneSize(TRAINING[name], TRAINING[name] * 80 * 48)
    assert found.scene.name == f"{name}/{SCENES[name]}" and found.scene.downscale == 1.0
    outputs = found.scene.parser().setup().get_dataparser_outputs("test")
    assert len(outputs.image_filenames) == HELD_OUT[name]
    assert list(outputs.metadata["classes"].values()) == ["background", *OBJECTS[name]]


@pytest.mark.parametrize("name", SCENES)
def test_photos_are_as_large_as_the_paper_has_them(trees, tmp_path, name):
    shutil.copytree(trees / name, tmp_path / name)
    data_set = read_data_sets([name])[0]
    photo = next((tmp_path / name / SCENES[name] / data_set.images).iterdir())
    write_image(photo, noise(0, 3200, 1920))
    assert Sizes().factor(data_set, photo) == (2.0 if name in ("llff", "3dovs") else 1.0)
    assert Sizes(downscale=3.0).factor(data_set, photo) == (6.0 if name in ("llff", "3dovs") else 3.0)
    assert Sizes(quick=True).factor(data_set, photo) == 12.0  # 267 x 160


MISSING = {  # data set and what is removed below its scene: the sentence; of parts that training needs
    ("mip360", "images_4"): "the photos belong in {scene}/images_4",
    ("mip360", "sparse"): "{scene} holds no COLMAP model (sparse/0), which the download has there",
    ("mip360", "sparse/0/images.bin"): "lacks images.bin",
    ("mip360", "masks"): "the masks to train on belong in {scene}/masks: beags masks make --data {scene} --source sam2",
    ("llff", "images"): "the photos belong in {scene}/images",
    ("llff", "poses_bounds.npy"): "{scene} holds neither poses_bounds.npy nor a complete COLMAP model",
    ("llff", "masks"): "--options prompts={scene}/prompts.json",
    ("lerf", "images"): "the photos belong in {scene}/images",
    ("lerf", "images_train"): "{scene} holds no folder images_train",
    ("lerf", "test_mask"): "{scene} holds no folder test_mask",
    ("lerf", "sparse"): "{scene} holds no COLMAP model (sparse/0)",
    ("lerf", "masks"): "--options prompts={root}/out/prompts/lerf-figurines.json",
    ("3dovs", "images"): "the photos belong in {scene}/images",
    ("3dovs", "segmentations/classes.txt"): "{scene} holds no segmentations/classes.txt",
    ("3dovs", "poses_bounds.npy"): "{scene} holds neither poses_bounds.npy nor a complete COLMAP model",
    ("3dovs", "masks"): "--options prompts={root}/out/prompts/3dovs-bed.json",
}
NOTED = {  # likewise, of parts that only the figures lack
    ("mip360", "classes.json"): "the names of the ids of the masks belong in {scene}/classes.json",
    ("mip360", "ground_truth/visible"): "visible masks of table, vase belong in {scene}/ground_truth/visible/<object>",
    ("mip360", "ground_truth/silhouettes"): "silhouettes of table, vase belong in {scene}/ground_truth/silhouettes/",
    ("mip360", "ground_truth/silhouettes/vase"): "silhouettes of vase belong in",
    ("llff", "classes.json"): "no class is called 'fern': name the ids of the masks in {scene}/classes.json",
    (
        "llff",
        "ground_truth/visible",
    ): "visible masks of fern belong in {scene}/ground_truth/visible/<object>/"
    "<photo>.png: beags bench nvos --data {scene} --nvos NVOS",
    ("llff", "ground_truth/silhouettes"): "silhouettes of fern belong in {scene}/ground_truth/silhouettes/<object>/",
    ("lerf", "classes.json"): "no class is called 'green apple', 'green toy chair'",
    ("lerf", "test_mask/*/*"): "visible masks of green apple, old camera belong in {scene}/test_mask/<n>/<object>.png",
    ("lerf", "ground_truth"): "silhouettes of green apple, old camera belong in {scene}/ground_truth/silhouettes/",
    (
        "3dovs",
        "segmentations/*/*.png",
    ): "visible masks of red bag, banana belong in {scene}/segmentations/<NN>/<object>",
    ("3dovs", "ground_truth"): "silhouettes of red bag, banana belong in {scene}/ground_truth/silhouettes/<object>/",
}


def without(trees: Path, tmp_path: Path, name: str, part: str) -> tuple[SceneOnDisk, dict[str, Path]]:
    """Remove a part of a scene's copy, and look at it."""
    shutil.copytree(trees / name, tmp_path / name)
    scene = tmp_path / name / SCENES[name]
    removed = list(scene.glob(part))
    assert removed
    for path in removed:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return look(tmp_path, name), {"scene": scene, "root": tmp_path}


@pytest.mark.parametrize("name, part", MISSING)
def test_a_missing_part_is_named_with_where_it_belongs(trees, tmp_path, name, part):
    found, places = without(trees, tmp_path, name, part)
    assert found.scene is None and len(found.missing) == 1
    assert MISSING[name, part].format(**places) in found.missing[0] and "\n" not in found.missing[0]
    assert missing_lines([found])[0].startswith(f"missing: {found.data_set.title}, {SCENES[name]}: ")


@pytest.mark.parametrize("name, part", NOTED)
def test_a_part_that_only_figures_lack_is_noted(trees, tmp_path, name, part):
    found, places = without(trees, tmp_path, name, part)
    assert found.scene is not None and found.missing == ()
    sentence = NOTED[name, part].format(**places)
    assert any(sentence in note for note in found.notes)


def test_prompts_are_written_for_scenes_whose_masks_are_missing(trees, tmp_path):
    without(trees, tmp_path, "lerf", "masks")
    without(trees, tmp_path, "3dovs", "masks")
    figurines, bed = (read_prompts(tmp_path / f"out/prompts/{name}.json") for name in ("lerf-figurines", "3dovs-bed"))
    assert [(each.class_id, each.text) for each in bed] == [(1, "red bag"), (2, "banana")]
    assert len(figurines) == 7 and figurines[6].name == figurines[6].text == "rubber duck with red hat"


def test_masks_of_the_download_stand_in_for_those_of_the_prompts(trees, tmp_path):
    shutil.copytree(trees / "lerf", tmp_path / "lerf")
    scene = tmp_path / "lerf/figurines"
    (scene / "masks").rename(scene / "object_mask")
    found = look(tmp_path, "lerf")
    assert found.scene is not None and "masks_path" not in found.scene.options
    assert f"trains on {scene}/object_mask (the download's own masks, by DEVA without the prompts" in found.notes[0]


def test_data_that_cannot_be_read_is_missing(trees, tmp_path):
    shutil.copytree(trees / "llff", tmp_path / "llff")
    (tmp_path / "llff/fern/classes.json").write_text(json.dumps({"1": "fern"}))
    found = look(tmp_path, "llff")
    assert found.scene is None and "holds id 2, which" in found.missing[0]


def test_absent_scenes_and_data_sets_share_a_line(trees, tmp_path):
    data_sets = read_data_sets()
    shutil.copytree(trees / "lerf", tmp_path / "lerf_mask")  # the download's own name
    found = find_scenes(data_sets, tmp_path, tmp_path / "out", Sizes())
    assert [scene.name for scene in found if scene.scene is not None] == ["figurines"]
    lines = missing_lines(found)
    assert f"missing: LeRF: the scenes ramen, teatime belong in {tmp_path}/lerf_mask" in lines
    assert any(line.startswith("missing: 3DOVS: the scenes bed, bench,") for line in lines)
    one = find_scenes(data_sets, tmp_path, tmp_path / "out", Sizes(), ["ramen"])
    assert missing_lines(one) == [f"missing: LeRF: the scene ramen belongs in {tmp_path}/lerf_mask"]
    with pytest.raises(UserError, match="'attic' is no scene of these data sets: name some of bed,"):
        find_scenes(data_sets, tmp_path, tmp_path / "out", Sizes(), ["attic"])
    with pytest.raises(UserError, match="nowhere is no folder: name the one that holds the folders of the data sets"):
        find_scenes(data_sets, tmp_path / "nowhere", tmp_path / "out", Sizes())
