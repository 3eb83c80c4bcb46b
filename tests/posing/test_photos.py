"""Photos as cameras and phones store them: turned, with a focal length, and among other files."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycolmap")
from photographed_corner import camera, look_alike, photograph, quiet
from PIL import ExifTags, Image

from beags_plugin.posing.photos import check_photos, copy_photos, find_photos

EXIF_IFD = 0x8769


def save(path, picture, turned=1, focal=None):
    """Write a photo whose EXIF tells its turn and its focal length on film of 35 mm."""
    image = Image.fromarray(picture)
    exif = image.getexif()
    exif[ExifTags.Base.Orientation] = turned
    if focal is not None:
        exif.get_ifd(EXIF_IFD)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
    image.save(path, exif=exif, quality=95)


def test_photos_are_copied_upright_with_the_focal_length_that_exif_tells(tmp_path):
    taken, images = tmp_path / "taken", tmp_path / "scene/images"
    taken.mkdir()
    landscape, portrait = photograph(camera(0.6)), photograph(camera(0.8), turned=True)
    save(taken / "a.jpg", landscape, focal=28)
    save(taken / "b.JPG", np.rot90(portrait), turned=6, focal=28)
    save(taken / "c.jpg", np.rot90(portrait, 2), turned=3)
    Image.fromarray(landscape).convert("RGBA").save(taken / "d.png")
    (taken / "notes.txt").write_text("not a photo")
    photos = check_photos(find_photos(taken), images, quiet)
    assert [(photo.width, photo.height) for photo in photos] == [(320, 240), (240, 320), (240, 320), (320, 240)]
    on_film = 28 / 36 * 320  # a frame of film is 36 mm wide
    for photo in photos[:2]:
        assert photo.focal == pytest.approx(on_film, rel=0.05)
    assert photos[2].focal is None and photos[3].focal is None
    copy_photos(photos, quiet)
    assert (images / "a.jpg").read_bytes() == (taken / "a.jpg").read_bytes()
    for name, true in (("b.JPG", portrait), ("c.jpg", portrait)):
        copy = Image.open(images / name)
        assert copy.getexif().get(ExifTags.Base.Orientation, 1) == 1
        assert look_alike(np.asarray(copy), true)
    again = check_photos(find_photos(images), images, quiet)
    assert [photo.focal for photo in again] == [photo.focal for photo in photos]
    assert sorted(path.name for path in images.iterdir()) == ["a.jpg", "b.JPG", "c.jpg", "d.png"]
