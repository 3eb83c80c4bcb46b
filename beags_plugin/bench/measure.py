"""What a refined run has to show: photo and mask metrics before and after refinement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from beags_plugin.evaluation.run_metrics import EvalView, ObjectMetrics, SceneMetrics, evaluate_scene
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings


def measure_run(config_path: Path) -> dict[str, Any]:
    """{"before": figures, "after": figures, "gaussians": n} of a run that refined (or only assigned).

    figures: {"psnr": dB, "ssim": 0..1, "extracted": {"acc", "iou", "biou"}, "rendered": {...},
    "objects": {name: {"extracted": {...}, "rendered": {...}}}}; mask figures in 0..1, None where unknown.
    before: the base with the classes of this very run, which is what assignment alone gives.
    """
    from beags_plugin.losses.photometric import ssim
    from beags_plugin.plugin.evaluate import held_out_views, raster_settings
    from beags_plugin.plugin.extract import load_scene
    from beags_plugin.rasterizers import make_rasterizer
    from beags_plugin.rasterizers.drawing import surfel_inputs

    refined = load_scene(config_path)
    base = load_scene(config_path.parent / "base" / "config.yml")
    views = held_out_views(refined.config, refined.classes)
    settings = raster_settings(refined)
    rasterizer = make_rasterizer(refined.config.model_config.rasterizer)

    def similarity(surfels, views: Sequence[EvalView], rasterizer: Rasterizer, settings: RasterSettings) -> float:
        black, values = torch.zeros(3), []
        with torch.no_grad():
            for view in views:
                if view.image is not None:
                    inputs = surfel_inputs(surfels, view.camera)
                    color = rasterizer.rasterize(inputs, view.camera, settings, black).color
                    values.append(float(ssim(color.clamp(0, 1), view.image)))
        return math.fsum(values) / len(values)

    def figures(surfels) -> dict[str, Any]:
        metrics = evaluate_scene(surfels, refined.state["class_ids"], rasterizer, settings, views, refined.classes)
        return {**_plain(metrics, refined.classes), "ssim": similarity(surfels, views, rasterizer, settings)}

    return {
        "before": figures(base.surfels()),
        "after": figures(refined.surfels()),
        "gaussians": len(refined.state["class_ids"]),
    }


def _plain(metrics: SceneMetrics, classes: dict[int, str]) -> dict[str, Any]:
    psnr = metrics.psnr
    return {
        "psnr": psnr if psnr is not None and math.isfinite(psnr) else None,
        **_masks(metrics.mean),
        "objects": {classes[class_id]: _masks(found) for class_id, found in metrics.objects.items()},
    }


def _masks(metrics: ObjectMetrics) -> dict[str, Any]:
    kinds = {"extracted": metrics.extracted, "rendered": metrics.rendered}
    return {
        kind: None if found is None else {"acc": found.acc, "iou": found.iou, "biou": found.biou}
        for kind, found in kinds.items()
    }
