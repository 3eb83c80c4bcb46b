"""Mask metrics (Acc, IoU, BIoU), PSNR, and their means over views and objects (method, section 8)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

BAND_FRACTION = 0.02
"""Width of the boundary band as a fraction of the image diagonal (method, section 8)."""


@dataclass(frozen=True)
class MaskMetrics:
    """Agreement of one predicted mask with its truth; each in 0..1, higher is better.

    acc: pixel accuracy. iou: intersection over union. biou: IoU of the inner boundary bands.
    """

    acc: float
    iou: float
    biou: float


def _array(image: Any) -> np.ndarray:
    """A numpy view of an array, or of a tensor on any device."""
    return image.detach().cpu().numpy() if hasattr(image, "detach") else np.asarray(image)


def band_width(height: int, width: int) -> int:
    """d = max(1, round(0.02 x image diagonal)), in pixels (method, section 8)."""
    return max(1, round(BAND_FRACTION * math.hypot(height, width)))


def erode(mask: np.ndarray, times: int) -> np.ndarray:
    """A 3x3 erosion done ``times`` times; outside the image counts as outside the mask.

    mask: [H, W] bool. Returns [H, W] bool: pixels whose whole (2 times + 1)-square lies in the mask, which is
    the same set; counted with a summed-area table, so the cost does not grow with ``times``.
    """
    size = 2 * times + 1
    height, width = mask.shape
    sums = np.zeros((height + size, width + size), dtype=np.int64)
    sums[1:, 1:] = np.pad(mask.astype(np.int64), times).cumsum(axis=0).cumsum(axis=1)
    inside = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
    return inside == size * size


def boundary_band(mask: np.ndarray, width: int) -> np.ndarray:
    """[H, W] bool: the pixels of ``mask`` [H, W] bool that ``width`` erosions take away."""
    return mask & ~erode(mask, width)


def resize_nearest(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """[H', W'] to [height, width], each new pixel taking the old one under its centre."""
    rows = (2 * np.arange(height) + 1) * mask.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * mask.shape[1] // (2 * width)
    return mask[rows[:, None], columns[None, :]]


def _iou(a: np.ndarray, b: np.ndarray, counted: np.ndarray) -> float:
    union = np.count_nonzero((a | b) & counted)
    return np.count_nonzero(a & b & counted) / union if union else 1.0  # both empty: 1


def mask_metrics(prediction: Any, truth: Any, ignore: Any = None) -> MaskMetrics:
    """Acc, IoU and BIoU of a mask; where a ratio has nothing to count, it is 1.

    prediction: [H', W'] bool array or tensor, resized (nearest) to the truth if the sizes differ.
    truth: [H, W] bool. ignore: [H, W] bool or None; True pixels are left out of every count, and the prediction
    is taken to be right there, so that a hole in an ignored region makes no boundary around it.
    Raises ``ValueError`` for masks that are not two-dimensional or an ``ignore`` of another size than the truth.
    Source: method, section 8.
    """
    predicted, true = _array(prediction).astype(bool), _array(truth).astype(bool)
    if predicted.ndim != 2 or true.ndim != 2 or 0 in predicted.shape or 0 in true.shape:
        raise ValueError(f"masks must be non-empty and [H, W]: got {predicted.shape} and {true.shape}.")
    counted = np.ones_like(true) if ignore is None else ~_array(ignore).astype(bool)
    if counted.shape != true.shape:
        raise ValueError(f"the ignore mask is {counted.shape} but the truth is {true.shape}.")
    if predicted.shape != true.shape:
        predicted = resize_nearest(predicted, *true.shape)
    predicted = np.where(counted, predicted, true)
    total = np.count_nonzero(counted)
    d = band_width(*true.shape)
    return MaskMetrics(
        acc=np.count_nonzero((predicted == true) & counted) / total if total else 1.0,
        iou=_iou(predicted, true, counted),
        biou=_iou(boundary_band(predicted, d), boundary_band(true, d), counted),
    )


def psnr(a: Any, b: Any) -> float:
    """Peak signal-to-noise ratio in dB of two images of one shape with values in 0..1; infinite if they are equal.

    a, b: arrays or tensors, float. Raises ``ValueError`` if the shapes differ.
    """
    first, second = _array(a).astype(np.float64), _array(b).astype(np.float64)
    if first.shape != second.shape:
        raise ValueError(f"images of shapes {first.shape} and {second.shape} cannot be compared.")
    error = float(np.mean((first - second) ** 2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def mean_metrics(metrics: Iterable[MaskMetrics]) -> MaskMetrics:
    """The mean of each metric; raises ``ValueError`` if there are none."""
    rows = [(m.acc, m.iou, m.biou) for m in metrics]
    if not rows:
        raise ValueError("there are no metrics to average.")
    return MaskMetrics(*(math.fsum(column) / len(rows) for column in zip(*rows, strict=True)))
