"""Figures of a run, their table and JSON; a stand-in rasterizer draws known masks."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask, truth
from rich.console import Console

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import METRICS, MaskMetrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, ObjectMetrics, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.table import protocol_line, render_run, summary_json
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.torch_reference import TorchRasterizer

STRAY = (20.0, 20.0, 2.0)
IDS = torch.tensor([1, 2, 0], dtype=torch.int32)  # cup, box, floor
RENDERED = MaskMetrics(1.0, 1.0, 1.0, covered=0.0)
PERFECT = ObjectMetrics(replace(RENDERED, spill=0.0, covered=None), RENDERED)


def evaluated(squares, ids, *views: EvalView, **options) -> SceneMetrics:
    ids = torch.as_tensor(ids, dtype=torch.int32)
    return evaluate_scene(scene(list(squares)), Membership(ids), Squares(), SETTINGS, views, CLASSES, **options)


def test_a_perfect_scene_scores_one():
    silhouettes = {1: square_mask(*CUP), 2: square_mask(*BOX)}
    view = EvalView(camera(), torch.full((SIZE, SIZE, 3), 0.3), truth(), silhouettes)
    metrics = evaluated([CUP, BOX, FLOOR], IDS, view)
    assert metrics.mean == metrics.objects[1] == metrics.objects[2] == PERFECT
    assert metrics.extracted_truth == "silhouette"
    assert metrics.psnr is not None and metrics.psnr > 100


def test_a_stray_gaussian_costs_what_it_covers():
    """A floor Gaussian of 4x4 pixels is labelled cup; only the extracted mask shows it, as the floor hides it."""
    view = EvalView(camera(), None, truth(), {1: square_mask(*CUP), 2: square_mask(*BOX)})
    metrics = evaluated([CUP, BOX, FLOOR, STRAY], [1, 2, 0, 1], view)
    cup = metrics.objects[1]
    assert cup.extracted is not None and cup.rendered is not None and metrics.mean.extracted is not None
    assert cup.extracted.iou == pytest.approx(64 / 80)
    assert cup.extracted.acc == pytest.approx(1 - 16 / SIZE**2)
    assert cup.extracted.spill == 16 / 64 and cup.rendered.spill is None
    assert cup.rendered.iou == 1.0  # the floor lies before the stray one
    assert metrics.mean.extracted.iou == pytest.approx((64 / 80 + 1) / 2)
    assert metrics.psnr is None


def test_only_labelled_objects_are_scored():
    """Only the cup's visible mask is known, so the box that is seen and the id image do not count."""
    wrong = torch.full((SIZE, SIZE), 2, dtype=torch.int32)
    metrics = evaluated([CUP, BOX, FLOOR], IDS, EvalView(camera(), None, wrong, visible_objects={1: square_mask(*CUP)}))
    assert metrics.objects == {1: metrics.mean, 2: ObjectMetrics(None, None)}
    assert metrics.mean == PERFECT and metrics.extracted_truth == "visible"


def test_pixels_of_other_objects_are_left_out_of_extracted_masks():
    """The box is whole behind the cup; its visible mask lacks the part that the cup covers."""
    seen = {1: square_mask(*CUP), 2: square_mask(*BOX) & ~square_mask(*CUP)}
    views = [EvalView(camera(), None, visible_objects=known) for known in (seen, {2: seen[2]})]
    for view, iou in zip([EvalView(camera(), None, truth()), *views], (1.0, 1.0, 0.5), strict=True):
        metrics = evaluated([CUP, BOX, FLOOR], IDS, view)
        box = metrics.objects[2]
        assert metrics.extracted_truth == "visible" and box.extracted is not None and box.rendered is not None
        assert box.extracted.iou == pytest.approx(iou) and box.rendered.iou == 1.0


def test_what_is_drawn_before_another_object_counts_as_wrong():
    """The box is drawn whole before the cup, though the cup hides its left half."""
    box = evaluated([BOX, CUP, FLOOR], [2, 1, 0], EvalView(camera(), None, truth())).objects[2]
    assert box.extracted is not None and box.extracted.iou == pytest.approx(0.5)


