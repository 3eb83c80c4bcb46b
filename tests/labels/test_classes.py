"""Masks and class names on disk: what is read back, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from beags_plugin.data.files import image_size
from beags_plugin.labels.class_ids import IGNORE, count_ids
from beags_plugin.labels.classes import (
    check_names,
    read_classes,
    read_id_mask,
    read_object_mask,
    write_mask,
)
from beags_plugin.labels.colors import colorize
from beags_plugin.system.errors import UserError


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.int64])
def test_written_maps_come_back(tmp_path, dtype):
    ids = np.arange(12).reshape(3, 4).astype(dtype)
    write_mask(tmp_path / "a.png", ids)
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "L"
    back = read_id_mask(tmp_path / "a.png")
    assert back.dtype == np.uint16 and np.array_equal(back, ids)


def test_sixteen_bits_keep_large_ids_and_ignore(tmp_path):
    ids = np.array([[0, 1, 300], [IGNORE, 65534, 255]], dtype=np.int32)
    write_mask(tmp_path / "a.png", ids)
    assert np.array_equal(read_id_mask(tmp_path / "a.png"), ids)
    assert np.array_equal(read_id_mask(str(tmp_path / "a.png"), ignore_ids=[255]), ids)  # ignore_ids: 8-bit files only


def test_ignore_ids_of_eight_bit_files(tmp_path):
    write_mask(tmp_path / "a.png", np.array([[0, 1, 254, 255]]))
    assert read_id_mask(tmp_path / "a.png", ignore_ids=[255, 254]).tolist() == [[0, 1, IGNORE, IGNORE]]
    assert read_id_mask(tmp_path / "a.png").tolist() == [[0, 1, 254, 255]]


def test_palette_images_give_indices_not_colours(tmp_path):
    image = Image.fromarray(np.array([[0, 2], [1, 2]], dtype=np.uint8), mode="P")
    image.putpalette([0, 0, 0, 200, 10, 10, 10, 200, 10])
    image.save(tmp_path / "a.png")
    assert read_id_mask(tmp_path / "a.png").tolist() == [[0, 2], [1, 2]]


GREY = np.array([[0, 100, 128], [255, 1, 127]], dtype=np.uint8)


@pytest.mark.parametrize(
    ("array", "inside"),
    [
        (GREY, GREY >= 128),  # blended outlines
        (np.repeat(GREY[..., None], 3, axis=2), GREY >= 128),
        (np.stack([GREY, 0 * GREY, 0 * GREY, 255 - GREY], axis=2), GREY >= 128),  # alpha says nothing
        (np.minimum(GREY, 1), GREY > 0),  # labels
        (np.array([[0, 300], [IGNORE, 1]], dtype=np.uint16), [[False, True], [False, True]]),
        (np.array([[True, False]]), [[True, False]]),
        (0 * GREY, GREY < 0),
    ],
)
def test_binary_masks_of_all_kinds(tmp_path, array, inside):
    Image.fromarray(array).save(tmp_path / "a.png")
    ones = read_object_mask(tmp_path / "a.png")
    ones[ones == IGNORE] = 0  # Masks of 16 bits alone hold it.
    assert ones.dtype == np.uint16 and np.array_equal(ones, np.asarray(inside, int))


TOLD = np.array([[0, 128, 255], [128, 0, 255]], dtype=np.uint8)


@pytest.mark.parametrize(
    ("array", "untold"),
    [
        (TOLD, TOLD == 128),
        (TOLD[..., None].repeat(3, axis=2), TOLD == 128),
        (np.stack([TOLD, 255 - TOLD], axis=2), TOLD == 128),  # alpha says nothing
        (np.maximum(TOLD, 128), TOLD != 255),  # no pixel is surely outside
        (np.array([[0, IGNORE, 1]], dtype=np.uint16), [[False, True, False]]),
        (np.minimum(TOLD, 128), TOLD < 0),  # an object in grey
        (np.where(TOLD == 0, np.uint8(1), TOLD), TOLD < 0),  # a blended outline has more shades
        (np.append(TOLD, [[64], [0]], axis=1).astype(np.uint8), np.zeros((2, 4), bool)),
        (np.stack([TOLD, 0 * TOLD, 0 * TOLD], axis=2), TOLD < 0),  # half red is no grey
    ],
)
def test_grey_beside_black_and_white_alone_cannot_be_told(tmp_path, array, untold):
    Image.fromarray(array).save(tmp_path / "a.png")
    ids = read_object_mask(tmp_path / "a.png")
    assert ids.dtype == np.uint16 and set(ids.ravel().tolist()) <= {0, 1, IGNORE}
    assert np.array_equal(ids == IGNORE, untold)


def test_a_picture_is_no_binary_mask(tmp_path):
    """Blended outlines and a single grey are masks; many shades in many pixels are not."""
    picture = np.random.default_rng(0).integers(80, 180, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "photo.png")
    with pytest.raises(UserError, match="photo.png is a picture: fill the object white on black") as raised:
        read_object_mask(tmp_path / "photo.png")
    assert "\n" not in str(raised.value)
    ramp = np.clip(np.arange(600) - 170, 0, 255).astype(np.uint8)  # 192 of 1000 pixels are shades
    outline = np.concatenate([ramp, np.full(400, 255, np.uint8)])[None].repeat(3, axis=0)
    for name, array in (("blended", outline), ("grey", np.where(outline > 128, np.uint8(200), np.uint8(0)))):
        Image.fromarray(array).save(tmp_path / f"{name}.png")
        assert (read_object_mask(tmp_path / f"{name}.png") == (array >= 128)).all()


def test_one_bit_images_are_ids_0_and_1(tmp_path):
    Image.fromarray(np.array([[True, False]])).save(tmp_path / "a.png")
    assert read_id_mask(tmp_path / "a.png").tolist() == [[1, 0]]


def test_missing_lossy_and_colour_files_are_refused(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.jpg")
    for read in (read_object_mask, read_id_mask):
        with pytest.raises(UserError, match="none.png does not exist"):
            read(tmp_path / "none.png")
        with pytest.raises(UserError, match="a.jpg is a JPEG"):
            read(tmp_path / "a.jpg")
    Image.fromarray(np.zeros((4, 4, 4), dtype=np.uint8)).save(tmp_path / "rgba.png")
    with pytest.raises(UserError, match="rgba.png has colours"):
        read_id_mask(tmp_path / "rgba.png")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((2, 2)), "integers"),
        (np.zeros((2, 2, 3), dtype=np.uint8), "integers"),
        (np.array([[-1]]), "-1"),
        (np.array([[65536]]), "65536"),
    ],
)
def test_only_ids_can_be_written(tmp_path, array, message):
    with pytest.raises(UserError, match=message):
        write_mask(tmp_path / "a.png", array)


def test_names(tmp_path):
    path = tmp_path / "classes.json"
    path.write_text('{"10": "cup", "2": " saucer "}')
    assert list(read_classes(path).items()) == [(0, "background"), (2, "saucer"), (10, "cup")]
    assert read_classes(path, [0, 2, 3, IGNORE]) == {0: "background", 2: "saucer", 3: "class_3", 10: "cup"}
    assert read_classes(tmp_path / "none.json", [1]) == {0: "background", 1: "class_1"}
    assert read_classes(None, [1]) == {0: "background", 1: "class_1"}
    path.write_text('{"0": "table"}')
    assert read_classes(path) == {0: "table"}


def test_wrong_and_missing_names_are_refused(tmp_path):
    with pytest.raises(UserError, match="do not exist"):
        read_classes(tmp_path / "classes.json")
    with pytest.raises(UserError, match="70000"):
        read_classes(None, [70000])
    for text, message in (
        ('{"cup": 1}', "'cup'"),
        ('{"65535": "cup"}', "'65535'"),
        ('{"1": {"name": "x"}}', "no name"),
    ):
        (tmp_path / "classes.json").write_text(text)
        with pytest.raises(UserError, match=message):
            read_classes(tmp_path / "classes.json")


def test_colours_are_stable_and_distinct():
    ids = np.arange(64).reshape(8, 8)
    colors = colorize(ids)
    assert colors.dtype == np.uint8 and colors.shape == (8, 8, 3)
    assert len(np.unique(colors.reshape(-1, 3), axis=0)) == 64
    assert colors[0, 0].tolist() == [0, 0, 0]
    assert np.array_equal(colorize(ids[3:5, 2:4]), colors[3:5, 2:4])
    assert colorize(np.array([[IGNORE]], dtype=np.uint16)).tolist() == [[[128, 128, 128]]]
    assert colorize(np.zeros((0, 4), dtype=np.uint16)).shape == (0, 4, 3)


@pytest.mark.parametrize("shape", [(0, 3), (1, 1), (5, 7), (40, 30, 3)])
def test_ids_are_counted(shape):
    labels = np.random.default_rng(3).choice(np.array([0, 1, 1, 1, 9, IGNORE], np.uint16), shape)
    ids, pixels = np.unique(labels, return_counts=True)
    counted = count_ids(labels)
    assert counted[0].tolist() == ids.tolist() and counted[1].tolist() == pixels.tolist()
    assert counted[1].dtype == np.int64


def test_an_image_too_large_to_decode_is_refused(tmp_path, monkeypatch):
    write_mask(tmp_path / "a.png", np.zeros((20, 20), np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)  # Pillow refuses more than twice as many
    for read in (read_id_mask, image_size):
        with pytest.raises(UserError, match="a.png cannot be read as an image"):
            read(tmp_path / "a.png")


def test_names_that_could_not_be_read_back_are_refused():
    check_names({0: "background", 1: "cup", 7: "box"})
    for wrong, message in (
        ({1: "background"}, "'background' to two classes"),
        ({1: "cup", 2: " cup"}, "'cup' to two classes"),
        ({3: " "}, "the class 3 of the masks has no name"),
        ({IGNORE: "cup"}, "class id 65535"),
    ):
        with pytest.raises(UserError, match=message):
            check_names(wrong)


def test_a_silhouette_of_which_nothing_can_be_told_holds_no_object(tmp_path):
    Image.fromarray(np.minimum(TOLD, 128)).save(path := tmp_path / "mask.png")
    assert (read_object_mask(path, truth=True) == np.where(TOLD >= 128, IGNORE, 0)).all()
    Image.fromarray(GREY).save(path)
    assert (read_object_mask(path, truth=True) == (GREY >= 128)).all(), "blended outlines stay what they are"
