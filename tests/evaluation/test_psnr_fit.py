"""PSNR after the best affine colour fit, where exposure and white balance cost nothing."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from known_masks import BOX, CLASSES, CUP, FLOOR, SETTINGS, SIZE, Squares, camera, scene, square_mask, truth
from rich.console import Console

from beags_plugin.core.membership import Membership
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView, SceneMetrics
from beags_plugin.evaluation.report import RunMetrics
from beags_plugin.evaluation.run_metrics import evaluate_scene, psnr_after_fit
from beags_plugin.evaluation.table import protocol_line, render_run

COLORS = torch.tensor([[0.9, 0.1, 0.4], [0.2, 0.7, 0.3], [0.5, 0.5, 0.8]])  # cup, box, floor
IDS = torch.tensor([1, 2, 0], dtype=torch.int32)


def evaluated(photo: torch.Tensor, **options) -> SceneMetrics:
    surfels = scene([CUP, BOX, FLOOR])
    surfels = replace(surfels, sh_dc=(COLORS - 0.5) / 0.28209479177387814)
    view = EvalView(camera(), photo, truth())
    return evaluate_scene(surfels, Membership(IDS), Squares(), SETTINGS, [view], CLASSES, **options)


def warm_photo() -> torch.Tensor:
    """Return the drawn picture, darker and warmer."""
    photo = torch.zeros(SIZE, SIZE, 3)
    for square, color in zip((FLOOR, BOX, CUP), COLORS.flip(0), strict=True):
        photo[square_mask(*square)] = color * torch.tensor([0.8, 0.6, 0.4]) + 0.05
    return photo


def test_exposure_and_white_balance_are_fitted_away_and_nothing_else():
    photo = warm_photo()
    metrics = evaluated(photo)
    assert metrics.psnr < 15 and metrics.psnr_fit == metrics.views[0].psnr_fit > 100
    photo[:2, :2, 0] += 0.4  # four pixels show something else
    metrics, error = evaluated(photo), 4 * 0.4**2 / (3 * SIZE**2)
    assert metrics.psnr < 15 and metrics.psnr_fit == pytest.approx(-10 * math.log10(error), abs=0.1)


@pytest.mark.parametrize("fitted", [False, True])
def test_parts_of_images_are_scored_after_the_fit_where_exposures_were_learned(fitted):
    shown = square_mask(*BOX)
    metrics = evaluated(warm_photo(), shown=[shown], colors_fitted=fitted)
    for value in (metrics.psnr_shown, metrics.psnr_objects):
        assert value > 100 if fitted else value < 20
    assert metrics.psnr < 15 and metrics.psnr_fit > 100 and metrics.colors_fitted == fitted
    other = evaluated(warm_photo(), shown=[shown])
    assert (metrics.psnr, metrics.psnr_fit, metrics.ssim) == (other.psnr, other.psnr_fit, other.ssim)


def test_objects_trained_alone_are_fitted_by_their_own_pixels():
    """Pixels outside of them were never compared with the photo."""
    photo, other = warm_photo(), 1 - warm_photo()
    photo = torch.where((truth() > 0)[..., None], photo, other)
    metrics = evaluated(photo, objects_alone=True, colors_fitted=True)
    assert metrics.psnr_objects > 100 and metrics.psnr is metrics.psnr_fit is None


def test_a_rendering_of_one_colour_is_fitted_to_the_mean():
    photo = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    spread = float(photo.double().var(dim=(0, 1), correction=0).mean())
    assert psnr_after_fit(torch.full_like(photo, 0.5), photo) == pytest.approx(-10 * math.log10(spread))


def test_fitted_values_are_clamped():
    """The line through three greys leaves 0..1, in which all photos lie."""
    rendered, photo = np.array([0.2, 0.5, 0.8, 0.8]), np.array([0.0, 0.7, 1.0, 1.0])
    line = np.polyval(np.polyfit(rendered, photo, 1), rendered)
    assert line.max() > 1.01
    error = np.mean((line.clip(0, 1) - photo) ** 2)
    images = (torch.from_numpy(values)[:, None, None].expand(-1, 1, 3) for values in (rendered, photo))
    assert psnr_after_fit(*images) == pytest.approx(-10 * np.log10(error), abs=1e-4)


def test_tables_and_files_say_which_is_which():
    before, after = evaluated(warm_photo().roll(6, 1)), evaluated(warm_photo().roll(3, 0))
    run = RunMetrics("lab", "c", Protocol(), CLASSES, before, after)
    fitted = evaluated(warm_photo(), shown=[square_mask(*BOX)], colors_fitted=True)
    exposed = RunMetrics("lab", "c", Protocol(), CLASSES, fitted, fitted)
    words = "PSNR shown and PSNR objects are taken after the colour fit"
    assert words in protocol_line(exposed) and words not in protocol_line(run)
    assert exposed.to_json()["colors_fitted"] and not run.to_json()["colors_fitted"]
    content = run.to_json()
    assert content["psnr_fit"] == content["views"][0]["psnr_fit"]
    assert content["psnr_fit"] == {"before": before.psnr_fit, "after": after.psnr_fit} != content["psnr"]
    fitted = [f"{scene.psnr_fit:.2f}" for scene in (before, after)]
    out = io.StringIO()
    Console(file=out, width=120).print(render_run(run))
    lines = out.getvalue().splitlines()
    assert f"PSNR after colour fit, dB: {fitted[0]} → {fitted[1]}" in lines
