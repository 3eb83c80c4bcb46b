"""Assignment of each Gaussian to the class to which it contributes most (method, section 3; E6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.ops import extension
from beags_plugin.ops.sparse_sums import SparseSums
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError
from beags_plugin.system.processes import each_view


@dataclass(frozen=True)
class Assignment:
    """Fixed classes of N Gaussians.

    class_ids: [N] int32, phi; background (0) if never seen.
    margin: [N] float32 in 0..1, the class's share of the Gaussian's contributions; 0 if never seen.
    never_seen: [N] bool, without contribution to a labelled pixel of any view.
    """

    class_ids: Tensor
    margin: Tensor
    never_seen: Tensor

    def __getitem__(self, selection: Tensor) -> Assignment:
        """Return the classes of some Gaussians; selection: [N] bool or [M] int64."""
        return Assignment(self.class_ids[selection], self.margin[selection], self.never_seen[selection])


def assign_classes(
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    progress: Callable[[int, int], None] | None = None,
) -> Assignment:
    """Return phi_i = argmax_c C[i, c], C[i, c] = sum over views and pixels with M' = c of w_i (E6); ties to lower ids.

    surfels: N Gaussians. labels: per camera [H, W] int32 class ids below ``num_classes`` or IGNORE, or None.
    Memory is linear in the (Gaussian, class) pairs that occur. Raises ``UserError`` for ids out of range.
    """
    settings = replace(settings, geometry=False, distortion=False)
    inputs = geometry_inputs(surfels)
    # float64, for thousands of small weights; sparse, as a table of all classes would be mostly zeros
    total = SparseSums() if extension.supports(surfels.means) else TorchSparseSums(surfels.means.device)

    def contributions(index: int) -> tuple[Tensor, Tensor]:
        camera, mask = cameras[index], labels[index]
        if mask is None:
            return inputs.means.new_zeros(0, dtype=torch.int64), inputs.means.new_zeros(0)
        check_class_ids(mask, index, num_classes)
        with torch.no_grad():
            return rasterizer.sparse_class_contributions(inputs, camera, settings, mask, num_classes)

    if len(cameras) != len(labels):
        raise ValueError(f"{len(cameras)} cameras and {len(labels)} masks do not belong together")
    for keys, values in each_view(len(cameras), contributions, progress):
        total.add(keys, values)
    class_ids, top, everything = largest_in_rows(*total.found(), len(surfels), num_classes)
    never_seen = everything <= 0
    margin = torch.where(never_seen, 0.0, top / everything.masked_fill(never_seen, 1.0))
    return Assignment(class_ids.int(), margin.float(), never_seen)


def check_class_ids(mask: Tensor, index: int, num_classes: int) -> None:
    """Raise ``UserError`` unless the mask [H, W] int of view ``index`` holds ids below ``num_classes`` or IGNORE."""
    known = mask[mask != IGNORE]
    if known.numel() and (int(known.min()) < 0 or int(known.max()) >= num_classes):
        raise UserError(
            f"the mask of view {index} holds class ids {int(known.min())}..{int(known.max())}, but only "
            f"0..{num_classes - 1} are known: name all classes."
        )
