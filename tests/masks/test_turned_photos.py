"""Photos that are stored turned, with EXIF's word on it, and masks or poses of the upright ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from data_folders import HEIGHT, WIDTH, noise, write_image, write_transforms
from parsed_views import parse
from PIL import Image, ImageOps

from beags_plugin.commands import cli
from beags_plugin.data.orientation import as_stored, upright
from beags_plugin.system.errors import UserError


def turned_scene(root: Path, turned: int) -> Path:
    """Write a scene whose photos have an orientation; its poses are of the photos as they are stored."""
    write_transforms(root)
    for path in (root / "images").iterdir():
        image = Image.open(path)
        image.load()
        exif = image.getexif()
        exif[274] = turned
        image.save(path, exif=exif)
    return root


def mask() -> np.ndarray:
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[1:5, 2:9], labels[7:10, 3:6] = 1, 2
    return labels


def write_masks(folder: Path, labels: np.ndarray) -> None:
    for index in range(9):
        write_image(folder / f"v{index:02d}.png", labels)


@pytest.mark.parametrize("turned", range(1, 9))
def test_images_turn_as_pillow_turns_them(turned):
    image = Image.fromarray(noise(0))
    exif = image.getexif()
    exif[274] = turned
    image.info["exif"] = exif.tobytes()
    held = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(upright(noise(0), turned), held)
    np.testing.assert_array_equal(as_stored(held, turned), noise(0))


@pytest.mark.parametrize("turned", [6, 8])
def test_upright_masks_are_named_and_turned_by_the_option(tmp_path, turned, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = turned_scene(tmp_path / "my scene", turned)
    write_masks(root / "masks", upright(mask(), turned))
    words = rf"v00.png is upright, {HEIGHT}x{WIDTH} pixels, but its photo .*v00.png is stored on its side, .*"
    words += rf"EXIF orientation {turned}: turn the masks with beags masks make --upright .*folder='.*/my scene/masks'"
    with pytest.raises(UserError, match=words):
        parse(root)
    with pytest.raises(SystemExit):
        cli.main(["masks", "check", "--data", str(root)])
    assert f"EXIF orientation {turned}" in " ".join(capsys.readouterr().out.split())
    options = ["--options", f"folder={root / 'masks'}", "--overwrite", "--upright"]
    cli.main(["masks", "make", "--data", str(root), "--source", "id-images", *options])
    np.testing.assert_array_equal(np.asarray(Image.open(root / "masks/v04.png")), mask())
    assert set(parse(root).metadata["classes"]) == {0, 1, 2}


def test_sources_name_the_orientation_and_the_option(tmp_path):
    root = turned_scene(tmp_path / "scene", 6)
    write_masks(tmp_path / "ids", upright(mask(), 6))
    polygon = [1, 1, 1, 8, 5, 8, 5, 1]
    coco = {
        "images": [{"id": 1, "file_name": "v01.png", "width": HEIGHT, "height": WIDTH}],
        "categories": [{"id": 1, "name": "cup"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "segmentation": [polygon]}],
    }
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    for source, option in (("id-images", f"folder={tmp_path / 'ids'}"), ("coco", f"file={tmp_path / 'coco.json'}")):
        arguments = ["masks", "make", "--data", str(root), "--source", source, "--options", option]
        with pytest.raises(SystemExit) as end:
            cli.main(arguments)
        assert end.value.code == 2
        cli.main([*arguments, "--upright", "--output", str(tmp_path / source)])
    labels = np.asarray(Image.open(tmp_path / "coco/masks/v01.png"))
    assert labels.shape == (HEIGHT, WIDTH) and upright(labels, 6)[4, 3] == 1 and labels.sum() > 20


def test_polygons_of_another_size_are_refused(tmp_path, capsys):
    write_transforms(tmp_path / "scene")
    image = {"id": 1, "file_name": "v01.png", "width": 2 * WIDTH, "height": 2 * HEIGHT}
    entry = {"id": 1, "image_id": 1, "category_id": 1, "segmentation": [[1, 1, 1, 8, 5, 8, 5, 1]]}
    content = {"images": [image], "categories": [{"id": 1, "name": "cup"}], "annotations": [entry]}
    (tmp_path / "coco.json").write_text(json.dumps(content))
    options = ["--source", "coco", "--options", f"file={tmp_path / 'coco.json'}"]
    with pytest.raises(SystemExit):
        cli.main(["masks", "make", "--data", str(tmp_path / "scene"), *options])
    assert "annotated at 40x24 pixels but is 20x12" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("turned", [2, 3, 4])
def test_the_check_notes_photos_that_are_turned_within_their_size(tmp_path, turned, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = turned_scene(tmp_path / "scene", turned)
    write_masks(root / "masks", mask())
    cli.main(["masks", "check", "--data", str(root)])
    said = " ".join(capsys.readouterr().out.split())
    assert f"9 photos are stored turned (first {root}/images/v00.png, with EXIF orientation {turned})" in said
    assert "beags masks make --upright" in said


def test_poses_of_upright_photos_are_named(tmp_path):
    root = turned_scene(tmp_path, 6)
    meta = json.loads((root / "transforms.json").read_text())
    meta.update(w=HEIGHT, h=WIDTH)
    (root / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(UserError, match="v00.png is stored on its side, 20x12 pixels with EXIF orientation 6, but its"):
        parse(root)
