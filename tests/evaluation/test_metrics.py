"""Mask metrics against counts done by hand and by brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from beags_plugin.evaluation.metrics import MaskMetrics, band_width, boundary_band, covered, mask_metrics, psnr, spill
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.labels.class_ids import resize_nearest


def mask(*rows: str) -> np.ndarray:
    return np.array([[c == "#" for c in row] for row in rows])


def brute_erode(image: np.ndarray, times: int) -> np.ndarray:
    """Erode as the definition says: by 3x3, repeatedly, with False outside."""
    for _ in range(times):
        out = np.zeros_like(image)
        for i in range(image.shape[0]):
            for j in range(image.shape[1]):
                out[i, j] = all(
                    0 <= i + a < image.shape[0] and 0 <= j + b < image.shape[1] and image[i + a, j + b]
                    for a in (-1, 0, 1)
                    for b in (-1, 0, 1)
                )
        image = out
    return image


def test_hand_computed():
    truth = mask("#####", "#####", "#####", "#####", "#####")
    predicted = mask("#####", "#####", "#####", "#####", ".....")
    # d = 1: the truth's band is all but the 3x3 middle (16 pixels), the prediction's all but a 2x3 one (20 - 6 = 14);
    # they share the top row (5), rows 1 and 2 at both ends (4) and row 3 at both ends (2): 11 of 16 + 14 - 11 = 19.
    assert mask_metrics(predicted, truth) == MaskMetrics(acc=20 / 25, iou=20 / 25, biou=11 / 19, spill=0.0)
    truth, predicted = mask("##..", "##..", "....", "...."), mask(".##.", ".##.", "....", "....")
    empty, perfect = np.zeros_like(truth), MaskMetrics(1.0, 1.0, 1.0, 0.0)
    assert mask_metrics(predicted, truth) == MaskMetrics(acc=12 / 16, iou=2 / 6, biou=2 / 6, spill=0.0)
    assert mask_metrics(torch.from_numpy(predicted), torch.from_numpy(truth)) == mask_metrics(predicted, truth)
    assert mask_metrics(empty, truth) == MaskMetrics(acc=12 / 16, iou=0.0, biou=0.0, spill=0.0)
    assert mask_metrics(truth, empty) == MaskMetrics(acc=12 / 16, iou=0.0, biou=0.0, spill=None)
    assert mask_metrics(truth, truth) == perfect


def test_ignored_pixels_leave_every_count():
    truth = mask("##..", "##..", "....", "....")
    predicted = mask("###.", "##..", "....", "...#")
    ignore = mask("..#.", "....", "....", "...#")
    assert mask_metrics(predicted, truth, ignore) == MaskMetrics(1.0, 1.0, 1.0, 0.0)
    assert mask_metrics(predicted, truth).iou == 4 / 6
    assert mask_metrics(predicted, truth).spill == 1 / 4  # only the far corner is further than d = 1


def test_covered_is_what_a_mask_lacks():
    truth, predicted = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    truth[:2], predicted[1:] = True, True
    assert covered(predicted, truth) == 0.5 and covered(~truth, truth) == 1.0
    assert covered(predicted, truth, ignore=~predicted) == 0.0
    assert covered(predicted, ~truth & False) is None


@pytest.mark.parametrize("seed", range(4))
def test_spill_is_what_lies_beyond_the_margin(seed):
    """The definition, pixel by pixel: counted pixels further than d from every pixel of the truth."""
    generator = np.random.default_rng(seed)
    truth, predicted = np.zeros((40, 60), bool), generator.random((40, 60)) < 0.3
    truth[12:20, 20:33] = True
    truth[30, 50] = True
    ignore = generator.random((40, 60)) < 0.2
    rows, columns = np.nonzero(truth)
    y, x = np.mgrid[:40, :60]
    nearest = np.hypot(y[..., None] - rows, x[..., None] - columns).min(axis=2)
    for share in (0.02, 0.1):
        d = max(1, round(share * math.hypot(40, 60)))
        area = np.count_nonzero(truth & ~ignore)
        expected = np.count_nonzero(predicted & ~ignore & (nearest > d)) / area
        assert mask_metrics(predicted, truth, ignore, Protocol(band_share=share)).spill == expected > 0
        assert spill(predicted, truth, ~ignore, d) == expected
    assert mask_metrics(np.ones_like(truth), truth).spill > 5  # a share of the truth's area, not of the mask's
    assert mask_metrics(~truth & (nearest <= 1.4), truth).spill == 0.0
    assert mask_metrics(predicted, truth, truth).spill is None  # nothing is left to be a share of


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("width", [1, 2, 3])
def test_the_band_matches_brute_force(seed, width):
    image = np.random.default_rng(seed).random((17, 23)) < 0.97
    image[:9, :12] = True  # touches the image border, where the outside erodes it
    expected = brute_erode(image, width)
    assert expected.any() and not expected.all()
    assert np.array_equal(boundary_band(image, width), image & ~expected)
    assert boundary_band(np.ones((3, 4), bool), 5).all()  # a mask smaller than the window


def test_band_width_is_at_least_one():
    assert band_width(4, 4) == 1
    assert band_width(240, 320) == 8
    assert band_width(1080, 1920) == 44


def test_resize_is_nearest_and_to_the_truth():
    small = mask("#.", ".#")
    assert np.array_equal(resize_nearest(small, 4, 6), np.kron(small, np.ones((2, 3), bool)))
    assert np.array_equal(resize_nearest(np.kron(small, np.ones((2, 3), bool)), 2, 2), small)
    truth = np.kron(small, np.ones((5, 5), bool))
    assert mask_metrics(small, truth) == MaskMetrics(1.0, 1.0, 1.0, 0.0)
    # Centres of 3 pixels over 5: 0.83, 2.5, 4.17.
    assert np.array_equal(resize_nearest(np.arange(5)[None], 1, 3), [[0, 2, 4]])


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="ignore"):
        mask_metrics(np.ones((2, 2), bool), np.ones((2, 2), bool), np.ones((3, 3), bool))
    with pytest.raises(ValueError, match=r"\[H, W\]"):
        mask_metrics(np.ones((2, 2, 1), bool), np.ones((2, 2), bool))
    with pytest.raises(ValueError, match="compared"):
        psnr(np.zeros((2, 2)), np.zeros((2, 3)))


def test_psnr():
    a = torch.zeros(4, 5, 3)
    assert psnr(a, a) == math.inf
    assert psnr(a, a + 0.1) == pytest.approx(20.0, abs=1e-5)
    b = a.clone()
    b[0, 0, 0] = 1.0
    assert psnr(a, b) == pytest.approx(10 * math.log10(60))
