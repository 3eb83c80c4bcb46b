"""The objects of an export item, for files that hold them one beside the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.export.splat_values import finite_mask
from beags_plugin.splat_io.frames import from_input_frame
from beags_plugin.surfaces.item import ExportItem, NothingToExport


@dataclass(frozen=True)
class SplatPart:
    """One object: its name, its class, N > 0 finite Gaussians, and invented [N] bool, or None as in ``ExportItem``."""

    name: str
    class_id: int
    surfels: Surfels
    invented: Tensor | None


def splat_parts(item: ExportItem) -> list[SplatPart]:
    """Return the finite Gaussians of an item by their classes; raises ``NothingToExport`` if there is none.

    The only class of an item is called as the item is, others as ``class_names`` says.
    """
    parts = list(_parts(item))
    if not parts:
        raise NothingToExport(f"{item.name} has no finite Gaussian, so there is nothing to write.")
    return parts


def _parts(item: ExportItem) -> Iterator[SplatPart]:
    finite = finite_mask(item.surfels)
    present = item.class_ids[finite].unique().tolist()
    for class_id in present:
        chosen = finite & (item.class_ids == class_id)
        name = item.name if len(present) == 1 else item.class_names.get(class_id, f"class {class_id}")
        invented = None if item.invented is None else item.invented[chosen]
        yield SplatPart(name, class_id, item.surfels[chosen].detach(), invented)


def without_invented(item: ExportItem) -> ExportItem:
    """Return an item without the Gaussians that close it, as a mesh of its surface needs it."""
    if item.invented is None:
        return item
    own = ~item.invented
    return replace(item, surfels=item.surfels[own], class_ids=item.class_ids[own], invented=None)


def y_up_surfels(surfels: Surfels) -> Surfels:
    """Return surfels of a frame with z up in one with y up; z of ours is its y, and y its -z."""
    quarter = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    return from_input_frame(surfels, torch.tensor(quarter, dtype=torch.float64), 1.0)


def thin_log_scales(surfels: Surfels, thickness: float) -> Tensor:
    """Return [N, 3] logs of scales, the third ``thickness`` times the smaller of the two."""
    log_scales = surfels.log_scales.detach().double()
    third = log_scales.amin(dim=1, keepdim=True) + torch.log(torch.tensor(thickness, dtype=torch.float64))
    return torch.cat([log_scales, third], dim=1)
