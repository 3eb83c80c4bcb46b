"""Extraction: an object is its Gaussians, every parameter untouched (method, section 8)."""

from __future__ import annotations

from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels


def select_class(surfels: Surfels, members: Membership, class_id: int) -> tuple[Surfels, Tensor]:
    """Return the Gaussians of one class: all their parameters.

    surfels: N surfels. members: of them.
    Returns (M surfels, [M] int64 their indices among the N, ascending). Raises ``ValueError`` on a wrong length.
    """
    return _select(surfels, members, members.of(class_id))


def remove_class(surfels: Surfels, members: Membership, class_id: int) -> tuple[Surfels, Tensor]:
    """Return the scene without one class: the complement of ``select_class``, with its arguments and returns."""
    return _select(surfels, members, ~members.of(class_id))


def _select(surfels: Surfels, members: Membership, keep: Tensor) -> tuple[Surfels, Tensor]:
    if len(members) != len(surfels):
        raise ValueError(f"the classes must be of {len(surfels)} Gaussians, not of {len(members)}")
    index = keep.nonzero().squeeze(1)
    return surfels[index], index
