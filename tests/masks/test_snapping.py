"""Outlines of reprojected masks: votes, the view's own mask and edges of the photo together."""

import numpy as np
import pytest
import torch

cv2 = pytest.importorskip("cv2")

from beags_plugin.labels.class_ids import IGNORE  # noqa: E402
from beags_plugin.masks import snapping  # noqa: E402
from beags_plugin.masks.snapping import own_outlines, snap_to_edges  # noqa: E402
from beags_plugin.preparation.consistent_masks import OWN, WINDOW, with_snapped_outlines  # noqa: E402

HEIGHT, WIDTH = 90, 120


def scene(contrast=0.3, seed=0):
    """A disc on a ground of another colour, both with noise; returns the photo [H, W, 3] uint8 and the exact labels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    reach = np.hypot(x - 60.0, y - 45.0)
    coverage = np.clip(25.5 - reach, 0.0, 1.0)  # of the pixel, about
    generator = np.random.default_rng(seed)
    photo = 0.3 + contrast * coverage[..., None] * [1.0, 0.5, -0.5] + generator.normal(0.0, 0.02, (HEIGHT, WIDTH, 3))
    return (255.0 * np.clip(photo, 0.0, 1.0)).astype(np.uint8), (reach < 25.0).astype(np.uint16)


def grown(labels):
    return cv2.dilate(labels, np.ones((3, 3), np.uint8))


def ragged(labels, generator):
    """Every pixel on either side of the outline is wrong with a probability of 0.3."""
    band = (grown(labels) != labels) | (cv2.erode(labels, np.ones((3, 3), np.uint8)) != labels)
    return np.where(band & (generator.uniform(size=labels.shape) < 0.3), 1 - labels, labels).astype(np.uint16)


def excess(found, exact):
    """The net area that a mask has too much, in pixels."""
    return int((found > exact).sum()) - int((found < exact).sum())


def test_an_outline_that_all_votes_put_too_far_out_comes_half_way_back_and_the_own_masks_noise_does_not_come_in():
    photo, exact = scene()
    own, voted = ragged(exact, np.random.default_rng(1)), grown(exact)
    found = snap_to_edges(voted, photo, 1, own_outlines(voted, own), OWN, WINDOW)
    assert abs(excess(found, exact)) < 0.5 * excess(voted, exact)
    assert (found != exact).sum() < 0.8 * (own != exact).sum() < 0.8 * (voted != exact).sum()


def test_noise_at_an_outline_goes_where_the_photo_has_an_edge():
    photo, exact = scene()
    noisy = ragged(exact, np.random.default_rng(1))
    assert (snap_to_edges(noisy, photo, 1) != exact).sum() < 0.5 * (noisy != exact).sum()


def test_without_an_edge_in_the_photo_votes_and_the_own_mask_share_the_error():
    _, exact = scene()
    flat = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    both = snap_to_edges(grown(exact), flat, 1, exact)
    assert 0 <= excess(both, exact) < excess(grown(exact), exact)
    np.testing.assert_array_equal(snap_to_edges(exact, flat, 1, exact), exact)
    as_in_presets = snap_to_edges(grown(exact), flat, 1, exact, OWN, WINDOW)
    assert excess(both, exact) <= excess(as_in_presets, exact) < excess(grown(exact), exact)


def test_an_edge_of_little_contrast_counts_too():
    photo, exact = scene(contrast=0.05)
    smooth = cv2.GaussianBlur(photo, (0, 0), 1.0)  # little noise, as in a photo that was made smaller
    flat = np.full_like(photo, 90)
    wrong, without = ((snap_to_edges(grown(exact), guide, 1, window=2) != exact).sum() for guide in (smooth, flat))
    assert wrong < 0.9 * without


def test_the_own_mask_counts_at_outlines_alone():
    voted = np.zeros((12, 12), np.uint16)
    voted[3:9, 3:9] = 1
    own = np.full_like(voted, 2)  # wrong everywhere, in a class that no voted pixel has
    np.testing.assert_array_equal(own_outlines(voted, own), voted)
    found = own_outlines(voted, np.zeros_like(voted))  # the object is missing
    assert found[4:8, 4:8].all() and not found[3].any()


def test_pixels_far_from_outlines_and_unlabelled_ones_stay():
    photo, exact = scene()
    voted = exact.copy()
    voted[40:50, 55:65] = IGNORE
    found = snap_to_edges(voted, photo, 1, own_outlines(voted, ragged(exact, np.random.default_rng(2))))
    assert (found[40:50, 55:65] == IGNORE).all()
    band = grown(exact) != cv2.erode(exact, np.ones((3, 3), np.uint8))
    band[39:51, 54:66] = True
    np.testing.assert_array_equal(found[~band], voted[~band])


def test_filtering_the_box_of_a_class_gives_what_the_whole_picture_gives(monkeypatch):
    photo, exact = scene()
    labels = exact.copy()
    labels[2:6, 3:20] = 2
    labels[85:, 110:] = 3  # at a corner of the picture
    small = [snap_to_edges(labels, photo, 1, grown(labels), OWN, window) for window in (1, WINDOW)]
    monkeypatch.setattr(snapping, "_around", lambda indicator, margin: (slice(None), slice(None)))
    whole = [snap_to_edges(labels, photo, 1, grown(labels), OWN, window) for window in (1, WINDOW)]
    np.testing.assert_array_equal(small, whole)


def test_the_labels_are_the_same_for_any_number_of_threads():
    photo, exact = scene()
    photo, labels = np.tile(photo, (6, 6, 1)), np.tile(exact, (6, 6))
    before = cv2.getNumThreads()
    try:
        found = []
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            found.append(snap_to_edges(grown(labels), photo, 1, labels, OWN, WINDOW))
    finally:
        cv2.setNumThreads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)


def test_tensors_keep_their_type_and_a_view_may_have_no_mask():
    photo, exact = scene()
    voted = torch.from_numpy(grown(exact).astype(np.int32))
    image = torch.from_numpy(photo).float() / 255.0
    alone = with_snapped_outlines(voted, None, image)
    assert alone.dtype == torch.int32
    np.testing.assert_array_equal(alone.numpy(), snap_to_edges(grown(exact), photo, 1, window=WINDOW))
    own = torch.from_numpy(exact.astype(np.int32))
    assert 0 <= excess(with_snapped_outlines(voted, own, image).numpy(), exact) < excess(alone.numpy(), exact)
