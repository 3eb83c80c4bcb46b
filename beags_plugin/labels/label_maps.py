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


def to_compact(labels: Tensor) -> Tensor:
    """Return the map in the narrowest type: uint8 (255: IGNORE) for ids below 255, else uint16, else int32.

    labels: [H, W] int32 or int64 class ids or IGNORE. A uint8 or uint16 map passes as it is. Nothing is lost:
    ``to_int32`` gives every id back.
    """
    if labels.dtype in (torch.uint8, torch.uint16):
        return labels
    for dtype in (torch.uint8, torch.uint16):
        narrow = labels.to(dtype)  # keeps the low bits: IGNORE becomes 255 in uint8
        if torch.equal(to_int32(narrow), labels.int()):
            return narrow
    return labels.int()


def to_int32(labels: Tensor) -> Tensor:
    """Return [H, W] int32 class ids or IGNORE. labels: [H, W], as ``to_compact`` gave them."""
    wide = labels.to(torch.int32)
    return wide.masked_fill_(wide == NARROW_IGNORE, IGNORE) if labels.dtype == torch.uint8 else wide


class CompressedMap:
    """A map [H, W] in the narrowest type and compressed: some kilobytes for the classes of a photo.

    labels: as for ``to_compact``; any uint8 image will do.
    """

    def __init__(self, labels: Tensor) -> None:
        array = to_compact(labels.detach()).cpu().contiguous().numpy()
        self.shape, self.dtype, self.device = array.shape, array.dtype, labels.device
        self.packed = zlib.compress(array.tobytes(), level=1)

    def unpacked(self) -> Tensor:
        """[H, W], as ``to_compact`` gave it, on the device where it was."""
        array = np.frombuffer(bytearray(zlib.decompress(self.packed)), self.dtype)
        return torch.from_numpy(array.reshape(self.shape)).to(self.device)

    @property
    def pixels(self) -> int:
        """How many pixels the map has."""
        return int(np.prod(self.shape))


class CompressedMaps(Sequence[Tensor]):
    """One uint8 image [H, W] per view, held compressed and read one view at a time."""

    def __init__(self, images: Iterable[Tensor] = ()) -> None:
        self.stored = [CompressedMap(image) for image in images]

    def append(self, image: Tensor) -> None:
        """Add the image of one more view."""
        self.stored.append(CompressedMap(image))

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """[H, W] uint8 of one view; of a slice, a list."""
        found = self.stored[index]
        return found.unpacked() if isinstance(found, CompressedMap) else [each.unpacked() for each in found]


class LabelMaps(Sequence[Any]):
    """One label map per view, None where a view has none: held narrow and compressed, read as int32, one at a time.

    maps: [H, W] int32 class ids or IGNORE, or as ``to_compact`` gives them; ``CompressedMap`` are kept as they are.
    """

    def __init__(self, maps: Iterable[Tensor | CompressedMap | None] = ()) -> None:
        self.stored: list[CompressedMap | None] = []
        for labels in maps:
            self.append(labels)

    def append(self, labels: Tensor | CompressedMap | None) -> None:
        """Add the map of one more view."""
        self.stored.append(CompressedMap(labels) if isinstance(labels, Tensor) else labels)

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """[H, W] int32 of one view, or None; of a slice, the maps as they are held."""
        if isinstance(index, slice):
            return LabelMaps(self.stored[index])
        narrow = self.narrow(index)
        return None if narrow is None else to_int32(narrow)

    def narrow(self, index: int) -> Tensor | None:
        """[H, W] of one view, as ``to_compact`` gives it, or None."""
        found = self.stored[index]
        return None if found is None else found.unpacked()

    @property
    def bytes(self) -> int:
        """How much memory the maps take."""
        return sum(len(labels.packed) for labels in self.stored if labels is not None)
