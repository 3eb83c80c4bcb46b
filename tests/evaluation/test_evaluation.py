"""A run's figures, table, JSON and picture, on scenes drawn by a stand-in rasterizer whose masks are known."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask, truth

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.evaluation.metrics import MaskMetrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, ObjectMetrics, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.table import print_run, summary_json
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.pictures.contact_sheet import (
    SheetRow,
    contact_sheet,
    draw_rows,
    interpolate_cameras,
    novel_camera,
    write_contact_sheet,
)
from beags_plugin.system.errors import UserError


def test_a_perfect_scene_scores_one():
    surfels, ids = scene([CUP, BOX, FLOOR]), torch.tensor([1, 2, 0], dtype=torch.int32)
    silhouettes = {1: square_mask(*CUP), 2: square_mask(*BOX)}
    view = EvalView(camera(), torch.full((SIZE, SIZE, 3), 0.3), truth(), silhouettes)
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [view], CLASSES)
    perfect = MaskMetrics(1.0, 1.0, 1.0)
    assert metrics.mean == ObjectMetrics(perfect, perfect)
    assert metrics.objects == {1: ObjectMetrics(perfect, perfect), 2: ObjectMetrics(perfect, perfect)}
    assert metrics.extracted_truth == "silhouette"
    assert metrics.psnr is not None and metrics.psnr > 100


def test_a_stray_surfel_costs_what_it_covers():
    """A floor surfel of 4x4 pixels is labelled cup: extracted IoU 64 / 80, hidden or not; rendered only where seen."""
    stray = (20.0, 20.0, 2.0)
    surfels, ids = scene([CUP, BOX, FLOOR, stray]), torch.tensor([1, 2, 0, 1], dtype=torch.int32)
    view = EvalView(camera(), None, truth(), {1: square_mask(*CUP), 2: square_mask(*BOX)})
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [view], CLASSES)
    cup = metrics.objects[1]
    assert cup.extracted is not None and cup.rendered is not None
    assert cup.extracted.iou == pytest.approx(64 / 80)
    assert cup.extracted.acc == pytest.approx(1 - 16 / SIZE**2)
    assert cup.rendered.iou == 1.0  # the floor lies before the stray one
    assert metrics.mean.extracted is not None
    assert metrics.mean.extracted.iou == pytest.approx((64 / 80 + 1) / 2)
    assert metrics.psnr is None


def test_only_labelled_objects_are_scored():
    """Only the cup's visible mask is known: the box is not scored, though it is seen; the id image does not count."""
    surfels, ids = scene([CUP, BOX, FLOOR]), torch.tensor([1, 2, 0], dtype=torch.int32)
    wrong = torch.full((SIZE, SIZE), 2, dtype=torch.int32)
    view = EvalView(camera(), None, wrong, visible_objects={1: square_mask(*CUP)})
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [view], CLASSES)
    assert metrics.objects == {1: metrics.mean, 2: ObjectMetrics(None, None)}
    assert metrics.mean == ObjectMetrics(MaskMetrics(1.0, 1.0, 1.0), MaskMetrics(1.0, 1.0, 1.0))
    assert metrics.extracted_truth == "visible"


def test_pixels_of_other_labelled_objects_are_left_out_of_extracted_masks():
    """The box is whole behind the cup; its visible mask lacks the part that the cup, labelled too, covers."""
    surfels, ids = scene([CUP, BOX, FLOOR]), torch.tensor([1, 2, 0], dtype=torch.int32)
    seen = {1: square_mask(*CUP), 2: square_mask(*BOX) & ~square_mask(*CUP)}
    both = EvalView(camera(), None, visible_objects=seen)
    alone = EvalView(camera(), None, visible_objects={2: seen[2]})
    for view, iou in ((both, 1.0), (alone, 0.5)):
        box = evaluate_scene(surfels, ids, Squares(), SETTINGS, [view], CLASSES).objects[2]
        assert box.extracted is not None and box.extracted.iou == pytest.approx(iou)
        assert box.rendered is not None and box.rendered.iou == 1.0


def test_without_silhouettes_what_lies_behind_others_is_left_out():
    """The box is complete behind the cup: compared with its visible half, the covered half must not count."""
    surfels, ids = scene([CUP, BOX, FLOOR]), torch.tensor([1, 2, 0], dtype=torch.int32)
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [EvalView(camera(), None, truth())], CLASSES)
    assert metrics.extracted_truth == "visible"
    box = metrics.objects[2]
    assert box.extracted is not None and box.extracted.iou == 1.0 and box.extracted.acc == 1.0


