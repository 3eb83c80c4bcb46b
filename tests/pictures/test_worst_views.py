"""The picture of the worst masks: their ranking and the colour at each pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask, truth

from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.metrics import MaskMetrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.pictures.cells import CAPTION, GAP, crop, square_around, wrapped
from beags_plugin.pictures.worst_views import (
    COLORS,
    LEFT_OUT,
    MISSED,
    RIGHT,
    WRONG,
    WorstMask,
    draw_worst,
    error_map,
    error_window,
    paint,
    worst_records,
    worst_views_picture,
)

SHIFTED = (CUP[0] + 2, CUP[1], CUP[2])  # the cup, two pixels too far to the right
GREY = 100


def evaluated(protocol: Protocol | None = None):
    """Evaluate a cup that refinement moves back by two pixels; in view 1 no box hides it."""
    protocol = protocol or Protocol()
    ids = Membership(torch.tensor([1, 2, 0], dtype=torch.int32))
    before, after = scene([SHIFTED, BOX, FLOOR]), scene([CUP, BOX, FLOOR])
    photo = torch.full((SIZE, SIZE, 3), GREY / 255)
    views = [
        EvalView(camera(), photo, truth(), {1: square_mask(*CUP), 2: square_mask(*BOX)}, "first"),
        EvalView(camera(), None, None, {1: square_mask(*SHIFTED)}, "second"),
    ]
    metrics = [
        evaluate_scene(surfels, ids, Squares(), SETTINGS, views, CLASSES, protocol=protocol)
        for surfels in (before, after)
    ]
    run = RunMetrics("lab", "config.yml", protocol, CLASSES, *metrics)
    return run, {"before": (before, ids), "after": (after, ids)}, views


def test_an_error_map_has_a_code_for_each_kind_of_pixel():
    predicted = torch.tensor([[True, True, False, False, True]])
    true = torch.tensor([[True, False, True, False, True]])
    ignore = torch.tensor([[False, False, False, False, True]])
    assert error_map(predicted, true, ignore).tolist() == [[RIGHT, WRONG, MISSED, 0, LEFT_OUT]]
    large = true.repeat_interleave(3, 0).repeat_interleave(3, 1)
    assert error_map(predicted, large, None).shape == (3, 15)


def test_errors_are_painted_over_the_photograph():
    photo = np.full((1, 5, 3), GREY, dtype=np.uint8)
    painted = paint(photo, np.array([[0, RIGHT, MISSED, WRONG, LEFT_OUT]], dtype=np.uint8))
    assert painted[0, 0].tolist() == [GREY] * 3
    for x, code in enumerate((RIGHT, MISSED, WRONG, LEFT_OUT), 1):
        assert painted[0, x].tolist() == [(GREY + channel) // 2 for channel in COLORS[code]]
    assert (photo == GREY).all()  # It is not painted in place.


def test_the_worst_come_first():
    run, _, _ = evaluated()
    extracted = [(r.view, r.class_id) for r in run.after.masks if r.kind == "extracted"]
    assert extracted == [(0, 1), (0, 2), (1, 1)]
    first = worst_records(run, "extracted", 2)[0]
    assert (run.after.masks[first].view, run.after.masks[first].class_id) == (1, 1)
    counts = [len(worst_records(run, *query)) for query in (("extracted", 2), ("extracted", 9), ("rendered", 9))]
    assert counts == [2, 3, 2]


def test_the_drawn_errors_are_those_of_the_figures():
    run, scenes, views = evaluated()
    counts: list[tuple[int, int]] = []
    found = draw_worst(run, scenes, views, Squares(), SETTINGS, 1, lambda *steps: counts.append(steps))
    assert counts == [(1, 2), (2, 2)]
    assert [mask.kind for mask in found] == ["extracted", "rendered"]
    worst = found[0]  # the second view, whose truth is the shifted cup
    assert worst.title == "lab, second: cup"
    y = int(CUP[1])
    left, right = int(CUP[0] - CUP[2]), int(CUP[0] + CUP[2])
    assert (worst.errors["before"][y, left + 2 : right + 2] == RIGHT).all()
    assert worst.errors["after"][y].tolist() == (
        [0] * left + [WRONG] * 2 + [RIGHT] * (right - left - 2) + [MISSED] * 2 + [0] * (SIZE - right - 2)
    )
    for stage, errors in worst.errors.items():
        counts = {code: (errors == code).sum() for code in (RIGHT, MISSED, WRONG)}
        assert worst.metrics[stage].iou == counts[RIGHT] / sum(counts.values())
    assert worst.score == worst.metrics["after"].iou
    assert (worst.photo == 128).all() and (found[1].photo == GREY).all()  # no photograph: grey


def test_the_picture_has_the_colours_at_their_places():
    run, scenes, views = evaluated()
    masks = [m for m in draw_worst(run, scenes, views, Squares(), SETTINGS, 1) if m.kind == "extracted"]
    picture = worst_views_picture(masks, 1)
    for code, color in COLORS.items():  # the legend's box of each
        assert (picture[:24] == color).all(-1).sum() >= 16 * 16, code
    top, left, side = error_window(masks[0])
    start = 24 + GAP + 24 + GAP + CAPTION  # legend, heading, caption
    cells = [picture[start : start + 240, x : x + 240] for x in (0, 240 + GAP, 2 * (240 + GAP))]

    def pixel(cell: np.ndarray, x: float, y: float) -> list[int]:
        scale = 240 / side
        return cell[int((y - top + 0.5) * scale), int((x - left + 0.5) * scale)].tolist()

    y = int(CUP[1])
    wrong, missed, right = int(CUP[0] - CUP[2]), int(CUP[0] + CUP[2]), int(CUP[0])
    tint = {code: [(128 + channel) // 2 for channel in COLORS[code]] for code in COLORS}
    assert pixel(cells[0], right, y) == [128] * 3
    assert pixel(cells[1], wrong, y) == [128] * 3 and pixel(cells[1], missed, y) == tint[RIGHT]
    assert pixel(cells[2], wrong, y) == tint[WRONG] and pixel(cells[2], missed, y) == tint[MISSED]
    assert pixel(cells[2], right, y) == tint[RIGHT]


def test_masks_of_several_runs_are_ranked_together():
    def mask(title: str, iou: float | None) -> WorstMask:
        errors = np.full((9, 9), RIGHT, dtype=np.uint8)
        photo = np.full((9, 9, 3), round(200 * (iou or 1)), dtype=np.uint8)
        return WorstMask(title, "extracted", photo, {"after": errors}, {"after": MaskMetrics(1.0, iou, 0.5)})

    picture = worst_views_picture([mask("a", 0.9), mask("b", 0.1), mask("c", 0.5), mask("d", None)], count=2)
    assert picture.shape[0] == 24 + GAP + 24 + GAP + 2 * (240 + CAPTION + GAP) + GAP
    middle = picture[24 + GAP + 24 + GAP + CAPTION + 120 :: 240 + CAPTION + GAP, 120]
    assert middle[:2].tolist() == [[20] * 3, [100] * 3]
    with pytest.raises(ValueError, match="at least one"):
        worst_views_picture([])


def test_a_crop_may_leave_the_image():
    shown = np.zeros((10, 20), bool)
    shown[0:4, 17:20] = True
    top, left, side = square_around(shown)
    assert side == 8 and (top, left) == (-2, 14)
    part = crop(np.ones((10, 20, 3), np.uint8), (top, left, side), 7)
    assert part.shape == (8, 8, 3) and (part[2:, :6] == 1).all() and (part[:2] == 7).all() and (part[:, 6:] == 7).all()
    assert square_around(np.zeros((10, 20), bool)) == (0, 0, 20)


def test_groups_are_wrapped_but_never_torn():
    groups = [[np.full((5, 30, 3), 10 * group, np.uint8)] * 2 for group in range(4)]
    lines = wrapped(groups, 2 * 2 * (30 + GAP))
    assert [line.shape for line in lines] == [(5, 4 * (30 + GAP), 3)] * 2
    assert lines[1][0, 0, 0] == 20
    assert len(wrapped(groups, 1)) == 4  # a group wider than the line stands alone
