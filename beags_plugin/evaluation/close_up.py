"""Scores of an object within its box at the resolution of the photo's file (our extension)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.evaluation.metrics import CloseUpMetrics, MaskMetrics, band_width, psnr
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.truths import extracted_truth, rendered_truth, resized
from beags_plugin.labels.borders import at_border
from beags_plugin.losses.photometric import WINDOW, ssim_map

MARGIN = 0.5
"""Margin around the object's box, as a share of its longer side; spill farther off is not in the close-up."""
STRIP = 256  # rows whose SSIM is computed at once


def close_up(view: EvalView, class_id: int) -> EvalView | None:
    """Return the part of a view around an object at the resolution of the photo's file, with the masks of that part.

    None if the photo's file is not larger than the training image, without a mask, or without the object in the photo.
    """
    truth = extracted_truth(view, class_id)
    if view.full is None or truth is None or not truth.mask.any():
        return None
    width, height = view.full.camera.width, view.full.camera.height
    left, top, right, bottom = _box(resized(truth.mask, height, width))

    def part(mask: Tensor) -> Tensor:
        return resized(mask, height, width)[top:bottom, left:right]

    def parts(masks: Mapping[int, Tensor] | None) -> Mapping[int, Tensor] | None:
        return None if masks is None else {index: part(mask) for index, mask in masks.items()}

    camera, photo = view.full.region((left, top, right, bottom))
    return EvalView(
        camera,
        photo,
        None if view.visible is None else part(view.visible),
        parts(view.silhouettes),
        view.name,
        visible_objects=parts(view.visible_objects),
        unknown_silhouettes=parts(view.unknown_silhouettes),
        unknown_visible=parts(view.unknown_visible),
    )


def band_of(view: EvalView, share: float) -> int:
    """Return the width of the boundary band of a view's masks at the resolution of its photo's file, pixels."""
    assert view.full is not None
    return band_width(view.full.camera.height, view.full.camera.width, share)


def close_up_metrics(part: EvalView, class_id: int, color: Tensor, agreement: MaskMetrics) -> CloseUpMetrics:
    """Return PSNR and SSIM inside the visible object, together with the agreement of its extracted mask.

    part: a result of ``close_up``. color: [h, w, 3] float in 0..1, the whole scene rendered. Pixels at the border of
    the object do not count.
    """
    metrics = CloseUpMetrics(None, None, agreement.iou, agreement.biou, agreement.spill)
    visible = rendered_truth(part, class_id)
    if visible is None or part.image is None:
        return metrics
    inside = visible.mask & ~at_border(visible.mask.int())
    if not inside.any():
        return metrics
    photo, inside = part.image.to(color), inside.to(color.device)
    similar = float(_similarity(color, photo, inside).mean())
    return replace(metrics, psnr=psnr(color[inside], photo[inside]), ssim=similar)


def _similarity(color: Tensor, photo: Tensor, inside: Tensor) -> Tensor:
    """Return the SSIM at the pixels ``inside`` [h, w] bool, in strips: whole, 12 megapixels take 4 GB."""
    parts = []
    for top in range(0, len(inside), STRIP):
        first, rows = max(top - WINDOW // 2, 0), inside[top : top + STRIP]
        part = slice(first, top + STRIP + WINDOW // 2)
        parts.append(ssim_map(color[part], photo[part])[top - first :][: len(rows)][rows])
    return torch.cat(parts)


def _box(mask: Tensor) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of a mask's box [H, W] with its margin, cut off at the image."""
    rows, columns = (np.flatnonzero(mask.cpu().numpy().any(axis=axis)) for axis in (1, 0))
    (top, bottom), (left, right) = (rows[0], rows[-1] + 1), (columns[0], columns[-1] + 1)
    margin = math.ceil(MARGIN * max(bottom - top, right - left))
    height, width = mask.shape
    return max(left - margin, 0), max(top - margin, 0), min(right + margin, width), min(bottom + margin, height)
