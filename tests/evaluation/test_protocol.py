"""Choices of the evaluation protocol against computations in numpy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask, truth
from scipy.ndimage import binary_erosion

from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.metrics import MaskMetrics, mask_metrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.system.errors import UserError

NO_FIGURES = MaskMetrics(None, None, None)
pytestmark = pytest.mark.filterwarnings("ignore:Mean of empty slice")


def ratio(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def band(mask: np.ndarray, width: int) -> np.ndarray:
    return mask & ~binary_erosion(mask, np.ones((3, 3)), iterations=width, border_value=0)


def blobs(seed: int, height: int = 60, width: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Return two overlapping ellipses, the second with specks."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    masks = []
    for _ in range(2):
        cy, cx = height / 2 + generator.uniform(-4, 4), width / 2 + generator.uniform(-4, 4)
        ry, rx = generator.uniform(12, 25, size=2)
        masks.append(((y - cy) / ry) ** 2 + ((x - cx) / rx) ** 2 < 1)
    masks[1] ^= generator.random((height, width)) < 0.01
    return masks[0], masks[1]


@pytest.mark.parametrize("share", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("seed", range(3))
def test_the_band_has_the_width_asked_for(share, seed):
    true, predicted = blobs(seed)
    width = max(1, round(share * 100))  # the diagonal of 60 x 80
    found = mask_metrics(predicted, true, None, Protocol(band_share=share))
    assert found.biou == ratio(band(predicted, width), band(true, width))
    assert found.iou == ratio(predicted, true)


def test_the_prediction_is_resized():
    true, predicted = blobs(5)
    small = predicted[1::3, 1::3]  # the nearest pixels of a third: the middle ones
    ignored = np.zeros_like(true)
    ignored[:, :30] = True
    by_prediction = mask_metrics(small, true[:60, :78], ignored[:, :78], Protocol())
    assert small.shape == (20, 27)
    rows, columns = (np.arange(60) * 2 + 1) * 20 // 120, (np.arange(78) * 2 + 1) * 27 // 156
    large = small[rows][:, columns][:, 30:]
    assert by_prediction.iou == ratio(large, true[:, 30:78])


def test_a_mask_that_is_empty_in_both_is_left_out_and_one_that_should_be_empty_counts_zero():
    nothing, something = np.zeros((8, 9), bool), np.ones((8, 9), bool)
    assert mask_metrics(nothing, nothing) == mask_metrics(something, something, something) == NO_FIGURES
    assert mask_metrics(something, nothing) == MaskMetrics(0.0, 0.0, 0.0)
    # The cup has one mask with half of its pixels rendered; the box has one that is empty in truth and rendering.
    views = [EvalView(camera(), None, None, {1: square_mask(*CUP)}), EvalView(camera(), None, None, {2: truth() > 9})]
    x, y, half = CUP
    surfels, ids = scene([(x - half / 2, y, half), FLOOR]), torch.tensor([1, 0], dtype=torch.int32)
    metrics = evaluate_scene(surfels, Membership(ids), Squares(), SETTINGS, views, CLASSES)
    expected = ratio(square_mask(x - half / 2, y, half).numpy(), square_mask(*CUP).numpy())
    assert metrics.mean.extracted is not None and metrics.mean.extracted.iou == pytest.approx(expected)
    assert metrics.objects[2].extracted == NO_FIGURES


class Ramp(Squares):
    """Alpha and colour grow from 0 at the left to 1 at the right."""

    def rasterize(self, inputs, camera, settings, background, target=None):
        drawn = super().rasterize(inputs, camera, settings, background)
        ramp = ((torch.arange(camera.width) + 0.5) / camera.width).expand(camera.height, -1)
        return replace(drawn, alpha=ramp, color=ramp[..., None] * inputs.colors[0])


@pytest.mark.parametrize("threshold", [0.0, 0.25, 0.5, 0.9])
def test_the_threshold_cuts_both_kinds(threshold):
    view = EvalView(camera(), None, truth(), {1: square_mask(*CUP)})
    protocol = Protocol(threshold=threshold)
    ids = torch.tensor([1], dtype=torch.int32)
    metrics = evaluate_scene(scene([CUP]), Membership(ids), Ramp(), SETTINGS, [view], {1: "cup"}, protocol=protocol)
    predicted = np.broadcast_to((np.arange(SIZE) + 0.5) / SIZE > threshold, (SIZE, SIZE))
    cup = metrics.objects[1]
    assert cup.extracted is not None and cup.rendered is not None
    assert cup.extracted.iou == ratio(predicted, square_mask(*CUP).numpy())
    assert cup.rendered.iou == ratio(predicted, (truth() == 1).numpy())


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (dict(threshold=1.0), "threshold is 1.0"),
        (dict(threshold=math.nan), "threshold is nan"),
        (dict(band_share=0.0), "band_share is 0.0"),
        (dict(band_share=math.inf), "band_share is inf"),
    ],
)
def test_choices_that_cannot_be(choice, words):
    with pytest.raises(UserError, match=words):
        Protocol(**choice).check()
    Protocol().check()
