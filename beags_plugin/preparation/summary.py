"""Lines of text about the results of the stages of a preparation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.assignment.assignment import Assignment


def reprojection_summary(before: Sequence[Tensor | None], after: Sequence[Tensor]) -> str:
    """Describe the pixels that reprojection changed."""
    changed = pixels = filled = 0
    for old, new in zip(before, after, strict=True):  # held compressed: one view at a time
        if old is None:
            filled += 1
        else:
            changed, pixels = changed + int((old != new).sum()), pixels + old.numel()
    return (
        f"reprojection: {changed} of {pixels} labelled pixels changed ({100 * changed / max(pixels, 1):.2f} %), "
        f"{filled} views without a mask got one"
    )


def assignment_summary(assignment: Assignment, class_names: dict[int, str]) -> str:
    """Describe the number of Gaussians of each class."""
    counts = torch.bincount(assignment.class_ids.long(), minlength=max(class_names) + 1)
    per_class = ", ".join(f"{name} {int(counts[index])}" for index, name in sorted(class_names.items()))
    return f"assignment: Gaussians per class: {per_class}; never seen: {int(assignment.never_seen.sum())}"
