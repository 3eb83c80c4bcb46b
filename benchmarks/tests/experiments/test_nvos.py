"""Masks and scribbles of NVOS: their tree, complete and with every part missing once."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from data_folders import HEIGHT, WIDTH, noise, write_image
from layout_folders import ids, write_llff
from parsed_views import parse

from beags_benchmarks.experiments.paper.nvos import POINTS, points_of, read_nvos
from beags_plugin.commands import cli
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_object_mask
from beags_plugin.masks.sources.prompts import read_prompts
from beags_plugin.system.errors import UserError

TARGET, REFERENCE = "IMG_4027", "IMG_4033"


def write_nvos(root: Path) -> Path:
    """Write NVOS's folders for fern, whose photos have 80 x 48 pixels, and for both objects of horns."""
    for name, target in (("fern", TARGET), ("horns_center", "DJI_1"), ("horns_left", "DJI_1")):
        write_image(root / f"masks/{name}/{target}_mask.png", 255 * ids(1, 4 * WIDTH, 4 * HEIGHT))
        write_image(root / f"masks/{name}/{target}.JPG", noise(0, 4 * WIDTH, 4 * HEIGHT))
        write_image(root / f"reference_image/{name}/{REFERENCE if name == 'fern' else 'DJI_2'}.JPG", noise(1))
        stroke = np.zeros((HEIGHT, WIDTH), np.uint8)  # a quarter of the photo
        stroke[4:7, 6:15] = 255
        write_image(root / f"scribbles/{name}/pos_0.png", stroke)
        write_image(root / f"scribbles/{name}/neg_0.png", np.roll(stroke, 5, axis=0))
    return root


@pytest.fixture
def fern(tmp_path):
    write_llff(tmp_path / "fern")
    return tmp_path / "fern"


@pytest.fixture
def nvos(tmp_path):
    return write_nvos(tmp_path / "nvos")


def truth(*words: object) -> None:
    cli.main(["bench", "nvos", *map(str, words)])


def refused(capsys, *words: object) -> str:
    """Run the command, which must end with a sentence, and return it."""
    with pytest.raises(SystemExit) as ended:
        truth(*words)
    assert ended.value.code == 2
    return " ".join(capsys.readouterr().out.split())


def test_nvos_is_scored_in_its_view_and_prompts_in_its_reference(fern, nvos, capsys):
    truth("--data", fern, "--nvos", nvos)
    text = " ".join(capsys.readouterr().out.split())
    assert f"fern: 1 visible mask in {fern}/ground_truth/visible/fern" in text
    assert f"beags masks make --data {fern} --source sam2 --options prompts={fern}/prompts.json" in text
    test = parse(fern, "test", images_path=Path("images"), held_out=(TARGET,))
    masks = dict(
        zip([p.stem for p in test.image_filenames], test.metadata["ground_truth"]["visible"]["fern"], strict=True)
    )
    assert [stem for stem, mask in masks.items() if mask is not None] == [TARGET]
    assert (read_object_mask(masks[TARGET]) == (ids(1, 4 * WIDTH, 4 * HEIGHT) > 0)).all()
    (prompted,) = read_prompts(fern / "prompts.json")
    prompt = prompted.prompts[REFERENCE]
    assert prompted.name == "fern" and 0 < len(prompt.points) <= 2 * POINTS
    for (x, y), inside in zip(prompt.points, prompt.inside, strict=True):  # pixels of the photo, four times as many
        assert 24 <= x <= 60 and (16 <= y <= 28 if inside else 36 <= y <= 48)


def test_what_cannot_be_told_is_kept(fern, nvos):
    mask = 255 * ids(1, 4 * WIDTH, 4 * HEIGHT)
    mask[:3] = 128
    write_image(nvos / f"masks/fern/{TARGET}_mask.png", mask)
    truth("--data", fern, "--nvos", nvos)
    kept = read_object_mask(fern / f"ground_truth/visible/fern/{TARGET}.png")
    assert ((kept == IGNORE) == (mask == 128)).all() and ((kept == 1) == (mask == 255)).all() and (mask == 255).any()


def test_a_scene_may_have_two_objects_and_another_name(nvos):
    assert [each.name for each in read_nvos(nvos, "horns")] == ["horns_center", "horns_left"]
    with pytest.raises(UserError, match="has no object of a scene 'room': name the scene's folder as one of"):
        read_nvos(nvos, "room")


