"""Membership in the visibility voxel grids, one query a point (method, section 5)."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.ops import cuda_extension, extension, voxel_bricks


class VoxelLookup:
    """The occupied voxels of all classes, and the valid ones (next to an occupied one), as hashed 4 x 4 x 4 bricks.

    Memory is linear in the occupied voxels. Class ids that are no class of the grid have no voxels. Queries run on the
    device of their points, the CPU or a GPU, whose tables are built by the first query.

    keys: [M] int64, sorted; classes: [M] int32; origin: [3] float64, world; voxel_size: world units; all as in
        ``occupancy.grid.VisibilityGrid``, on any device.
    """

    def __init__(self, keys: Tensor, classes: Tensor, origin: Tensor, voxel_size: float) -> None:
        keys = extension.plain("keys", keys, (len(keys),), torch.int64)
        classes = extension.plain("classes", classes, (len(keys),), torch.int32)
        origin = extension.plain("origin", origin, (3,), torch.float64)
        self._ranks = ClassRanks(classes)
        self._occupied = (keys, self._ranks.ranks(classes), len(self._ranks))
        self._place = (origin.tolist(), voxel_size)
        self._native: Any = None
        self._voxels: dict[tuple[str, torch.device], Any] = {}

    @property
    def native(self) -> Any:
        """Return the tables as the CPU's module holds them."""
        if self._native is None:
            keys, ranks, count = self._occupied
            origin = torch.tensor(self._place[0], dtype=torch.float64)
            self._native = extension.module().VoxelLookup(keys.cpu(), ranks.cpu(), count, origin, self._place[1])
        return self._native

    def voxels(self, module: ModuleType, device: torch.device) -> Any:
        """Return the tables as the CUDA module takes them, in the memory of ``device``."""
        key = (module.__name__, device)
        if key not in self._voxels:
            keys, ranks, count = self._occupied
            made = voxel_bricks.tables(module, keys.to(device), ranks.to(device), count)
            tables, memory = made or self._copied(module, device)
            self._voxels[key] = (module.Voxels(tables, *self._place), memory)
        return self._voxels[key][0]

    def _copied(self, module: ModuleType, device: torch.device) -> tuple[list[Any], list[Any]]:
        """Return the CPU's tables copied to ``device``, for voxels too far apart to be numbered."""
        memory, tables = [], []
        for classes, base, size, *parts in self.native.tables():
            memory.append(
                [torch.frombuffer(bytearray(part), dtype=torch.uint8).to(device) if part else None for part in parts]
            )
            tables.append(module.VoxelTable(classes, base, size, *memory[-1]))
        return tables, memory

    def ranks(self, class_ids: Tensor) -> Tensor:
        """Return the classes as ``native`` numbers them: [N] int32, background 0. class_ids: [N] int32."""
        return self._ranks.ranks(class_ids)

    def count(self, points: Tensor, class_ids: Tensor) -> Tensor:
        """Return D_occ, [P] int64 in 0..27. points: [P, 3] float32 or float64, world; class_ids: [P] int."""
        return self._query("count", torch.int64, class_ids, points=points)

    def valid(self, points: Tensor, class_ids: Tensor) -> Tensor:
        """Return D_occ > 0, [P] bool; arguments as of ``count``."""
        return self._query("valid", torch.bool, class_ids, points=points)

    def disc_inside(self, means: Tensor, axes_u: Tensor, axes_v: Tensor, class_ids: Tensor) -> Tensor:
        """Return the discs that surely lie in valid voxels, [N] bool; arguments as ``VisibilityGrid.disc_inside``."""
        return self._query("disc_inside", torch.bool, class_ids, means=means, axes_u=axes_u, axes_v=axes_v)

    def _query(self, name: str, dtype: torch.dtype, class_ids: Tensor, **vectors: Tensor) -> Tensor:
        first = next(iter(vectors.values()))
        count = len(first)
        arrays = [extension.plain(key, value, (count, 3), first.dtype) for key, value in vectors.items()]
        class_ids = extension.plain("class_ids", class_ids.int(), (count,), torch.int32)
        out = torch.empty(count, dtype=dtype, device=first.device)
        module = cuda_extension.module_for(*arrays)
        if module is not None:
            voxels = self.voxels(module, first.device)
            cuda_extension.call(module, name, first, voxels, *arrays, self.ranks(class_ids), out)
            return out
        extension.function(name, first, self.native)(*arrays, self.ranks(class_ids), out, extension.threads())
        return out
