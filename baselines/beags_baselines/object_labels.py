"""Fixed object ids of Gaussians for ObjectGS (Zhu et al., ICCV 2025; ``object_entropy``), by three rules.

"e6", the default, is this package's assignment: phi_i = argmax_c W[i, c]. "nonzero" is the argmax over the objects
alone, like the source's vote that drops the background: one stray object vote of twenty makes an object; for study.
"majority" projects centres into all views, without a test of what hides them, and takes the commonest id there.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import pixels_under
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE

LABELS = ("e6", "majority", "nonzero")  # the first is the default


def labels_by_weight(keys: Tensor, sums: Tensor, count: int, num_classes: int, nonzero: bool = False) -> Tensor:
    """Return [count] int32: of each Gaussian the class of most weight; ties to the lower id, 0 where no weight is.

    keys: [M] int64, i * num_classes + c, ascending; sums: [M] float64 above 0, W[i, c] over all views.
    nonzero: leave out the background where an object has any weight.
    """
    if nonzero:
        objects = keys % num_classes != BACKGROUND
        keys, sums = keys[objects], sums[objects]
    return largest_in_rows(keys, sums, count, num_classes)[0].int()


def labels_by_majority(
    points: Tensor, cameras: Sequence[Camera], labels: Sequence[Tensor | None], num_classes: int
) -> Tensor:
    """Return [N] int32: the class under most projections of each point [N, 3]; ties to the lower id, 0 without any.

    labels: per camera [H, W] int class ids or IGNORE, which has no vote; or None.
    """
    votes = TorchSparseSums(points.device)
    for camera, mask in zip(cameras, labels, strict=True):
        if mask is None:
            continue
        seen, row, column = pixels_under(points, camera)
        found = mask[row, column].long()
        keys = (seen * num_classes + found)[found != IGNORE]
        votes.add(keys, torch.ones_like(keys, dtype=torch.float64))
    return labels_by_weight(*votes.totals(), len(points), num_classes)
