"""Matching of masks, entries and prompts to photos."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from data_folders import write_transforms
from source_scenes import make, mask_at, scene_of, scene_of_folders, values_of

from beags_plugin.commands.cli import main
from beags_plugin.data.files import photo_names
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.masks.sources.coco import CocoSource
from beags_plugin.masks.sources.id_images import IdImagesSource
from beags_plugin.masks.sources.matching import PhotoNames
from beags_plugin.masks.sources.object_images import ObjectImagesSource
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.system.errors import UserError


def test_names_of_photos_and_what_other_names_mean():
    assert photo_names([Path("/a/images/l/1.jpg"), Path("/a/images/r/1.jpg")]) == ["l/1", "r/1"]
    assert photo_names([Path("/a/images/1.jpg"), Path("/a/images/x.y.png")]) == ["1", "x.y"]
    names = PhotoNames(["left/v0", "left/v1", "right/v0", "x.y"])
    assert all(names.candidates(name) == [0] for name in ("left/v0", "left\\v0.JPG", "images/left/v0.jpg"))
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


def test_a_folder_that_contradicts_the_photos_is_refused(tmp_path):
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


def test_two_files_of_one_name_are_refused(tmp_path):
    scene = scene_of(tmp_path)
    for index in range(4):
        mask_at(tmp_path / f"masks/v{index}.png", 1)
    mask_at(tmp_path / "masks/v1.bmp", 2)
    with pytest.raises(UserError, match="masks/v1.bmp and .*masks/v1.png are two files for v1: remove one of them"):
        make(IdImagesSource(), scene)
    for name in ("cup/v1", "v1/cup"):
        mask_at(tmp_path / f"objects/{name}.png", 255)
    with pytest.raises(UserError, match="cup/v1.png and .*v1/cup.png are both cup in v1: remove one of them"):
        make(ObjectImagesSource(Path("objects")), scene)
    images = [{"id": i, "file_name": name} for i, name in enumerate(("v1.jpg", "v1.png"))]
    annotations = [{"image_id": i, "category_id": 1, "segmentation": [[2, 2, 9, 2, 9, 9]]} for i in range(2)]
    (tmp_path / "annotations.json").write_text(json.dumps({"images": images, "annotations": annotations}))
    with pytest.raises(UserError, match="v1.jpg of .* and the image v1.png of .* could both belong to v1: remove one"):
        make(CocoSource(), scene)
    pair = [Path("/a/v1.jpg"), Path("/a/v1.png")]
    with pytest.raises(UserError, match="/a/v1.jpg and /a/v1.png are both called v1, .*: rename one of them"):
        photo_names(pair)
    with pytest.raises(UserError, match="the poses name /a/v1.jpg twice: keep one of them"):
        photo_names([pair[0], pair[0]])


def test_objects_and_coco_are_matched_by_folders_too(tmp_path):
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


def test_prompts_name_views_by_folders(tmp_path):
    scene = scene_of_folders(tmp_path)
    assert scene.index_of("right/v0.png", "prompts.json") == 2 and scene.index_of("v2", "prompts.json") == 3
    with pytest.raises(UserError, match="prompts.json names the view 'v0', which could be left/v0 or right/v0"):
        scene.index_of("v0", "prompts.json")
    with pytest.raises(UserError, match="prompts.json names the view 'v9', but .* has no image of that name"):
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
        path.relative_to(tmp_path / "images").with_suffix("").as_posix(): int(read_id_mask(mask).max())
        for path, mask in zip(outputs.image_filenames, outputs.metadata["mask_filenames"], strict=True)
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
