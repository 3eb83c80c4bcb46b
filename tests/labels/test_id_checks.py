"""Id images that were spoilt on their way: smoothed, compressed with loss, of differing palettes, of colours."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from data_folders import write_image, write_transforms
from parsed_views import parse
from PIL import Image

from beags_plugin.commands import cli
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.labels.id_checks import check_areas, check_ids
from beags_plugin.masks.sources.id_images import IdImagesSource
from beags_plugin.system.errors import UserError


def discs(ids: list[int], width: int = 200, height: int = 120, seed: int = 0) -> np.ndarray:
    """Return an id image of overlapping discs, one of each id."""
    generator = np.random.default_rng(seed)
    labels = np.zeros((height, width), np.uint8)
    rows, columns = np.mgrid[:height, :width]
    for index in ids:
        x, y, radius = generator.uniform([0, 0, 15], [width, height, 35])
        labels[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = index
    return labels


SMOOTHINGS = {
    "twice as large, linear": lambda image: cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR),
    "smaller by area": lambda image: cv2.resize(image, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA),
    "smaller, linear": lambda image: np.asarray(Image.fromarray(image).resize((90, 54), Image.Resampling.BILINEAR)),
    "larger, cubic": lambda image: np.asarray(Image.fromarray(image).resize((310, 186), Image.Resampling.BICUBIC)),
    "smaller, Lanczos": lambda image: np.asarray(Image.fromarray(image).resize((90, 54), Image.Resampling.LANCZOS)),
    "blurred": lambda image: cv2.GaussianBlur(image, (0, 0), 0.8),
    "turned by 5 degrees": lambda image: np.asarray(Image.fromarray(image).rotate(5, Image.Resampling.BILINEAR)),
}
IDS = {"one in white": [255], "0 to 2": [2, 1, 2], "0 to 5": [1, 2, 3, 4, 5], "shades": [51, 102, 153, 204, 255]}


@pytest.mark.parametrize("ids", IDS)
@pytest.mark.parametrize("smoothing", SMOOTHINGS)
def test_smoothed_masks_are_called_so(smoothing, ids):
    for seed in range(3):
        with pytest.raises(UserError, match="the mask a.png has values between its ids along outlines.*nearest neigh"):
            check_ids("a.png", SMOOTHINGS[smoothing](discs(IDS[ids], seed=seed)))


@pytest.mark.parametrize("ids", [*IDS, "many"])
@pytest.mark.parametrize("size", [(200, 120), (20, 12), (60, 36), (333, 77)])
def test_hard_masks_pass(ids, size):
    generator = np.random.default_rng(1)
    for seed in range(5):
        labels = discs(IDS.get(ids, list(range(1, 60))), *size, seed=seed)
        check_ids("a.png", labels)
        labels[generator.random(labels.shape) < 0.002] = 7  # specks of a network
        check_ids("a.png", labels)
        check_ids("a.png", cv2.resize(labels, None, fx=0.37, fy=0.37, interpolation=cv2.INTER_NEAREST))


def test_noise_and_thin_things_pass():
    generator = np.random.default_rng(0)
    check_ids("a.png", generator.integers(0, 3, (12, 20)).astype(np.uint16))
    labels = np.zeros((100, 100), np.uint16)
    labels[::4], labels[40:60, 40:60] = 1, 2  # wires before an object
    check_ids("a.png", labels)


@pytest.mark.parametrize("quality", [75, 95])
def test_a_jpeg_saved_as_png_is_called_so(quality):
    file = io.BytesIO()
    Image.fromarray(discs([60, 120, 200])).save(file, "JPEG", quality=quality)
    with pytest.raises(UserError, match="the mask a.png has .*(compression with loss|antialiasing)"):
        labels = np.asarray(Image.open(file))
        check_areas("a.png", labels, "values")


def scene(root: Path, mask) -> Path:
    write_transforms(root)
    for index in range(9):
        write_image(root / f"images/v{index:02d}.png", np.full((120, 200, 3), 9 * index, np.uint8))
        mask(root / f"masks/v{index:02d}.png", index)
    text = (root / "transforms.json").read_text().replace('"w": 20', '"w": 200').replace('"h": 12', '"h": 120')
    (root / "transforms.json").write_text(text)
    return root


def smoothed(path: Path, index: int) -> None:
    labels = cv2.resize(discs([255], seed=index), (100, 60), interpolation=cv2.INTER_NEAREST)
    write_image(path, cv2.resize(labels, (200, 120), interpolation=cv2.INTER_LINEAR))


def test_training_and_the_check_refuse_smoothed_masks(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene(tmp_path / "data", smoothed)
    with pytest.raises(UserError, match="v00.png has values between its ids"):
        parse(tmp_path / "data")
    with pytest.raises(SystemExit) as end:
        cli.main(["masks", "check", "--data", str(tmp_path / "data")])
    said = " ".join(capsys.readouterr().out.split())
    assert end.value.code == 1 and "values between its ids along outlines" in said


PALETTE = [(0, 0, 0), (200, 10, 10), (10, 200, 10)]


def paletted(path: Path, labels: np.ndarray, order: list[int]) -> None:
    """Save labels so that id i has the colour i, at the place ``order[i]`` of the palette."""
    image = Image.fromarray(np.array(order, np.uint8)[labels], mode="P")
    image.putpalette([value for place in np.argsort(order) for value in PALETTE[place]])
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path)


def test_palettes_that_differ_are_called_so(tmp_path):
    labels = [discs([1, 2], seed=index) for index in range(9)]
    scene(tmp_path / "same", lambda path, index: paletted(path, labels[index], [0, 1, 2]))
    assert set(parse(tmp_path / "same").metadata["classes"]) == {0, 1, 2}
    scene(tmp_path / "other", lambda path, index: paletted(path, labels[index], [0, 2, 1] if index else [0, 1, 2]))
    with pytest.raises(UserError, match=r"give the colour \(\d+, \d+, 10\) the ids (1 and 2|2 and 1).*colors=true"):
        parse(tmp_path / "other")
    scene(tmp_path / "first", lambda path, index: paletted(path, labels[index], [1, 0, 2]))
    with pytest.raises(UserError, match=r"has black as id 1 and the colour \(200, 10, 10\) as id 0"):
        parse(tmp_path / "first")


@pytest.mark.parametrize("channels", ["RGB", "RGBA", "LA"])
def test_grey_in_several_channels_is_called_so(tmp_path, channels):
    Image.fromarray(discs([1, 2])).convert(channels).save(tmp_path / "a.png")
    with pytest.raises(UserError, match=rf"has colours \(mode {channels}\), though all are greys.*with one channel"):
        read_id_mask(tmp_path / "a.png")


def test_colours_are_named_with_the_command_that_reads_them(tmp_path):
    (tmp_path / "my masks").mkdir()
    Image.fromarray(np.array(PALETTE, np.uint8)[discs([1, 2])]).save(tmp_path / "my masks/a.png")
    with pytest.raises(UserError, match=r"--source id-images --options folder='.*/my masks' colors=true"):
        read_id_mask(tmp_path / "my masks/a.png")


def test_colour_images_that_were_smoothed_are_no_ids(tmp_path):
    colored = np.array(PALETTE, np.uint8)[discs([1, 2])]
    for number, image in enumerate((cv2.GaussianBlur(colored, (0, 0), 1.0), np.roll(colored, 1, 0))):
        Image.fromarray(image).save(tmp_path / f"{number}.png")
    source = IdImagesSource(tmp_path, colors=True)
    assert set(np.unique(source._ids(tmp_path / "1.png", {}))) == {0, 1, 2}
    with pytest.raises(UserError, match="0.png has .* colours that fill no area"):
        source._ids(tmp_path / "0.png", {})


@pytest.mark.parametrize(
    ("suffix", "words"), [(".jpg", "JPEG blurs class ids: make them anew"), (".bmp", "are .png fil")]
)
def test_masks_of_another_file_type_are_not_overlooked(tmp_path, suffix, words):
    write_transforms(tmp_path)
    for index in range(9):
        write_image(tmp_path / f"masks/v{index:02d}{suffix}", np.zeros((12, 20), np.uint8))
    with pytest.raises(UserError, match=f"the masks in .* are {suffix} files, as v00{suffix}, but .*{words}"):
        parse(tmp_path)


def test_wide_ramps_are_smoothing_but_rims_of_a_plate_are_not():
    """Four times as large, the value between two ids is two pixels wide, as a thin rim may be."""
    rows, columns = np.mgrid[:96, :128]
    labels = np.zeros((96, 128), np.uint8)
    for value, x in ((1, 30), (2, 90)):
        labels[(columns - x) ** 2 + (rows - 45) ** 2 < 14**2] = value
    with pytest.raises(UserError, match="between its ids along outlines"):
        check_ids("a.png", cv2.resize(labels, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR))
    plate = np.zeros((96, 128), np.uint8)
    far = np.hypot(columns - 60, rows - 45)
    plate[far < 22], plate[far < 20] = 1, 2
    check_ids("a.png", plate)
