"""The objects of an export item, for files that hold several objects."""

from __future__ import annotations

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
    """Return the finite Gaussians of an item by class; raises ``NothingToExport`` if there is none.

    The only class of an item has the item's name, others have those of ``class_names``.
    """
    finite = finite_mask(item.surfels)
    present = item.class_ids[finite].unique().tolist()
    if not present:
        raise NothingToExport(f"{item.name} has no finite Gaussian, so there is nothing to write.")
    parts = []
    for class_id in present:
        chosen = finite & (item.class_ids == class_id)
        name = item.name if len(present) == 1 else item.class_names.get(class_id, f"class {class_id}")
        invented = None if item.invented is None else item.invented[chosen]
        parts.append(SplatPart(name, class_id, item.surfels[chosen].detach(), invented))
    return parts


def without_invented(item: ExportItem) -> ExportItem:
    """Return an item without the Gaussians that close it, for a mesh of its surface."""
    if item.invented is None:
        return item
    own = ~item.invented
    return replace(item, surfels=item.surfels[own], class_ids=item.class_ids[own], invented=None)


def y_up_gaussians(surfels: Surfels) -> Surfels:
    """Return Gaussians of a frame with z up in one with y up: z becomes y, and y becomes -z."""
    quarter = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    return from_input_frame(surfels, torch.tensor(quarter, dtype=torch.float64), 1.0)
