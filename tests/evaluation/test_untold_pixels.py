"""Pixels that may or may not be the object's count nowhere, whatever is drawn there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask

from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.metrics import MaskMetrics, boundary_band, mask_metrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.truths import extracted_truth, object_pixels
from beags_plugin.pictures.worst_views import LEFT_OUT, draw_worst

X, Y, HALF = CUP
UNTOLD = square_mask(*CUP) & (torch.arange(SIZE) < X)  # the cup's left half
TOLD = square_mask(*CUP) & ~UNTOLD
QUARTERS = [(X + HALF / 2, y, HALF / 2) for y in (Y - HALF / 2, Y + HALF / 2)]  # the cup's told quarters
STRAY = (20.0, 20.0, 1.5)  # two by two pixels


def evaluated(view: EvalView, squares, ids, **options) -> SceneMetrics:
    members = Membership(torch.tensor([*ids, 0], dtype=torch.int32))
    return evaluate_scene(scene([*squares, FLOOR]), members, Squares(), SETTINGS, [view], CLASSES, **options)


def views() -> dict[str, EvalView]:
    """Return a truth of each kind for a cup whose left half cannot be told."""
    cup, unknown = {1: TOLD}, {1: UNTOLD}
    return {
        "extracted": EvalView(camera(), None, silhouettes=cup, unknown_silhouettes=unknown),
        "rendered": EvalView(camera(), None, visible_objects=cup, unknown_visible=unknown),
    }


@pytest.mark.parametrize("kind", ["extracted", "rendered"])
def test_what_is_drawn_there_changes_no_figure(kind):
    """A cup is right without its untold half, with a quarter of it and with all of it."""
    untold = [(x - HALF, y, half) for x, y, half in QUARTERS]
    for squares in (QUARTERS, [*QUARTERS, untold[0]], [*QUARTERS, *untold]):
        cup = getattr(evaluated(views()[kind], squares, [1] * len(squares)).objects[1], kind)
        assert cup == MaskMetrics(1.0, 1.0, 1.0, *((None, 0.0) if kind == "rendered" else (0.0, None)))
    told = replace(views()[kind], unknown_silhouettes=None, unknown_visible=None)
    assert getattr(evaluated(told, [CUP], [1]).objects[1], kind).iou == pytest.approx(0.5)


def test_a_region_that_cannot_be_told_makes_no_boundary():
    """The band of the truth lies along sure outside, not along the region; a hole beside the region is wrong."""
    truth = extracted_truth(views()["extracted"], 1)
    band = boundary_band(truth.compared().numpy(), 1) & TOLD.numpy()
    assert band[int(Y - HALF)].any() and not band[int(Y), int(X)]  # the band follows the top, not the untold half
    hole = truth.compared() & ~square_mask(X + 1, Y, 1)
    found = mask_metrics(hole, truth.compared(), truth.unknown)
    wrong = boundary_band(hole.numpy(), 1) & TOLD.numpy()
    assert found.biou == (wrong & band).sum() / (wrong | band).sum() < 1.0
    plain = mask_metrics(hole, truth.mask, truth.unknown)
    assert plain.biou != found.biou  # if the region counted as outside, the hole would reach a boundary


def test_spill_keeps_away_from_what_may_be_the_object():
    """A stray square spills whole, by half beside a small untold region, and not at all within one."""
    x, y, _ = STRAY
    for untold, spilled in ((UNTOLD, 4), (square_mask(x - 2, y, 1.0), 2), (square_mask(*STRAY), 0)):
        view = EvalView(camera(), None, silhouettes={1: TOLD}, unknown_silhouettes={1: untold})
        found = evaluated(view, [*QUARTERS, STRAY], [1, 1, 1]).objects[1].extracted
        assert found is not None and found.spill == spilled / 32


def test_an_untold_pixel_of_another_object_may_hide_this_one():
    """A whole box stands behind a cup that is known, that cannot be told, or that has no mask."""
    cup = square_mask(*CUP)
    box = square_mask(*BOX) & ~cup
    known = EvalView(camera(), None, visible_objects={1: cup, 2: box})
    untold = EvalView(camera(), None, visible_objects={1: cup & False, 2: box}, unknown_visible={1: cup})
    without = replace(untold, unknown_visible=None)
    ious = [evaluated(view, [CUP, BOX], [1, 2]).objects[2].extracted.iou for view in (known, untold, without)]
    assert ious == [1.0, 1.0, pytest.approx(0.5)]


def test_pixels_of_objects_leave_them_out():
    view = EvalView(camera(), torch.full((SIZE, SIZE, 3), 0.3), visible_objects={1: TOLD}, unknown_visible={1: UNTOLD})
    assert not (object_pixels(view) & UNTOLD).any() and (object_pixels(view) & TOLD).any()


def test_the_picture_of_the_worst_shows_them_as_not_scored():
    view = views()["extracted"]
    metrics = evaluated(view, [CUP, STRAY], [1, 1])
    run = RunMetrics("lab", "c", Protocol(), CLASSES, None, metrics)
    members = Membership(torch.tensor([1, 1, 0], dtype=torch.int32))
    (worst,) = draw_worst(run, {"after": (scene([CUP, STRAY, FLOOR]), members)}, [view], Squares(), SETTINGS, 1)
    assert np.array_equal(worst.errors["after"] == LEFT_OUT, UNTOLD.numpy())