def test_ignored_pixels_do_not_count():
    stray = (20.0, 20.0, 2.0)
    surfels, ids = scene([stray, CUP, BOX, FLOOR]), torch.tensor([1, 1, 2, 0], dtype=torch.int32)
    labels = truth()
    labels[square_mask(*stray)] = IGNORE
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [EvalView(camera(), None, labels)], CLASSES)
    cup = metrics.objects[1]
    assert cup.extracted is not None and cup.extracted.iou == 1.0
    assert cup.rendered is not None and cup.rendered.iou == 1.0


def test_the_mean_is_over_masks_and_an_object_without_surfels_scores_zero():
    surfels, ids = scene([CUP, FLOOR]), torch.tensor([1, 0], dtype=torch.int32)
    views = [
        EvalView(camera(), None, None, {1: square_mask(*CUP), 2: square_mask(*BOX)}),
        EvalView(camera(), None, None, {1: square_mask(*CUP)}),
    ]
    seen = []
    metrics = evaluate_scene(
        surfels, ids, Squares(), SETTINGS, views, CLASSES, progress=lambda done, total: seen.append((done, total))
    )
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
    metrics = evaluate_scene(scene(squares), ids, Squares(), SETTINGS, [view], classes)
    assert [m.rendered.iou for m in metrics.objects.values() if m.rendered] == [1.0] * 4


def test_the_image_is_compared_after_clamping():
    surfels, ids = scene([FLOOR], grey=1.5), torch.zeros(1, dtype=torch.int32)
    view = EvalView(camera(), torch.full((SIZE, SIZE, 3), 0.9))
    metrics = evaluate_scene(surfels, ids, Squares(), SETTINGS, [view], CLASSES)
    assert metrics.psnr == pytest.approx(20.0, abs=1e-4)  # an error of 0.1 everywhere


SECONDS = {"base": 12.345}


def report(classes: dict[int, str] | None = None) -> RunMetrics:
    def stage(value: float, psnr: float) -> SceneMetrics:
        one = ObjectMetrics(MaskMetrics(value, value - 0.1, value - 0.2), MaskMetrics(value, value, value))
        return SceneMetrics(one, {1: one, 2: ObjectMetrics(None, None)}, psnr, "silhouette")

    return RunMetrics("lab", "config.yml", Protocol(), classes or CLASSES, stage(0.8, 30.0), stage(0.9, math.inf))


def test_the_summary_has_the_documented_keys():
    summary = json.loads(json.dumps(summary_json(report(), SECONDS, 812.0), allow_nan=False))
    assert set(summary) == {"mean", "objects", "psnr", "seconds", "peak_memory_mb"}
    assert set(summary["objects"]) == {"cup", "box"}
    for row in (summary["mean"], summary["objects"]["cup"]):
        assert set(row) == {"extracted", "rendered"}
        assert row["extracted"]["assigned"] == pytest.approx({"acc": 0.8, "iou": 0.7, "biou": 0.6})
        assert row["rendered"]["refined"] == pytest.approx({"acc": 0.9, "iou": 0.9, "biou": 0.9})
    assert summary["objects"]["box"]["extracted"]["refined"] == {"acc": None, "iou": None, "biou": None}
    assert summary["psnr"] == {"before": 30.0, "after": None}  # infinity is no JSON
    assert summary["seconds"] == {"base": 12.345} and summary["peak_memory_mb"] == 812.0


def test_equal_names_stay_apart():
    assert set(report({1: "cup", 2: "cup"}).to_json()["objects"]) == {"cup (1)", "cup (2)"}


def test_a_run_without_a_former_state_has_no_before():
    content = replace(report(), before=None).to_json()
    assert content["mean"]["extracted"]["before"] == {"acc": None, "iou": None, "biou": None}
    assert content["mean"]["extracted"]["after"]["acc"] == 0.9 and content["psnr"]["before"] is None


def test_the_table_shows_both_stages():
    from rich.console import Console

    out = io.StringIO()
    print_run(report(), SECONDS, 812.0, Console(file=out, width=80))
    cells = [line.split() for line in out.getvalue().splitlines()]
    assert ["cup", "before", "80.0", "70.0", "60.0", "80.0", "80.0", "80.0"] in cells
    assert ["after", "90.0", "80.0", "70.0", "90.0", "90.0", "90.0"] in cells
    assert ["box", "before", *6 * ["–"]] in cells
    for part in ("PSNR, dB: 30.00 → –", "base 12.3", "812 MB", "silhouettes"):
        assert part in out.getvalue()