MISSING = {  # paths to remove from NVOS's folder, and the sentence about each
    "masks": "has no folder masks: give --nvos the folder that holds masks and scribbles.",
    "masks/fern": "has no object of a scene 'fern': name the scene's folder as one of ['horns_center', 'horns_left'].",
    f"masks/fern/{TARGET}_mask.png": "masks/fern holds no mask <photo>_mask.png: restore the download.",
}


@pytest.mark.parametrize("part", MISSING)
def test_a_missing_part_of_nvos_is_named(fern, nvos, part, capsys):
    path = nvos / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert MISSING[part] in refused(capsys, "--data", fern, "--nvos", nvos)
    assert not (fern / "ground_truth").exists()


@pytest.mark.parametrize("part", ["scribbles", "scribbles/fern/pos_0.png", "reference_image"])
def test_without_scribbles_masks_alone_are_taken(fern, nvos, part, capsys):
    path = nvos / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    truth("--data", fern, "--nvos", nvos)
    assert "No photo of the scene has scribbles, so no prompts are written." in capsys.readouterr().out
    assert (fern / f"ground_truth/visible/fern/{TARGET}.png").exists() and not (fern / "prompts.json").exists()


def test_scribbles_on_an_absent_photo_are_left_out(fern, nvos, capsys):
    (nvos / f"reference_image/fern/{REFERENCE}.JPG").rename(nvos / "reference_image/fern/IMG_1.JPG")
    truth("--data", fern, "--nvos", nvos)
    assert "No photo of the scene has scribbles, so no prompts are written." in capsys.readouterr().out


def test_mistakes_are_refused_before_anything_is_written(fern, nvos, tmp_path, capsys):
    other = write_nvos(tmp_path / "other")
    (other / f"masks/fern/{TARGET}_mask.png").rename(other / "masks/fern/IMG_1_mask.png")
    assert "no photo of" in (text := refused(capsys, "--data", fern, "--nvos", other)) and "is called IMG_1" in text
    write_image(other / f"masks/fern/{TARGET}_mask.png", ids(1, 30, 30))
    (other / "masks/fern/IMG_1_mask.png").unlink()
    assert "is 30x30 pixels but the photo" in refused(capsys, "--data", fern, "--nvos", other)
    write_image(nvos / "scribbles/fern/neg_1.png", ids(1, 30, 30))
    assert "differ in size, or are on several photos" in refused(capsys, "--data", fern, "--nvos", nvos)
    assert not (fern / "ground_truth").exists() and not (fern / "prompts.json").exists()


def test_what_is_there_is_kept_unless_told_otherwise(fern, nvos, capsys):
    truth("--data", fern, "--nvos", nvos)
    mask = fern / f"ground_truth/visible/fern/{TARGET}.png"
    write_image(mask, 255 * ids(1, 8 * WIDTH, 8 * HEIGHT))
    capsys.readouterr()
    assert f"{mask} exists already: add --overwrite" in refused(capsys, "--data", fern, "--nvos", nvos)
    assert read_object_mask(mask).shape == (8 * HEIGHT, 8 * WIDTH)
    truth("--data", fern, "--nvos", nvos, "--overwrite")
    assert read_object_mask(mask).shape == (4 * HEIGHT, 4 * WIDTH)


def test_points_lie_far_apart_in_the_middle_of_strokes(tmp_path):
    stroke = np.zeros((40, 200), np.uint8)
    stroke[10:15, 5:195] = 255  # five pixels broad
    write_image(tmp_path / "a.png", stroke)
    points = np.array(list(points_of([tmp_path / "a.png"])))
    assert len(points) == POINTS and set(points[:, 1]) == {12.5}
    assert np.diff(np.sort(points[:, 0])).min() > 8 and points[:, 0].min() < 12 and points[:, 0].max() > 188
    write_image(tmp_path / "b.png", np.zeros((40, 200), np.uint8))
    assert list(points_of([tmp_path / "b.png"])) == [] == list(points_of([]))
    assert np.array(list(points_of([tmp_path / "b.png", tmp_path / "a.png"]))).tolist() == points.tolist()
