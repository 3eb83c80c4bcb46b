"""Large JPEG photos are decoded smaller where few pixels suffice."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from beags_plugin.system.reading.images import read_image
from beags_plugin.views.split_photos import AVERAGED, resize_area


@pytest.mark.parametrize(
    "size, enough, decoded",
    [
        ((800, 600), 200, (200, 150)),
        ((800, 600), 201, (400, 300)),
        ((600, 800), 300, (300, 400)),
        ((800, 600), 401, (800, 600)),
        ((800, 602), 200, (400, 301)),
        ((801, 533), 200, (801, 533)),
        ((800, 600), 10, (100, 75)),
        ((800, 600), None, (800, 600)),
    ],
)
def test_a_jpeg_keeps_at_least_the_pixels_asked_for(tmp_path, size, enough, decoded):
    for name in ("a.jpg", "a.png"):
        Image.new("RGB", size, (90, 120, 30)).save(tmp_path / name)
    jpeg, png = (read_image(tmp_path / name, np.array, enough=enough) for name in ("a.jpg", "a.png"))
    assert jpeg.shape[1::-1] == decoded and png.shape[1::-1] == size
    np.testing.assert_allclose(jpeg.mean((0, 1)), (90, 120, 30), atol=2)


def test_a_photo_of_the_training_size_looks_the_same(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (75, 100, 3), np.uint8)
    Image.fromarray(noise).resize((1600, 1200), Image.Resampling.BICUBIC).save(tmp_path / "a.jpg", quality=95)
    whole = resize_area(read_image(tmp_path / "a.jpg", np.array), 100, 75)
    small = read_image(tmp_path / "a.jpg", np.array, enough=AVERAGED * 100)
    assert small.shape == (75 * AVERAGED, 100 * AVERAGED, 3)
    difference = resize_area(small, 100, 75).astype(int) - whole
    assert abs(difference.mean()) < 0.5 and np.abs(difference).mean() < 1.5
