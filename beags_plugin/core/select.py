"""Select the Gaussians of an object, or all others, with every parameter untouched (method, section 8)."""

from __future__ import annotations

from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels


def select_class(surfels: Surfels, members: Membership, class_id: int) -> tuple[Surfels, Tensor]:
    """Return the Gaussians of one class, with all their parameters.

    surfels: N Gaussians. members: their classes. Returns the M Gaussians of the class and their indices among the N,
    [M] int64, ascending. Raises ``ValueError`` if ``members`` describes another number of Gaussians.
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
