"""How well a labelled scene cuts out its objects: extracted and rendered masks, and PSNR (method, section 8)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import MaskMetrics, mask_metrics, mean_metrics, psnr
from beags_plugin.extraction.select import select_class
from beags_plugin.rasterizers.drawing import geometry_inputs, surfel_inputs
from beags_plugin.rasterizers.interface import IGNORE, Rasterizer, RasterSettings

MASK_THRESHOLD = 0.5
"""A pixel belongs to a mask where the alpha (extracted) or the value (rendered) is greater."""


@dataclass(frozen=True)
class EvalView:
    """One held-out view and what is known of it.

    camera: of the view. name: for tables and pictures.
    image: [H, W, 3] float in 0..1, the photograph, or None.
    visible: [h, w] integer class ids of what is seen, or IGNORE; None if there are no masks. May differ in size from
        the camera: predictions are resized to it.
    silhouettes: object id to [h, w] bool, what the object covers when nothing stands before it; None if unknown.
    seen: object id to [h, w] bool, the part of the silhouette whose surface some training photo shows; the rest
        cannot be known and is left out of the extracted metrics. None counts whole silhouettes.
    """

    camera: Camera
    image: Tensor | None
    visible: Tensor | None = None
    silhouettes: Mapping[int, Tensor] | None = None
    name: str = ""
    seen: Mapping[int, Tensor] | None = None


@dataclass(frozen=True)
class ObjectMetrics:
    """The two kinds of mask metrics; None where there was no mask to compare with."""

    extracted: MaskMetrics | None
    rendered: MaskMetrics | None


@dataclass(frozen=True)
class SceneMetrics:
    """A scene's figures over all its views.

    mean: over all the masks of the scene. objects: object id to the mean over its masks.
    psnr: dB, mean over the views with a photograph; None if there is none; infinite for equal images.
    extracted_truth: what extracted masks were compared with: "silhouette" (occlusion-free), "visible" (the visible
        masks, without the pixels that other objects cover: what is behind them is unknown), "both", or None.
    """

    mean: ObjectMetrics
    objects: dict[int, ObjectMetrics]
    psnr: float | None
    extracted_truth: str | None


def evaluate_scene(
    surfels: Surfels,
    class_ids: Tensor,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    views: Sequence[EvalView],
    classes: Mapping[int, str],
    *,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SceneMetrics:
    """Extracted and rendered Acc, IoU and BIoU of each object, and PSNR.

    surfels: N surfels. class_ids: [N] int32, phi. classes: id to name; 0, the background, is not scored.
    background: [3] behind the images for PSNR; black if None. sh_degree: of the colours; all if None.
    Every mask counts, empty ones too (both empty: 1). No gradients. Source: method, section 8.
    """
    surfels = surfels.detach()
    objects = sorted(class_id for class_id in classes if class_id != 0)
    drawing = replace(settings, geometry=False, distortion=False)
    parts = {class_id: select_class(surfels, class_ids, class_id)[0] for class_id in objects}
    if background is None:
        background = surfels.means.new_zeros(3)
    extracted: dict[int, list[MaskMetrics]] = {class_id: [] for class_id in objects}
    rendered: dict[int, list[MaskMetrics]] = {class_id: [] for class_id in objects}
    truths: set[str] = set()
    ratios: list[float] = []
    with torch.no_grad():
        for done, view in enumerate(views):
            for class_id in objects:
                if (truth := extracted_truth(view, class_id)) is not None:
                    kind, mask, ignore = truth
                    truths.add(kind)
                    prediction = extracted_mask(parts[class_id], view.camera, rasterizer, drawing)
                    extracted[class_id].append(mask_metrics(prediction, mask, ignore))
            if view.visible is not None:
                predictions = rendered_masks(surfels, class_ids, objects, view.camera, rasterizer, drawing)
                for class_id, prediction in predictions.items():
                    metrics = mask_metrics(prediction, view.visible == class_id, view.visible == IGNORE)
                    rendered[class_id].append(metrics)
            if view.image is not None:
                inputs = surfel_inputs(surfels, view.camera, sh_degree)
                color = rasterizer.rasterize(inputs, view.camera, drawing, background).color
                ratios.append(psnr(color.clamp(0, 1), view.image))
            if progress is not None:
                progress(done + 1, len(views))
    return SceneMetrics(
        mean=ObjectMetrics(
            _mean([m for rows in extracted.values() for m in rows]),
            _mean([m for rows in rendered.values() for m in rows]),
        ),
        objects={c: ObjectMetrics(_mean(extracted[c]), _mean(rendered[c])) for c in objects},
        psnr=math.fsum(ratios) / len(ratios) if ratios else None,
        extracted_truth="both" if len(truths) == 2 else next(iter(truths), None),
    )


def _mean(metrics: list[MaskMetrics]) -> MaskMetrics | None:
    return mean_metrics(metrics) if metrics else None


def extracted_truth(view: EvalView, class_id: int) -> tuple[str, Tensor, Tensor | None] | None:
    """What an extracted object is compared with in a view.

    Returns (kind, mask [h, w] bool, pixels to leave out [h, w] bool or None), or None if the view has no mask of it.
    kind: "silhouette", or "visible", where pixels of other objects and IGNORE pixels are left out.
    """
    if view.silhouettes is not None and class_id in view.silhouettes:
        silhouette = view.silhouettes[class_id]
        known = None if view.seen is None else view.seen.get(class_id)
        return "silhouette", silhouette, None if known is None else silhouette & ~known
    if view.visible is None:
        return None
    return "visible", view.visible == class_id, (view.visible != class_id) & (view.visible != 0)


def extracted_mask(part: Surfels, camera: Camera, rasterizer: Rasterizer, settings: RasterSettings) -> Tensor:
    """[H, W] bool: A > 0.5 where only the object's surfels are drawn."""
    if len(part) == 0:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    black = part.means.new_zeros(3)
    return rasterizer.rasterize(geometry_inputs(part), camera, settings, black).alpha > MASK_THRESHOLD


def rendered_masks(
    surfels: Surfels,
    class_ids: Tensor,
    objects: Sequence[int],
    camera: Camera,
    rasterizer: Rasterizer,
    settings: RasterSettings,
) -> dict[int, Tensor]:
    """Object id to [H, W] bool: value > 0.5 of the whole scene with the object 1 and the rest 0, on black.

    Three objects share one drawing, one in each colour channel.
    """
    inputs = geometry_inputs(surfels)
    black = surfels.means.new_zeros(3)
    masks: dict[int, Tensor] = {}
    for first in range(0, len(objects), 3):
        triple = objects[first : first + 3]
        colors = torch.zeros_like(inputs.colors)
        for channel, class_id in enumerate(triple):
            colors[:, channel] = (class_ids == class_id).to(colors.dtype)
        value = rasterizer.rasterize(replace(inputs, colors=colors), camera, settings, black).color
        masks |= {class_id: value[..., channel] > MASK_THRESHOLD for channel, class_id in enumerate(triple)}
    return masks
