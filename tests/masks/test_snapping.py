"""Outlines of masks: labels and edges of the photo together."""

import numpy as np
import pytest
from scipy import ndimage
from source_scenes import coloured

cv2 = pytest.importorskip("cv2")

from beags_plugin.labels.class_ids import IGNORE  # noqa: E402
from beags_plugin.masks import snapping  # noqa: E402
from beags_plugin.masks.snapping import snap_to_edges  # noqa: E402
from beags_plugin.system.errors import UserError  # noqa: E402

HEIGHT, WIDTH = 90, 120


def scene(contrast=0.3, seed=0):
    """A disc on a ground of another colour, both with noise; returns the photo [H, W, 3] uint8 and the exact labels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    reach = np.hypot(x - 60.0, y - 45.0)
    coverage = np.clip(25.5 - reach, 0.0, 1.0)  # about the disc's share of each pixel
    generator = np.random.default_rng(seed)
    photo = 0.3 + contrast * coverage[..., None] * [1.0, 0.5, -0.5] + generator.normal(0.0, 0.02, (HEIGHT, WIDTH, 3))
    return (255.0 * np.clip(photo, 0.0, 1.0)).astype(np.uint8), (reach < 25.0).astype(np.uint16)


def grown(labels):
    return cv2.dilate(labels, np.ones((3, 3), np.uint8))


def ragged(labels, generator):
    """Every pixel on either side of the outline is wrong with a probability of 0.3."""
    band = (grown(labels) != labels) | (cv2.erode(labels, np.ones((3, 3), np.uint8)) != labels)
    return np.where(band & (generator.uniform(size=labels.shape) < 0.3), 1 - labels, labels).astype(np.uint16)


def test_noise_at_an_outline_goes_where_the_photo_has_an_edge():
    photo, exact = scene()
    noisy = ragged(exact, np.random.default_rng(1))
    assert (snap_to_edges(noisy, photo, 1) != exact).sum() < 0.5 * (noisy != exact).sum()


def test_an_edge_of_little_contrast_counts_too():
    photo, exact = scene(contrast=0.05)
    smooth = cv2.GaussianBlur(photo, (0, 0), 1.0)  # little noise, as in a photo that was made smaller
    flat = np.full_like(photo, 90)
    wrong, without = ((snap_to_edges(grown(exact), guide, 2) != exact).sum() for guide in (smooth, flat))
    assert wrong < 0.9 * without


def test_pixels_far_from_outlines_and_unlabelled_ones_stay():
    photo, exact = scene()
    voted = exact.copy()
    voted[40:50, 55:65] = IGNORE
    found = snap_to_edges(voted, photo, 1)
    assert (found[40:50, 55:65] == IGNORE).all()
    band = grown(exact) != cv2.erode(exact, np.ones((3, 3), np.uint8))
    band[39:51, 54:66] = True
    np.testing.assert_array_equal(found[~band], voted[~band])


def test_filtering_the_box_of_a_class_gives_what_the_whole_picture_gives(monkeypatch):
    photo, exact = scene()
    labels = exact.copy()
    labels[2:6, 3:20] = 2
    labels[85:, 110:] = 3  # This class lies at a corner of the picture.
    small = [snap_to_edges(labels, photo, radius) for radius in (1, 2)]
    monkeypatch.setattr(snapping, "_around", lambda indicator, margin: (slice(None), slice(None)))
    whole = [snap_to_edges(labels, photo, radius) for radius in (1, 2)]
    np.testing.assert_array_equal(small, whole)


def test_the_labels_are_the_same_for_any_number_of_threads():
    photo, exact = scene()
    photo, labels = np.tile(photo, (6, 6, 1)), np.tile(exact, (6, 6))
    before = cv2.getNumThreads()
    try:
        found = []
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            found.append(snap_to_edges(grown(labels), photo, 2))
    finally:
        cv2.setNumThreads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)


def test_outlines_snap_to_the_edge_of_the_photo():
    photo, disc = coloured()
    exact = disc.astype(np.uint16)
    ragged = exact.copy()
    row, column = np.mgrid[:70, :90]
    bumps = (row // 4 + column // 4) % 2 == 0
    ragged[ndimage.binary_dilation(disc, iterations=2) & bumps] = 1
    ragged[0, 0] = IGNORE
    snapped = snap_to_edges(ragged, photo, 4)
    assert snapped[0, 0] == IGNORE
    snapped[0, 0] = 0
    assert (snapped != exact).sum() < 0.4 * (ragged != exact).sum()
    far = ndimage.distance_transform_edt(~(ndimage.binary_dilation(disc, iterations=3) & ~ndimage.binary_erosion(disc)))
    assert not ((snapped != ragged) & (far > 8))[5:].any()
    np.testing.assert_array_equal(snap_to_edges(ragged, photo, 0), ragged)


def test_plain_opencv_has_no_guided_filter(monkeypatch):
    monkeypatch.setattr(cv2, "ximgproc", type("shell", (), {}))  # what plain opencv installed over contrib leaves
    labels = np.zeros((8, 9), np.uint16)
    labels[2:5] = 1
    with pytest.raises(UserError, match="run beags doctor"):
        snap_to_edges(labels, np.zeros((8, 9, 3), np.uint8), 2)
