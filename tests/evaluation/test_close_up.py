"""Objects are scored at the size of the photos' files, and only their box is drawn."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask
from rich.console import Console

from beags_plugin.core.cameras import cropped
from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.close_up import MARGIN, _similarity
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, FullPhoto, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.table import render_run
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.photometric import ssim_map

FINE = 4  # files of photos are so many times as large as training photos
IDS = torch.tensor([1, 2, 0], dtype=torch.int32)


class FineSquares(Squares):
    """``Squares`` at the scale and place of the camera."""

    def __init__(self) -> None:
        self.sizes: list[tuple[int, int]] = []

    def rasterize(self, inputs, camera, settings, background, target=None):
        self.sizes.append((camera.width, camera.height))
        scale = float(camera.K[0, 0]) / 20.0
        shift = torch.stack([camera.K[0, 2] - scale * SIZE / 2, camera.K[1, 2] - scale * SIZE / 2, torch.zeros(())])
        moved = replace(inputs, means=inputs.means * scale + shift)
        return super().rasterize(moved, camera, settings, background, target)


def fine(mask: torch.Tensor) -> torch.Tensor:
    return mask.repeat_interleave(FINE, 0).repeat_interleave(FINE, 1)


def view(photo: torch.Tensor | None = None, **options) -> EvalView:
    """Return a view whose photo has a file ``FINE`` times as large; the photo is what the scene shows unless given."""
    small = camera()
    full = replace(small, K=small.K * torch.tensor([FINE, FINE, 1.0])[:, None], width=FINE * SIZE, height=FINE * SIZE)
    photo = torch.full((FINE * SIZE, FINE * SIZE, 3), 0.3) if photo is None else photo

    def region(box):
        left, top, right, bottom = box
        return cropped(full, left, top, right - left, bottom - top), photo[top:bottom, left:right]

    masks = {1: fine(square_mask(*CUP)), 2: fine(square_mask(*BOX))}
    plain = EvalView(small, torch.full((SIZE, SIZE, 3), 0.3), silhouettes=masks, visible_objects=masks)
    return replace(plain, full=FullPhoto(full, region), **options)


def evaluated(squares, ids, one: EvalView, rasterizer=None, **options) -> SceneMetrics:
    members = Membership(torch.as_tensor(ids, dtype=torch.int32))
    return evaluate_scene(
        scene(list(squares)), members, rasterizer or FineSquares(), SETTINGS, [one], CLASSES, **options
    )


def test_a_perfect_scene_is_perfect_at_any_size():
    metrics = evaluated([CUP, BOX, FLOOR], IDS, view())
    for found in (metrics.mean.close_up, metrics.objects[1].close_up):
        assert (found.iou, found.biou, found.spill) == (1.0, 1.0, 0.0) and found.psnr > 100
        assert found.ssim == pytest.approx(1.0)


def test_what_is_finer_than_the_training_photos_counts():
    """A photo that differs in every second fine pixel is the same grey when shrunk."""
    photo = torch.full((FINE * SIZE, FINE * SIZE, 3), 0.2)
    photo[:, ::2] = 0.4
    metrics = evaluated([CUP, BOX, FLOOR], IDS, view(photo))
    assert metrics.psnr > 100 and metrics.objects[1].close_up.psnr == pytest.approx(20.0, abs=1e-3)
    assert metrics.objects[1].close_up.ssim < 0.1
    half = (CUP[0] + 1 / FINE, *CUP[1:])  # the cup one fine pixel too far right
    moved = evaluated([half, BOX, FLOOR], IDS, view())
    assert moved.objects[1].extracted.iou == 1.0 and moved.objects[1].close_up.iou == pytest.approx(31 / 33)


def test_only_the_box_around_an_object_is_drawn():
    rasterizer = FineSquares()
    small = (4.0, 5.0, 1.0)
    evaluated([small], [1], view(silhouettes=None, visible_objects={1: fine(square_mask(*small))}), rasterizer)
    sides = {size for size in rasterizer.sizes if size != (SIZE, SIZE)}
    assert sides == {(round(2 * FINE * (1 + 2 * MARGIN)),) * 2}


def test_stray_gaussians_near_the_object_spill_and_unknown_pixels_do_not_count():
    stray = (CUP[0], CUP[1] - 6.0, 1.0)
    metrics = evaluated([CUP, BOX, FLOOR, stray], [1, 2, 0, 1], view())
    assert metrics.objects[1].close_up.spill == pytest.approx(4 / 64)
    unknown = {1: fine(square_mask(*stray))}
    metrics = evaluated([CUP, BOX, FLOOR, stray], [1, 2, 0, 1], view(unknown_silhouettes=unknown))
    assert metrics.objects[1].close_up.spill == 0.0 and metrics.objects[1].close_up.iou == 1.0


def test_nothing_is_scored_without_a_larger_photo_or_a_mask():
    assert evaluated([CUP, BOX, FLOOR], IDS, replace(view(), full=None)).mean.close_up is None
    labels = torch.full((SIZE, SIZE), IGNORE, dtype=torch.int32)
    nothing = replace(view(), silhouettes=None, visible_objects=None, visible=labels)
    assert evaluated([CUP, BOX, FLOOR], IDS, nothing).mean.close_up is None


def test_the_table_and_the_files_have_it():
    after = evaluated([CUP, BOX, FLOOR], IDS, view())
    run = RunMetrics("desk", "config.yml", Protocol(), CLASSES, None, after)
    out = io.StringIO()
    Console(file=out, width=100).print(render_run(run))
    assert "objects at the photos' own size" in out.getvalue()
    content = json.loads(json.dumps(run.to_json()))
    assert content["objects"]["cup"]["close_up"]["after"]["biou"] == 1.0
    plain = replace(run, after=evaluated([CUP, BOX, FLOOR], IDS, replace(view(), full=None)))
    Console(file=(out := io.StringIO()), width=100).print(render_run(plain))
    assert "own size" not in out.getvalue()


def test_similarity_in_strips_is_that_of_the_whole_picture(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    color, photo = (torch.rand((40, 23, 3), generator=generator) for _ in range(2))
    inside = torch.rand((40, 23), generator=generator) < 0.4
    monkeypatch.setattr("beags_plugin.evaluation.close_up.STRIP", 7)
    assert torch.equal(_similarity(color, photo, inside), ssim_map(color, photo)[inside])
