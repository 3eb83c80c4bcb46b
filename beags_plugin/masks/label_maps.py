"""Label maps of many views, each held in the narrowest type that its ids fit in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from beags_plugin.rasterizers.interface import IGNORE

NARROW_IGNORE = 255  # stands for IGNORE in a map of uint8, so that 255 classes fit


def narrowed(labels: Tensor) -> Tensor:
    """The map in the narrowest type: uint8 (255: IGNORE) for ids below 255, else uint16, else int32.

    labels: [H, W] int32 or int64 class ids or IGNORE. A uint8 or uint16 map is taken to be narrowed already. Nothing is
    lost: ``widened`` gives every id back.
    """
    if labels.dtype in (torch.uint8, torch.uint16):
        return labels
    for dtype in (torch.uint8, torch.uint16):
        narrow = labels.to(dtype)  # keeps the low bits: IGNORE becomes 255 in uint8
        if torch.equal(widened(narrow), labels.int()):
            return narrow
    return labels.int()


def widened(labels: Tensor) -> Tensor:
    """[H, W] int32 class ids or IGNORE, as all that computes reads them; labels: [H, W], as ``narrowed`` gave them."""
    wide = labels.to(torch.int32)
    return wide.masked_fill_(wide == NARROW_IGNORE, IGNORE) if labels.dtype == torch.uint8 else wide


class LabelMaps(Sequence[Any]):
    """One label map per view, None where a view has none: a sequence of tensors, read as int32, one view at a time.

    maps: [H, W] int32 class ids or IGNORE, or as ``narrowed`` gives them; they are not copied where they are narrow.
    """

    def __init__(self, maps: Iterable[Tensor | None] = ()) -> None:
        self.stored: list[Tensor | None] = []
        for labels in maps:
            self.append(labels)

    def append(self, labels: Tensor | None) -> None:
        """Add the map of one more view."""
        self.stored.append(None if labels is None else narrowed(labels))

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """[H, W] int32 of one view, or None; of a slice, the maps as they are held."""
        if isinstance(index, slice):
            return LabelMaps(self.stored[index])
        found = self.stored[index]
        return None if found is None else widened(found)

    @property
    def bytes(self) -> int:
        """How much memory the maps take."""
        return sum(labels.numel() * labels.element_size() for labels in self.stored if labels is not None)
