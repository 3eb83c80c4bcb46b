"""Label maps of many views, each in the narrowest type that its ids fit in, and compressed."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE

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


class PackedMap:
    """A map [H, W] in the narrowest type and compressed: some kilobytes for the classes of a photo.

    labels: as for ``narrowed``; any uint8 image will do.
    """

    def __init__(self, labels: Tensor) -> None:
        array = narrowed(labels.detach()).cpu().contiguous().numpy()
        self.shape, self.dtype, self.device = array.shape, array.dtype, labels.device
        self.packed = zlib.compress(array.tobytes(), level=1)

    def unpacked(self) -> Tensor:
        """[H, W], as ``narrowed`` gave it, on the device where it was."""
        array = np.frombuffer(bytearray(zlib.decompress(self.packed)), self.dtype)
        return torch.from_numpy(array.reshape(self.shape)).to(self.device)

    @property
    def pixels(self) -> int:
        """How many pixels the map has."""
        return int(np.prod(self.shape))


class PackedMaps(Sequence[Tensor]):
    """One uint8 image [H, W] per view, held compressed and read one view at a time."""

    def __init__(self, images: Iterable[Tensor] = ()) -> None:
        self.stored = [PackedMap(image) for image in images]

    def append(self, image: Tensor) -> None:
        """Add the image of one more view."""
        self.stored.append(PackedMap(image))

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """[H, W] uint8 of one view; of a slice, a list."""
        found = self.stored[index]
        return found.unpacked() if isinstance(found, PackedMap) else [each.unpacked() for each in found]


class LabelMaps(Sequence[Any]):
    """One label map per view, None where a view has none: held narrow and compressed, read as int32, one at a time.

    maps: [H, W] int32 class ids or IGNORE, or as ``narrowed`` gives them; ``PackedMap`` are kept as they are.
    """

    def __init__(self, maps: Iterable[Tensor | PackedMap | None] = ()) -> None:
        self.stored: list[PackedMap | None] = []
        for labels in maps:
            self.append(labels)

    def append(self, labels: Tensor | PackedMap | None) -> None:
        """Add the map of one more view."""
        self.stored.append(PackedMap(labels) if isinstance(labels, Tensor) else labels)

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """[H, W] int32 of one view, or None; of a slice, the maps as they are held."""
        if isinstance(index, slice):
            return LabelMaps(self.stored[index])
        narrow = self.narrow(index)
        return None if narrow is None else widened(narrow)

    def narrow(self, index: int) -> Tensor | None:
        """[H, W] of one view, as ``narrowed`` gives it, or None."""
        found = self.stored[index]
        return None if found is None else found.unpacked()

    @property
    def bytes(self) -> int:
        """How much memory the maps take."""
        return sum(len(labels.packed) for labels in self.stored if labels is not None)