@pytest.mark.parametrize("gap", [0.003, 0.1])
def test_layers_of_the_object_itself_hide_nothing(gap):
    """A haze of the box lies before two layers of the cup, and the truth says box everywhere.

    The surface of the whole scene is the cup's first layer, that of the cup alone its second.
    """
    depths, opacities = torch.tensor([1.0 - gap, 1.0, 1.0 + gap, 2.0]), torch.tensor([0.2, 0.45, 0.45, 0.99])
    surfels = Surfels.of(
        means=torch.stack([torch.zeros(4), torch.zeros(4), depths], dim=-1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        log_scales=torch.full((4, 2), 3.0),
        opacity_logits=torch.logit(opacities),
        sh=torch.zeros(4, 1, 3),
    )
    ids = Membership(torch.tensor([2, 1, 1, 2], dtype=torch.int32))
    view = EvalView(camera(), None, torch.full((SIZE, SIZE), 2, dtype=torch.int32))
    metrics = evaluate_scene(surfels, ids, TorchRasterizer(), SETTINGS, [view], CLASSES)
    cup = metrics.objects[1]
    assert cup.rendered is not None and cup.rendered.acc == 0.0  # the whole scene draws it everywhere
    assert cup.extracted is not None and cup.extracted.acc == 0.0


def test_ignored_pixels_do_not_count():
    labels = truth()
    labels[square_mask(*STRAY)] = IGNORE
    cup = evaluated([STRAY, CUP, BOX, FLOOR], [1, 1, 2, 0], EvalView(camera(), None, labels)).objects[1]
    assert cup.extracted is not None and cup.extracted.iou == 1.0
    assert cup.rendered is not None and cup.rendered.iou == 1.0


def test_the_mean_is_over_masks_and_an_object_without_gaussians_scores_zero():
    cup, seen = square_mask(*CUP), []
    views = [EvalView(camera(), None, None, known) for known in ({1: cup, 2: square_mask(*BOX)}, {1: cup})]
    metrics = evaluated([CUP, FLOOR], [1, 0], *views, progress=lambda *counts: seen.append(counts))
    assert metrics.objects[2].extracted is not None and metrics.objects[2].extracted.iou == 0.0
    assert metrics.mean.extracted is not None and metrics.mean.extracted.iou == pytest.approx(2 / 3)
    assert metrics.mean.rendered is None and metrics.objects[1].rendered is None
    assert seen == [(1, 2), (2, 2)]


def test_more_objects_than_colour_channels():
    squares = [(3.0 + 5 * i, 12.0, 2.0) for i in range(4)]
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    for i, square in enumerate(squares):
        labels[square_mask(*square)] = i + 1
    ids = torch.tensor([1, 2, 3, 4], dtype=torch.int32)
    classes = {i: str(i) for i in range(5)}
    view = EvalView(camera(), None, labels)
    metrics = evaluate_scene(scene(squares), Membership(ids), Squares(), SETTINGS, [view], classes)
    assert [m.rendered.iou for m in metrics.objects.values() if m.rendered] == [1.0] * 4


def test_the_image_is_compared_after_clamping():
    surfels, ids = scene([FLOOR], grey=1.5), torch.zeros(1, dtype=torch.int32)
    view = EvalView(camera(), torch.full((SIZE, SIZE, 3), 0.9))
    metrics = evaluate_scene(surfels, Membership(ids), Squares(), SETTINGS, [view], CLASSES)
    assert metrics.psnr == pytest.approx(20.0, abs=1e-4)  # an error of 0.1 everywhere


SECONDS = {"base": 12.345}


def report(classes: dict[int, str] | None = None) -> RunMetrics:
    def stage(value: float, psnr: float) -> SceneMetrics:
        one = ObjectMetrics(
            MaskMetrics(value, value - 0.1, value - 0.2, 1 - value), MaskMetrics(value, value, value, covered=1 - value)
        )
        return SceneMetrics(one, {1: one, 2: ObjectMetrics(None, None)}, psnr, "silhouette")

    return RunMetrics("lab", "config.yml", Protocol(), classes or CLASSES, stage(0.8, 30.0), stage(0.9, math.inf))


def test_the_summary_has_the_documented_keys():
    summary = json.loads(json.dumps(summary_json(report(), SECONDS, 812.0), allow_nan=False))
    assert set(summary) == {"mean", "objects", "psnr", "seconds", "peak_memory_mb"}
    assert set(summary["objects"]) == {"cup", "box"}
    for row in (summary["mean"], summary["objects"]["cup"]):
        assert set(row) == {"extracted", "rendered", "close_up"}
        assert row["extracted"]["assigned"] == pytest.approx({"acc": 0.8, "iou": 0.7, "biou": 0.6, "spill": 0.2})
        assert row["rendered"]["refined"] == pytest.approx({"acc": 0.9, "iou": 0.9, "biou": 0.9, "covered": 0.1})
    assert summary["objects"]["box"]["extracted"]["refined"] == dict.fromkeys(METRICS)
    assert summary["psnr"] == {"before": 30.0, "after": None}  # infinity is no JSON
    assert summary["seconds"] == {"base": 12.345} and summary["peak_memory_mb"] == 812.0


def test_equal_names_stay_apart():
    assert set(report({1: "cup", 2: "cup"}).to_json()["objects"]) == {"cup (1)", "cup (2)"}


def test_a_run_without_a_former_state_has_no_before():
    content = replace(report(), before=None).to_json()
    assert content["mean"]["extracted"]["before"] == dict.fromkeys(METRICS)
    assert content["mean"]["extracted"]["after"]["acc"] == 0.9 and content["psnr"]["before"] is None


def test_the_table_shows_both_stages():
    out = io.StringIO()
    Console(file=out, width=80).print(render_run(report(), SECONDS, 812.0))
    cells = [line.split() for line in out.getvalue().splitlines()]
    assert ["cup", "before", "80.0", "70.0", "60.0", "20.0", "80.0", "80.0", "80.0"] in cells
    assert ["after", "90.0", "80.0", "70.0", "10.0", "90.0", "90.0", "90.0"] in cells
    assert ["box", "before", *7 * ["–"]] in cells
    assert "worst: cup" in out.getvalue()
    for part in (
        "PSNR, dB: 30.00 → –",
        "base 12.3",
        "812 MB",
        "Protocol: extracted masks against whole occlusion-free",
    ):
        assert part in out.getvalue()


def test_without_scored_masks_there_is_no_protocol_of_masks():
    """The sentences on images stay where there are such figures."""
    nothing = ObjectMetrics(None, None)
    images = SceneMetrics(nothing, {1: nothing}, 30.0, None, psnr_shown=31.0, shown=0.9, colors_fitted=True)
    for after, ending in (
        (images, "dB: 31.00\nPSNR shown: over the pixels"),
        (replace(images, psnr_shown=None, shown=None), "dB: 30.00\n"),
    ):
        out = io.StringIO()
        run = replace(report(), before=None, after=after)
        Console(file=out, width=1000).print(render_run(run))
        text = "\n".join(line.strip() for line in out.getvalue().splitlines()) + "\n"
        assert "Protocol" not in text and "masks" not in text and ending in text
        assert ("PSNR shown is taken after the colour fit" in text) == (after is images)
    assert "silhouettes" in protocol_line(report())
