"""The object loss of ObjectGS: cross-entropy of blended one-hot ids against the mask.

Zhu, Yu, Xu, Jiang, Li, Zhang, Pang, Dai: "ObjectGS: Object-aware Scene Reconstruction and Scene Understanding via
Gaussian Splatting", ICCV 2025. With p(u) = sum_i w_i onehot(phi_i), without background:

    L = mean over counted pixels of -p_M(u) + log sum_c exp(p_c)

p itself is the logit and no probability (its sum is alpha, at most 1). L is never 0, so that right pixels are always
pulled towards alpha = 1. The sum includes all K channels, also of classes that the view does not show.
"""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.losses.reduction import ordered_sum

WEIGHT = 0.1  # weight of L; the releases for single data sets have 0.1, 0.01 and 0.001
SCALE_WEIGHT = 0.01  # weight of ``mean_area``
IGNORE_BACKGROUND = False


def counted_labels(
    labels: Tensor, carried: Tensor | None = None, ignore_background: bool = IGNORE_BACKGROUND
) -> Tensor:
    """Return the labels [H, W] int of a view with IGNORE at pixels that do not count.

    carried: [K] bool, classes of which there are Gaussians; pixels of others do not count.
    ignore_background: leave out 0, which is an object otherwise; the source leaves out its 0, "unlabelled".
    """
    left_out = labels == BACKGROUND if ignore_background else torch.zeros_like(labels, dtype=torch.bool)
    if carried is not None:
        left_out = left_out | ((labels != IGNORE) & ~carried[labels.clamp(max=len(carried) - 1).long()])
    return labels.masked_fill(left_out, IGNORE)


def label_entropy(logits: Tensor, labels: Tensor | None) -> Tensor:
    """Return the mean cross-entropy over labelled pixels; 0, without gradient, if there are none.

    logits: [H, W, K] float. labels: [H, W] int below K, or IGNORE; None for a view without mask.
    """
    if labels is None:
        return logits.new_zeros(())
    flat = labels.reshape(-1).long()
    each = torch.nn.functional.cross_entropy(logits.flatten(0, 1), flat, ignore_index=IGNORE, reduction="none")
    return ordered_sum(each) / (flat != IGNORE).sum().clamp(min=1)


def mean_area(log_scales: Tensor, visible: Tensor) -> Tensor:
    """Return the mean product of both scales of the visible Gaussians; 0 if there are none.

    log_scales: [N, 2]; the value is in squared units of the run's frame. visible: [N] bool.
    """
    areas = torch.where(visible, log_scales.sum(dim=-1), -torch.inf).exp()
    return ordered_sum(areas) / visible.sum().clamp(min=1)
