"""Tables of ``native/ops/voxel_table.h``, built on the device of the voxels: on a GPU without a detour by the CPU."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension

_BITS, _SHIFT = 21, 8  # bits of an axis in a voxel's key; kVoxelShift - kVoxelHalf of voxel_table.h
_MOST_DENSE, _DENSE_PER_BRICK = 1 << 16, 16  # the limits of voxel_lookup.cpp
_MOST_CELLS = 1 << 62
# Bit 16 x + 4 y + z of a brick is its voxel (x, y, z). Per axis: the shift that is one step along it, and the voxels
# whose coordinate along it is 0.
_STEPS = (16, 4, 1)
_FIRST = (0xFFFF, 0x000F000F000F000F, 0x1111111111111111)


def tables(module: ModuleType, keys: Tensor, ranks: Tensor, classes: int) -> tuple[list[Any], list[Any]] | None:
    """Make tables of occupied voxels and of the corners of cubes of 1, 2 and 3 valid voxels; return their memory too.

    The sets are those of ``VoxelLookup`` in ``native/``, bit for bit. Returns None where the box of the voxels is too
    large for its bricks to be numbered in 63 bits.

    module: CUDA's. keys: [M] int64, different for each class; ranks: [M] int32 in 0 .. classes - 1.
    """
    occupied = _occupied(keys, ranks, classes)
    if occupied is None:
        return None
    sets = [occupied, _each_axis(occupied, _spread)]
    for _ in range(2):
        sets.append(_each_axis(sets[-1], _corners))
    made, memory = [], []
    for bricks in sets:
        base, size, dense = _dense(bricks)
        parts = [dense, None, None] if dense is not None else [None, *_hashed(module, bricks)]
        memory.append(parts)
        flat = [None if part is None else part.view(torch.uint8).reshape(-1) for part in parts]
        made.append(module.VoxelTable(classes, base, size, *flat))
    return made, memory


@dataclass(frozen=True)
class _Bricks:
    """Bricks with a voxel, of all classes, sorted by their number ((rank X + x) Y + y) Z + z within a box.

    numbers, bits: [B] int64. base: the box's first brick; size: X, Y, Z. Two empty bricks at either end of each axis
    give numbers to all neighbours.
    """

    numbers: Tensor
    bits: Tensor
    classes: int
    base: tuple[int, ...]
    size: tuple[int, ...]

    def stride(self, axis: int) -> int:
        return (self.size[1] * self.size[2], self.size[2], 1)[axis]

    def ranks(self) -> Tensor:
        return torch.div(self.numbers, self.size[0] * self.stride(0), rounding_mode="floor")

    def places(self) -> Tensor:
        """Return [B, 3] coordinates, as keys hold them."""
        along = [torch.div(self.numbers, self.stride(a), rounding_mode="floor") % self.size[a] for a in range(3)]
        return torch.stack(along, dim=1) + torch.tensor(self.base, device=self.numbers.device)


def _occupied(keys: Tensor, ranks: Tensor, classes: int) -> _Bricks | None:
    mask = (1 << _BITS) - 1
    voxels = torch.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], dim=1) + _SHIFT
    places, within = voxels >> 2, voxels & 3
    low, high = ([0] * 3, [0] * 3) if len(keys) == 0 else torch.stack([places.amin(0), places.amax(0)]).tolist()
    base, size = tuple(at - 2 for at in low), tuple(b - a + 5 for a, b in zip(low, high, strict=True))
    if classes * size[0] * size[1] * size[2] >= _MOST_CELLS:
        return None
    numbers = ranks.long()
    for axis in range(3):
        numbers = numbers * size[axis] + (places[:, axis] - base[axis])
    numbers, inverse = torch.unique(numbers, return_inverse=True)
    cells = within[:, 0] * 16 + within[:, 1] * 4 + within[:, 2]
    # The voxels of a brick are distinct, so the sum of their bits is their union.
    bits = torch.zeros_like(numbers).index_add_(0, inverse, torch.ones_like(cells) << cells)
    return _Bricks(numbers, bits, classes, base, size)


def _each_axis(bricks: _Bricks, change: Any) -> _Bricks:
    """Apply ``change(bricks, axis)`` along one axis after the other; drop the bricks that become empty."""
    for axis in range(3):
        numbers, bits = change(bricks, axis)
        nonempty = bits != 0
        bricks = _Bricks(numbers[nonempty], bits[nonempty], bricks.classes, bricks.base, bricks.size)
    return bricks


def _spread(bricks: _Bricks, axis: int) -> tuple[Tensor, Tensor]:
    """Return the voxels and the next ones on both sides."""
    step, first, stride = _STEPS[axis], _FIRST[axis], bricks.stride(axis)
    last, bits = _signed(first << 3 * step), bricks.bits
    parts = (  # shifts to the right copy the sign, which the masks then remove
        (bricks.numbers, bits | (bits & ~last) << step | bits >> step & ~last),
        (bricks.numbers - stride, (bits & first) << 3 * step),
        (bricks.numbers + stride, bits >> 3 * step & first),
    )
    numbers, inverse = torch.unique(torch.cat([number for number, _ in parts]), return_inverse=True)
    united = torch.zeros_like(numbers)
    for at, (_, part) in zip(inverse.view(3, -1), parts, strict=True):  # No part holds a number twice.
        united[at] |= part
    return numbers, united


def _corners(bricks: _Bricks, axis: int) -> tuple[Tensor, Tensor]:
    """Return the voxels whose next one along the axis is in the set too."""
    step, first = _STEPS[axis], _FIRST[axis]
    last, bits = _signed(first << 3 * step), bricks.bits
    if len(bits) == 0:
        return bricks.numbers, bits
    wanted = bricks.numbers + bricks.stride(axis)
    at = torch.searchsorted(bricks.numbers, wanted).clamp_(max=len(bits) - 1)
    above = torch.where(bricks.numbers[at] == wanted, bits[at], 0)
    return bricks.numbers, bits & (bits >> step & ~last | (above & first) << 3 * step)


def _dense(bricks: _Bricks) -> tuple[list[int], list[int], Tensor | None]:
    """Return the base and the size of an array over the bricks, and the array where it is small enough."""
    places = bricks.places()
    low, high = ([1 << 20] * 3, [0] * 3) if len(places) == 0 else torch.stack([places.amin(0), places.amax(0)]).tolist()
    base, size = [at - 2 for at in low], [max(b - a, 0) + 5 for a, b in zip(low, high, strict=True)]
    cells = bricks.classes * size[0] * size[1] * size[2]
    if cells > _MOST_DENSE and cells > _DENSE_PER_BRICK * len(places):
        return base, size, None
    at = bricks.ranks()
    for axis in range(3):
        at = at * size[axis] + (places[:, axis] - base[axis])
    dense = torch.zeros(cells, dtype=torch.int64, device=at.device)
    dense[at] = bricks.bits
    return base, size, dense


def _hashed(module: ModuleType, bricks: _Bricks) -> tuple[Tensor, Tensor]:
    """Return the slots of all classes [S, 2] and the range of each class in them [classes, 3], as ``BrickRange``."""
    ranks, places = bricks.ranks(), bricks.places()
    first, rows = 0, []
    for count in torch.bincount(ranks, minlength=bricks.classes).tolist():
        bits = max(2 * count - 1, 1).bit_length()  # Tables at most half full have short chains.
        rows.append((first, (1 << bits) - 1, 64 - bits))
        first += 1 << bits
    ranges = torch.tensor(rows, dtype=torch.int64, device=ranks.device)
    slots = torch.zeros(first, 2, dtype=torch.int64, device=ranks.device)
    slots[:, 0] = -1  # kNoBrick
    keys = places[:, 0] << 40 | places[:, 1] << 20 | places[:, 2]
    with cuda_extension.on_device(ranks.device):
        filled = torch.stack([keys, bricks.bits], dim=1)
        module.hash_bricks(ranks.int(), filled, ranges, slots, cuda_extension.stream(ranks.device))
    return slots, ranges


def _signed(bits: int) -> int:
    """Return the int64 of these 64 bits."""
    bits &= (1 << 64) - 1
    return bits - (1 << 64) if bits >> 63 else bits
