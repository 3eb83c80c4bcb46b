"""The per-class visibility voxel grids V_phi and their counts of occupied neighbours (method, section 5)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.ops import cuda_extension, extension
from beags_plugin.ops.voxel_lookup import VoxelLookup
from beags_plugin.ops.voxel_tally import VoxelTally
from beags_plugin.system.errors import UserError

_BOX = 4  # voxels along each side of the largest box that ``disc_inside`` tests
_BITS = 21  # bits of each of the three voxel indices in a key
_HALF = 1 << (_BITS - 1)


class VisibilityGrid:
    """The voxels that support each class: those that hold lifted points of this class alone.

    D_occ(x, V_phi) is the number of occupied voxels of V_phi among the 27 around x. A class without voxels, which is
    never seen or collides everywhere, has D_occ = 0: all of it is penalised.

    voxel_size: world units. origin: [3] float64, corner of voxel (0, 0, 0), world. num_classes: ids lie below it;
        memory and speed depend on the number of classes with voxels.
    keys: [M] int64, sorted: the occupied voxels, 21 bits per axis. classes: [M] int32, the class of each.
    """

    def __init__(self, voxel_size: float, origin: Tensor, num_classes: int, keys: Tensor, classes: Tensor) -> None:
        if not voxel_size > 0:
            raise ValueError(f"the voxel size must be positive, not {voxel_size}")
        self.voxel_size = float(voxel_size)
        self.origin = origin.to(torch.float64)
        self.num_classes = num_classes
        self.keys, self.classes = keys, classes
        self._lookup: VoxelLookup | None = None
        self._prepared = False

    @classmethod
    def from_points(
        cls, clouds: Iterable[tuple[Tensor, Tensor]], voxel_size: float, origin: Tensor, num_classes: int
    ) -> VisibilityGrid:
        """Build the grid of lifted points; a voxel in which classes collide is empty in all (method, section 5).

        clouds: pairs (points [P, 3] float, class_ids [P] int), one per view, read one by one.
        Raises ``UserError`` if the cloud spans more than 2^21 voxels along an axis.
        """
        origin = origin.to(torch.float64)
        clouds = iter(clouds)
        first = next(clouds, None)
        if first is not None:
            clouds = itertools.chain([first], clouds)
            if (module := cuda_extension.module_for(first[0])) is not None:
                tally = VoxelTally(module, first[0].device)
                for points, class_ids in clouds:
                    tally.add_points(points, class_ids.int(), origin, voxel_size)
                if not tally.all_near():
                    raise _too_far(voxel_size)
                return cls(voxel_size, origin, num_classes, *tally.pure())
        keys = torch.zeros(0, dtype=torch.int64, device=origin.device)
        classes, waiting = keys.int(), []
        for points, class_ids in clouds:
            own = _pack(_voxels(points, origin, voxel_size))
            waiting.append(_distinct(own, class_ids.int(), num_classes))
            # Merge rarely: each merge sorts all voxels.
            if sum(len(pair[0]) for pair in waiting) > len(keys):
                keys, classes = _merged([(keys, classes), *waiting], num_classes)
                waiting.clear()
        if waiting:
            keys, classes = _merged([(keys, classes), *waiting], num_classes)
        _, voxel, seen = torch.unique(keys, return_inverse=True, return_counts=True)
        alone = seen[voxel] == 1
        return cls(voxel_size, origin, num_classes, keys[alone], classes[alone])

    def only(self, classes: Tensor) -> VisibilityGrid:
        """Return the grid of some classes alone, which needs less memory. classes: [C] int, ids in any order."""
        chosen = torch.isin(self.classes, classes.to(self.classes))
        return VisibilityGrid(self.voxel_size, self.origin, self.num_classes, self.keys[chosen], self.classes[chosen])

    def to(self, device: torch.device | str) -> VisibilityGrid:
        """Return the grid on a device; itself if it lies there already."""
        if self.keys.device == torch.device(device):
            return self
        parts = (self.keys.to(device), self.classes.to(device))
        return VisibilityGrid(self.voxel_size, self.origin.to(device), self.num_classes, *parts)

    def lookup(self) -> VoxelLookup | None:
        """Return the compiled lookup, built on first use; None without the extension (for a GPU, with CUDA)."""
        if extension.load() is None or (not self.keys.is_cpu and cuda_extension.load() is None):
            return None
        if self._lookup is None:
            self._lookup = VoxelLookup(self.keys, self.classes, self.origin, self.voxel_size)
        return self._lookup

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_lookup": None}  # compiled objects cannot be copied

    def count(self, points: Tensor, class_ids: Tensor) -> Tensor:
        """Return D_occ by its definition, [P] int64 in 0..27, for checks and display.

        points: [P, 3] float, world. class_ids: [P] int; IGNORE has no voxels.
        """
        if (lookup := self._lookup_for(points)) is not None:
            return lookup.count(points, class_ids)
        total = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        usable = (_scaled(points, self.origin, self.voxel_size).abs() < _HALF).all(-1)
        for class_id in class_ids.unique().tolist():
            own = self.keys[self.classes == class_id]
            if class_id != IGNORE and len(own):
                of_class = torch.nonzero(usable & (class_ids == class_id))[:, 0]
                total[of_class] = _count(own, _voxels(points[of_class], self.origin, self.voxel_size))
        return total

    def valid(self, points: Tensor, class_ids: Tensor) -> Tensor:
        """Return D_occ > 0, [P] bool, by one look-up per point.

        points: [P, 3] float, world; False if not finite. class_ids: [P] int.
        """
        if (lookup := self._lookup_for(points)) is not None:
            return lookup.valid(points, class_ids)
        self._prepare_valid()
        voxels = _scaled(points, self.origin, self.voxel_size) - self._base.to(points)
        return self._member(voxels, class_ids)

    def disc_inside(self, means: Tensor, axes_u: Tensor, axes_v: Tensor, class_ids: Tensor) -> Tensor:
        """Return [N] bool, True only for discs of which every point is valid.

        means: [N, 3] centres, world. axes_u, axes_v: [N, 3] half axes, world. class_ids: [N] int. The test uses the
        disc's axis-aligned box; a box over more than four voxels along an axis gives False.
        """
        if (lookup := self._lookup_for(means)) is not None:
            return lookup.disc_inside(means, axes_u, axes_v, class_ids)
        self._prepare_valid()
        half = torch.sqrt(axes_u * axes_u + axes_v * axes_v)
        # The samples and this box round differently: a few units in the last place of the largest coordinate.
        rounding = 16 * torch.finfo(means.dtype).eps
        half = half * (1 + rounding) + rounding * (means.abs() + self.origin.to(means).abs())
        base = self._base.to(means)
        low = _scaled(means - half, self.origin, self.voxel_size) - base
        high = _scaled(means + half, self.origin, self.voxel_size) - base
        span = high - low
        inside = (span <= _BOX - 1).all(-1)  # False for NaN
        for step in sorted(itertools.product(range(_BOX), repeat=3), key=max):
            if max(step) != 1:  # Few boxes reach beyond the next voxel.
                reaching = torch.nonzero(inside & (span.amax(-1) >= max(step)))[:, 0]
            if len(reaching) == 0:
                break
            offset = span.new_tensor(step)
            chosen = reaching[(span[reaching] >= offset).all(-1)]
            inside[chosen] = self._member(low[chosen] + offset, class_ids[chosen]) & inside[chosen]
        return inside

    def state_dict(self) -> dict[str, Tensor]:
        """Return the grid as tensors."""
        return {
            "voxel_size": torch.tensor(self.voxel_size, dtype=torch.float64),
            "origin": self.origin,
            "num_classes": torch.tensor(self.num_classes),
            "keys": self.keys,
            "classes": self.classes,
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Tensor]) -> VisibilityGrid:
        """Restore the grid of a ``state_dict``."""
        size, num_classes = float(state["voxel_size"]), int(state["num_classes"])
        return cls(size, state["origin"], num_classes, state["keys"], state["classes"])

    def _lookup_for(self, points: Tensor) -> VoxelLookup | None:
        return self.lookup() if cuda_extension.supports(points) else None

    def _prepare_valid(self) -> None:
        """Collect, on first use, the valid voxels (next to an occupied one) in a box with a border of invalid ones."""
        if self._prepared:
            return
        self._prepared = True
        voxels = _unpack(self.keys)
        device = voxels.device
        low = voxels.amin(0) if len(voxels) else torch.zeros(3, dtype=torch.int64, device=device)
        high = voxels.amax(0) if len(voxels) else low
        self._base = low - 2  # one voxel for the dilation, one for the border
        dims = high - low + 5
        self._last = (dims - 1).tolist()
        x, y, z = dims.tolist()
        self._ranks = ClassRanks(self.classes)
        if x * y * z * len(self._ranks) >= 1 << 63:
            raise UserError(f"the views span {x} x {y} x {z} voxels, which is too many: raise k to get larger voxels.")
        self._strides = (y * z, z, 1)
        self._per_class = x * y * z
        linear = self._ranks.ranks(self.classes).long() * self._per_class
        for axis, stride in enumerate(self._strides):
            linear = linear + (voxels[:, axis] - self._base[axis]) * stride
        for stride in self._strides:  # the 27 neighbours, axis by axis; the border keeps them inside the box
            linear = torch.unique(torch.cat([linear - stride, linear, linear + stride]))
        self._valid_keys = linear

    def _member(self, voxels: Tensor, class_ids: Tensor) -> Tensor:
        """Look up whole float voxels [P, 3] relative to the box; those outside are moved to its border."""
        ranks = self._ranks.ranks(class_ids)
        known = ranks < len(self._ranks)
        linear = ranks.masked_fill(~known, 0).long() * self._per_class
        for axis, stride in enumerate(self._strides):
            # nan_to_num moves NaN to the border too.
            index = voxels[:, axis].nan_to_num(nan=0.0).clamp(0, self._last[axis])
            linear = linear + index.long() * stride
        if len(self._valid_keys) == 0:
            return torch.zeros_like(linear, dtype=torch.bool)
        position = torch.searchsorted(self._valid_keys, linear).clamp_(max=len(self._valid_keys) - 1)
        return (self._valid_keys[position] == linear) & known


def _distinct(keys: Tensor, classes: Tensor, num_classes: int) -> tuple[Tensor, Tensor]:
    """Return the distinct pairs, ordered; a key's rank and a class fit into 64 bits, a key and a class do not."""
    voxels, rank = torch.unique(keys, return_inverse=True)
    pairs = torch.unique(rank * num_classes + classes)
    return voxels[pairs // num_classes], (pairs % num_classes).int()


def _merged(pairs: list[tuple[Tensor, Tensor]], num_classes: int) -> tuple[Tensor, Tensor]:
    keys, classes = zip(*pairs, strict=True)
    return _distinct(torch.cat(keys), torch.cat(classes), num_classes)


def _count(keys: Tensor, voxels: Tensor) -> Tensor:
    """Return [P] int64, how many of the 27 voxels around each of ``voxels`` [P, 3] are in the sorted ``keys``."""
    total = torch.zeros(len(voxels), dtype=torch.int64, device=voxels.device)
    for step in itertools.product((-1, 0, 1), repeat=3):
        neighbour = voxels + voxels.new_tensor(step)
        near = ((neighbour >= -_HALF) & (neighbour < _HALF)).all(-1)
        key = _pack(neighbour.clamp(-_HALF, _HALF - 1))
        total += near & (keys[torch.searchsorted(keys, key).clamp_(max=len(keys) - 1)] == key)
    return total


def _scaled(points: Tensor, origin: Tensor, size: float) -> Tensor:
    """Return voxel indices as whole floats. Each step is monotonic, as ``disc_inside`` requires.

    The divisor is a tensor: torch divides by a number on a GPU by multiplying with its inverse, which rounds otherwise.
    """
    return torch.floor((points - origin.to(points)) / points.new_full((), size))


def _voxels(points: Tensor, origin: Tensor, size: float) -> Tensor:
    scaled = _scaled(points, origin, size)
    if not bool((scaled.abs() < _HALF).all()):
        raise _too_far(size)
    return scaled.long()


def _too_far(size: float) -> UserError:
    return UserError(
        f"points of the views lie more than {_HALF} voxels of size {size:.4g} apart or are not finite: "
        "raise k to get larger voxels, or train the base longer."
    )


def _pack(voxels: Tensor) -> Tensor:
    """Pack [P, 3] int64 indices in -2^20..2^20-1 into [P] int64 keys."""
    x, y, z = (voxels + _HALF).unbind(-1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def _unpack(keys: Tensor) -> Tensor:
    mask = (1 << _BITS) - 1
    return torch.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], dim=-1) - _HALF
