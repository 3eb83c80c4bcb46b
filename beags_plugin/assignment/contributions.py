"""The contributions of every Gaussian to the pixels of every class, C of E6 (method, section 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.ops import extension
from beags_plugin.ops.sparse_sums import SparseSums
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings, SurfelInputs
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import each_view

Product = Callable[[SurfelInputs, Camera, RasterSettings, Tensor, int], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Contributions:
    """C[i, c] = sum over views and pixels with M' = c of w_i (E6), of N Gaussians, where it is not 0.

    keys: [M] int64, i * columns + rank of c, ascending. sums: [M] float64. classes: the ids that the ranks number.
    """

    count: int
    columns: int
    keys: Tensor
    sums: Tensor
    classes: ClassRanks | None = None

    def largest(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return per Gaussian the class of the largest sum (the lowest of equals), that sum, and the total.

        Returns [N] int32 class ids and twice [N] float64; 0 for a Gaussian that was never seen.
        """
        ranks, top, everything = largest_in_rows(self.keys, self.sums, self.count, self.columns)
        return ranks.int() if self.classes is None else self.classes.class_ids(ranks), top, everything

    def of(self, class_id: int) -> Tensor:
        """Return [N] float64, the sums of one class."""
        rank = class_id
        if self.classes is not None:
            rank = int(self.classes.ranks(torch.tensor([class_id])))
        own = self.keys % self.columns == rank
        sums = self.sums.new_zeros(self.count)
        sums[self.keys[own] // self.columns] = self.sums[own]
        return sums

    def total(self) -> Tensor:
        """Return [N] float64, the sums over all classes."""
        return self.sums.new_zeros(self.count).index_add(0, self.keys // self.columns, self.sums)


def contributions(
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    progress: Callable[[int, int], None] | None = None,
    product: Product | None = None,
) -> Contributions:
    """Return C of the scene (E6), or the sums of another product of its views.

    product: takes and returns what ``Rasterizer.sparse_class_contributions``, the default, does.
    surfels: N Gaussians. labels: per camera [H, W] int32 class ids below ``num_classes`` or IGNORE, or None.
    Memory is linear in the (Gaussian, class) pairs that occur. Raises ``UserError`` for ids out of range.
    """
    settings = replace(settings, geometry=False, distortion=False)
    inputs = geometry_inputs(surfels)
    # Thousands of small weights need float64; a dense table of all classes would be mostly zeros.
    product = product or rasterizer.sparse_class_contributions
    total = SparseSums() if extension.supports(surfels.means) else TorchSparseSums(surfels.means.device)

    def of_view(index: int) -> tuple[Tensor, Tensor]:
        camera, mask = cameras[index], labels[index]
        if mask is None:
            return inputs.means.new_zeros(0, dtype=torch.int64), inputs.means.new_zeros(0)
        check_class_ids(mask, index, num_classes)
        with torch.no_grad():
            keys, values = product(inputs, camera, settings, mask, num_classes)
            return keys, values.to(inputs.means.dtype)

    if len(cameras) != len(labels):
        raise ValueError(f"{len(cameras)} cameras and {len(labels)} masks do not belong together")
    for keys, values in each_view(len(cameras), of_view, progress):
        total.add(keys, values)
    return Contributions(len(surfels), num_classes, *total.totals())


def check_class_ids(mask: Tensor, index: int, num_classes: int) -> None:
    """Raise ``UserError`` unless the mask [H, W] int of view ``index`` holds ids below ``num_classes`` or IGNORE."""
    known = mask[mask != IGNORE]
    if known.numel() and (int(known.min()) < 0 or int(known.max()) >= num_classes):
        raise UserError(
            f"the mask of view {index} holds class ids {int(known.min())}..{int(known.max())}, but only "
            f"0..{num_classes - 1} are known: name all classes."
        )
