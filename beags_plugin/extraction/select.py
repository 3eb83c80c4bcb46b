"""Extraction: an object is its Gaussians, every parameter untouched (method, section 8)."""

from __future__ import annotations

from torch import Tensor

from beags_plugin.core.surfels import Surfels


def select_class(surfels: Surfels, class_ids: Tensor, class_id: int) -> tuple[Surfels, Tensor]:
    """Return the Gaussians of one class: all parameters with phi_i = class_id.

    surfels: N surfels. class_ids: [N] integer, phi.
    Returns (M surfels, [M] int64 their indices among the N, ascending). Raises ``ValueError`` on a wrong length.
    """
    return _select(surfels, class_ids, class_ids == class_id)


def remove_class(surfels: Surfels, class_ids: Tensor, class_id: int) -> tuple[Surfels, Tensor]:
    """Return the scene without one class: the complement of ``select_class``, with its arguments and returns."""
    return _select(surfels, class_ids, class_ids != class_id)


def _select(surfels: Surfels, class_ids: Tensor, keep: Tensor) -> tuple[Surfels, Tensor]:
    if class_ids.shape != (len(surfels),):
        raise ValueError(f"class_ids must be [{len(surfels)}], not {list(class_ids.shape)}")
    index = keep.nonzero().squeeze(1)
    return surfels[index], index
