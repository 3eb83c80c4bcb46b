"""Votes per voxel and class in a GPU's memory (method, sections 2 and 5)."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension, extension

_LEAST = 1 << 10  # slots
_NONE = -1  # value of an empty slot: every bit is set


class VoxelTally:
    """Two growing hash tables: voxels with one class each, and further classes of voxels. Counts are exact.

    Memory is linear in the voxels: 20 bytes a slot, 16 for one of a further class, at least twice as many slots as are
    used or as one call may add. A call that may need more memory waits for the GPU to report the used slots. The order
    of classes in memory varies between runs; no result does.

    module: ``cuda_extension.load()``. device: where the memory lies.
    """

    def __init__(self, module: ModuleType, device: torch.device) -> None:
        self._module, self._device = module, device
        self._used = torch.zeros(3, dtype=torch.int32, device=device)
        self._most = [0, 0]  # upper bounds of the numbers of voxels and of further classes
        self._make(_LEAST, _LEAST)

    def add_pixels(self, depth: Tensor, to_voxels: Tensor, labels: Tensor, ignore: int) -> None:
        """Add one vote of each pixel; arguments as ``voxel_votes.VoxelVotes.add``, all but ``to_voxels`` on the GPU."""
        self._reserve(depth.numel())
        cuda_extension.call(self._module, "vote_pixels", depth, self._tally, depth, to_voxels, labels, ignore)

    def add_points(self, points: Tensor, class_ids: Tensor, origin: Tensor, size: float) -> None:
        """Add one vote of each point [P, 3] float for its class [P] int32, in the voxel floor((point - origin) / size).

        Points that are not finite, or 2^20 voxels or more from the origin along an axis, do not vote; ``all_near``
        tells whether there were any.
        """
        points = extension.plain("points", points, (len(points), 3), points.dtype)
        class_ids = extension.plain("class_ids", class_ids, (len(points),), torch.int32)
        self._reserve(len(points))
        where = origin.to(points.dtype).tolist()
        cuda_extension.call(self._module, "vote_points", points, self._tally, points, class_ids, where, size)

    def all_near(self) -> bool:
        """Return whether every point had a voxel."""
        return int(self._used[2]) == 0

    def pure(self) -> tuple[Tensor, Tensor]:
        """Return the voxels with votes for one class: sorted keys [M] int64, 21 bits an axis, and classes [M] int32."""
        keys, labels, _, further = self._memory[:4]
        alone = (keys != _NONE) & (further == _NONE)
        keys, order = torch.sort(keys[alone])
        return keys, labels[alone][order]

    def decide(self) -> None:
        """Decide each voxel; call it after all votes and before ``read``."""
        slots = len(self._memory[0])
        self._decided = [torch.empty(slots, dtype=torch.int32, device=self._device) for _ in range(2)]
        self._tally = self._module.VoxelTally(*self._memory, *self._decided)
        self._call("decide_votes", self._tally)

    def read(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> Tensor:
        """Return the confidence, [H, W] float32; sets ``labels`` [H, W] int32. See ``voxel_votes.VoxelVotes.read``."""
        confidence = torch.empty(tuple(depth.shape), dtype=torch.float32, device=depth.device)
        cuda_extension.call(self._module, "read_votes", depth, self._tally, depth, to_voxels, labels, confidence)
        return confidence

    def _make(self, slots: int, further: int) -> None:
        def memory(count: int, value: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return torch.full((count,), value, dtype=dtype, device=self._device)

        self._memory = [
            memory(slots, _NONE, torch.int64), memory(slots, _NONE), memory(slots, 0), memory(slots, _NONE),
            memory(further, _NONE, torch.int64), memory(further, 0), memory(further, _NONE), self._used,
        ]  # fmt: skip
        self._tally = self._module.VoxelTally(*self._memory, None, None)

    def _reserve(self, votes: int) -> None:
        """Make room for ``votes`` more voxels and further classes."""
        slots = (len(self._memory[0]), len(self._memory[4]))
        if any(2 * (most + votes) > there for most, there in zip(self._most, slots, strict=True)):
            self._most = self._used[:2].tolist()
            needed = [1 << (2 * (most + votes) - 1).bit_length() for most in self._most]  # Sizes are powers of two.
            wanted = [max(pair) for pair in zip(needed, slots, strict=True)]
            if wanted != list(slots):
                former, memory = self._tally, self._memory  # The memory must outlive the move.
                self._used = torch.where(torch.arange(3, device=self._device) == 2, memory[7], 0)
                self._make(*wanted)
                self._call("move_votes", former, self._tally)
        self._most = [most + votes for most in self._most]

    def _call(self, name: str, *arguments: Any) -> None:
        with cuda_extension.on_device(self._device):
            getattr(self._module, name)(*arguments, cuda_extension.stream(self._device))