def test_half_way_between_two_cameras():
    quat = torch.tensor([math.cos(0.3), 0, math.sin(0.3), 0])  # a turn of 0.6 about y
    viewmat = torch.eye(4)
    viewmat[:3, :3] = rotation_from_quat(quat)
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([2.0, 0, 0])
    turned = Camera(viewmat, camera().K, SIZE, SIZE)
    middle = interpolate_cameras(camera(), turned, 0.5)
    assert torch.allclose(middle.center, torch.tensor([1.0, 0, 0]), atol=1e-6)
    expected = rotation_from_quat(torch.tensor([math.cos(0.15), 0, math.sin(0.15), 0]))
    assert torch.allclose(middle.rotation, expected, atol=1e-6)
    for fraction, end in ((0.0, camera()), (1.0, turned)):
        assert torch.allclose(interpolate_cameras(camera(), turned, fraction).viewmat, end.viewmat, atol=1e-6)


def test_the_novel_view_lies_towards_the_nearest_one():
    views = [EvalView(camera(shift), None) for shift in (0.0, 5.0, -1.0)]
    novel = novel_camera(views)
    assert novel is not None
    assert torch.allclose(novel.center, 0.5 * (views[0].camera.center + views[2].camera.center), atol=1e-6)
    assert novel_camera(views[:1]) is None


def test_the_sheet_shows_objects_before_and_after(tmp_path):
    before, after = scene([CUP, BOX, FLOOR]), scene([CUP, BOX, FLOOR], grey=0.6)
    ids = torch.tensor([1, 2, 0], dtype=torch.int32)
    views = [EvalView(camera(s), torch.rand(SIZE, SIZE, 3), truth(), name=f"view {s}") for s in (0.0, 1.0)]
    told: list[tuple[int, int]] = []
    progress = lambda done, total: told.append((done, total))  # noqa: E731
    rows = draw_rows(views, (before, ids), (after, ids), [1, 2], Squares(), SETTINGS, progress=progress)
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert [row.name for row in rows] == ["view 0.0", "view 1.0", "novel view"]
    assert np.array_equal(rows[0].after[1][..., 3] == 255, square_mask(*CUP).numpy())
    assert (rows[0].before[1][12, 8, :3] == 76).all() and (rows[0].after[1][12, 8, :3] == 153).all()
    write_contact_sheet(tmp_path / "out" / "sheet.png", rows, CLASSES)
    from PIL import Image

    with Image.open(tmp_path / "out" / "sheet.png") as picture:
        sheet = np.asarray(picture)
    assert np.array_equal(sheet, contact_sheet(rows, CLASSES))
    # three rows, each of seven cells: photo, mask, render, and two objects before and after
    assert sheet.shape[0] > 3 * 220 and sheet.shape[1] > 7 * 220
    for grey in (76, 153):
        assert (sheet == grey).all(axis=-1).sum() > 1000


def test_a_sheet_of_many_objects_is_no_wider_than_a_screen():
    cell = np.zeros((SIZE, SIZE, 4), dtype=np.uint8)
    shown = {index: np.where(np.arange(4) < 3, 30 * index, 255) + cell for index in range(1, 8)}
    shown = {index: image.astype(np.uint8) for index, image in shown.items()}
    row = SheetRow("v", None, None, np.zeros((SIZE, SIZE, 3), np.uint8), shown, shown)
    sheet = contact_sheet([row], {index: str(index) for index in shown})
    assert sheet.shape[1] <= 1920 and sheet.shape[0] == 3 * (220 + 18 + 4)  # 2, then 4, then 1 object
    for index in shown:
        assert (sheet == 30 * index).all(-1).sum() > 220 * 220  # of both stages, with the crop's margin


def test_a_sheet_survives_absent_parts():
    blank = np.zeros((SIZE, 2 * SIZE, 3), dtype=np.uint8)
    nothing = {1: np.zeros((SIZE, 2 * SIZE, 4), dtype=np.uint8)}
    row = SheetRow("an → name", None, None, blank, nothing, nothing)
    assert contact_sheet([row], {1: "Tasse ☕"}).dtype == np.uint8
    with pytest.raises(ValueError, match="at least one row"):
        contact_sheet([], {})


def test_a_picture_that_cannot_be_written(tmp_path):
    blank = np.zeros((SIZE, SIZE, 3), dtype=np.uint8)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_contact_sheet(tmp_path / "file" / "sheet.png", [SheetRow("v", None, None, blank, {}, {})], {})
