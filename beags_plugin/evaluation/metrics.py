"""Metrics of masks (Acc, IoU, BIoU), PSNR, and their means over views and objects (method, section 8)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np

from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.labels.class_ids import resize_nearest

AGREEMENT = ("acc", "iou", "biou")
METRICS = (*AGREEMENT, "spill")


@dataclass(frozen=True)
class MaskMetrics:
    """Agreement of a predicted mask with its truth, or a mean over masks.

    acc: pixel accuracy. iou: intersection over union. biou: IoU of the inner boundary bands. Each is in 0..1, higher is
    better. spill: see ``spill``; 0 or more, lower is better. covered: see ``covered``, of the whole scene; 0..1, lower
    is better. None: nothing to compare, for example two empty masks; means leave it out.
    """

    acc: float | None
    iou: float | None
    biou: float | None
    spill: float | None = None
    covered: float | None = None


@dataclass(frozen=True)
class CloseUpMetrics:
    """Scores of an object within its box at the resolution of the photo's file, or a mean; see ``close_up``.

    psnr (dB), ssim (at most 1): the whole scene over the visible object. iou, biou, spill: the object rendered alone,
    as in ``MaskMetrics``. None as there.
    """

    psnr: float | None
    ssim: float | None
    iou: float | None
    biou: float | None
    spill: float | None


def _array(image: Any) -> np.ndarray:
    """Return an array, or a tensor on any device, as a numpy array."""
    return image.detach().cpu().numpy() if hasattr(image, "detach") else np.asarray(image)


def band_width(height: int, width: int, share: float = Protocol.band_share) -> int:
    """Return d = max(1, round(share x image diagonal)), in pixels (method, section 8)."""
    return max(1, round(share * math.hypot(height, width)))


def boundary_band(mask: np.ndarray, width: int) -> np.ndarray:
    """Return the pixels of ``mask`` [H, W] bool that ``width`` 3 x 3 erosions remove; the mask ends at the image."""
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=width, borderValue=(0,))
    return mask & (eroded == 0)


def compared_masks(prediction: Any, truth: Any, ignore: Any = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return prediction and truth at the truth's size and the pixels that count: three bool arrays [H, W].

    prediction: [H', W'] bool array or tensor. truth: [H, W] bool. ignore: [H, W] bool or None. Where a pixel does not
    count, the prediction is set to the truth, so that ignored regions make no boundary. Raises ``ValueError`` as
    ``mask_metrics`` does.
    """
    predicted, true = _array(prediction).astype(bool), _array(truth).astype(bool)
    if predicted.ndim != 2 or true.ndim != 2 or 0 in predicted.shape or 0 in true.shape:
        raise ValueError(f"masks must be non-empty and [H, W]: got {predicted.shape} and {true.shape}.")
    counted = np.ones_like(true) if ignore is None else ~_array(ignore).astype(bool)
    if counted.shape != true.shape:
        raise ValueError(f"the ignore mask is {counted.shape} but the truth is {true.shape}.")
    if predicted.shape != true.shape:
        predicted = resize_nearest(predicted, *true.shape)
    return np.where(counted, predicted, true), true, counted


def mask_metrics(
    prediction: Any, truth: Any, ignore: Any = None, protocol: Protocol | None = None, band: int | None = None
) -> MaskMetrics:
    """Return Acc, IoU, BIoU and spill of a mask (method, section 8).

    prediction: [H', W'] bool array or tensor. truth: [H, W] bool. ignore: [H, W] bool or None; True pixels count
    nowhere. band: width of the boundary band, pixels; the protocol's share of the masks' diagonal if None. If truth and
    prediction are empty, all metrics are None. Raises ``ValueError`` for masks that are
    not two-dimensional and for an ``ignore`` of another size than the truth.
    """
    protocol = protocol or Protocol()
    predicted, true, counted = compared_masks(prediction, truth, ignore)

    def iou(a: np.ndarray, b: np.ndarray) -> float | None:
        union = np.count_nonzero((a | b) & counted)
        return np.count_nonzero(a & b & counted) / union if union else None

    if not ((predicted | true) & counted).any():
        return MaskMetrics(None, None, None, None)
    d = band_width(true.shape[0], true.shape[1], protocol.band_share) if band is None else band
    return MaskMetrics(
        acc=np.count_nonzero((predicted == true) & counted) / np.count_nonzero(counted),
        iou=iou(predicted, true),
        biou=iou(boundary_band(predicted, d), boundary_band(true, d)),
        spill=spill(predicted, true, counted, d),
    )


def spill(predicted: np.ndarray, true: np.ndarray, counted: np.ndarray, margin: float) -> float | None:
    """Return the area of a mask far outside of the truth, as a share of the truth's area; None if the truth is empty.

    predicted, true, counted: [H, W] bool, as ``compared_masks`` returns them. margin: pixels; pixels up to this far
    from a pixel of ``true``, centre to centre, are no spill. Only counted pixels enter both areas.
    """
    area = np.count_nonzero(true & counted)
    if area == 0:
        return None
    distance = cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Squared distances between pixels are whole numbers; rint undoes OpenCV's rounding of the root.
    squared = np.rint(np.square(distance, dtype=np.float64))
    return np.count_nonzero(predicted & counted & (squared > margin**2)) / area


def covered(prediction: Any, truth: Any, ignore: Any = None) -> float | None:
    """Return the share of the truth's pixels that a mask lacks, for example because fog covers an object.

    None if no pixel of the truth counts. Arguments and errors are those of ``mask_metrics``.
    """
    predicted, true, counted = compared_masks(prediction, truth, ignore)
    area = np.count_nonzero(true & counted)
    return np.count_nonzero(true & counted & ~predicted) / area if area else None


def psnr(a: Any, b: Any) -> float:
    """Return the peak signal-to-noise ratio of two images in dB; infinite if they are equal.

    a, b: float arrays or tensors of one shape, values in 0..1. Raises ``ValueError`` if the shapes differ.
    """
    first, second = _array(a).astype(np.float64), _array(b).astype(np.float64)
    if first.shape != second.shape:
        raise ValueError(f"images of shapes {first.shape} and {second.shape} cannot be compared.")
    error = float(np.mean((first - second) ** 2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None; None without any."""
    present = [value for value in values if value is not None]
    return math.fsum(present) / len(present) if present else None


def mean_metrics(metrics: Iterable[Any]) -> Any:
    """Return the mean of each metric over the rows that have it, in the type of the rows; None without rows.

    metrics: rows of one of the types above; None is left out.
    """
    rows = [row for row in metrics if row is not None]
    if not rows:
        return None
    return type(rows[0])(*(mean(getattr(row, field.name) for row in rows) for field in fields(rows[0])))
