"""Label maps of many views, each in the narrowest type of its ids, and compressed."""

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
    """Return labels [H, W] of class ids or IGNORE in the narrowest type; ``to_int32`` restores every id.

    The type is uint8 (255: IGNORE) for ids below 255, else uint16, else int32. uint8 and uint16 pass unchanged.
    """
    if labels.dtype in (torch.uint8, torch.uint16):
        return labels
    for dtype in (torch.uint8, torch.uint16):
        narrow = labels.to(dtype)  # keeps the low bits: IGNORE becomes 255 in uint8
        if torch.equal(to_int32(narrow), labels.int()):
            return narrow
    return labels.int()


def to_int32(labels: Tensor) -> Tensor:
    """Return [H, W] int32 class ids or IGNORE from labels of ``to_compact``."""
    wide = labels.to(torch.int32)
    return wide.masked_fill_(wide == NARROW_IGNORE, IGNORE) if labels.dtype == torch.uint8 else wide


class CompressedMap:
    """Labels [H, W], or any uint8 image, narrow and compressed: kilobytes for a photo's classes."""

    def __init__(self, labels: Tensor) -> None:
        array = to_compact(labels.detach()).cpu().contiguous().numpy()
        self.shape, self.dtype, self.device = array.shape, array.dtype, labels.device
        self.packed = zlib.compress(array.tobytes(), level=1)

    def unpacked(self) -> Tensor:
        """Return the map [H, W] in the type of ``to_compact``, on its former device."""
        array = np.frombuffer(bytearray(zlib.decompress(self.packed)), self.dtype)
        return torch.from_numpy(array.reshape(self.shape)).to(self.device)


class CompressedMaps(Sequence[Tensor]):
    """One uint8 image [H, W] per view, held compressed."""

    def __init__(self, images: Iterable[Tensor] = ()) -> None:
        self.stored = [CompressedMap(image) for image in images]

    def append(self, image: Tensor) -> None:
        """Add the image of one more view."""
        self.stored.append(CompressedMap(image))

    def __len__(self) -> int:
        return len(self.stored)

    def __getitem__(self, index: int | slice) -> Any:
        """Return [H, W] uint8 of one view, or a list for a slice."""
        stored = self.stored[index]
        return stored.unpacked() if isinstance(stored, CompressedMap) else [each.unpacked() for each in stored]


class LabelMaps(Sequence[Any]):
    """One label map [H, W], or None, per view: stored narrow and compressed, read as int32.

    maps: class ids or IGNORE, int32 or of ``to_compact``; a ``CompressedMap`` is stored as it is.
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
        """Return [H, W] int32 or None of one view; for a slice, ``LabelMaps`` of the same stored maps."""
        if isinstance(index, slice):
            return LabelMaps(self.stored[index])
        narrow = self.narrow(index)
        return None if narrow is None else to_int32(narrow)

    def narrow(self, index: int) -> Tensor | None:
        """Return the map [H, W] of one view in its narrow type, or None."""
        stored = self.stored[index]
        return None if stored is None else stored.unpacked()
