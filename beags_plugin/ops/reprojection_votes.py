"""Labels of some views, voted by the lifted pixels of all (method, section 2; E5)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension, extension


def reprojection_votes(
    depths: Sequence[Tensor],
    labels: Sequence[Tensor | None],
    own: Sequence[Tensor | None],
    maps: Tensor,
    first: int,
    num_classes: int,
    tau: float,
    ignore: int,
) -> tuple[list[Tensor], list[Tensor]]:
    """Vote on the labels of the views first .. first + T - 1; a pixel without votes keeps its label.

    depths: V x [H, W], float32 or float64, on the CPU or a GPU, all of one dtype. labels: V x [H, W] int32 or uint8,
        None: no mask; ids that are not 0 .. num_classes - 1 do not vote, nor does 255 of a uint8 map.
    own: T x [H, W] int32, the labels to vote on; None: no mask.
    maps: [T, V, 12] of the same dtype, on the CPU, from view v to view first + t: A row-major, then b; a pixel (x, y)
        at depth d projects to d A (x, y, 1) + b = z (x', y', 1).
    tau: a vote counts where |z - D| <= tau z; infinity: everywhere. ignore: label of views without a mask.
    Returns the labels, T x [H, W] int32, and their shares of the votes, T x [H, W] float32. Each thread, or the GPU,
    takes H W num_classes counters of 4 bytes.
    """
    dtype = depths[0].dtype
    depths = [extension.plain(f"depths[{v}]", d, (d.shape[0], d.shape[1]), dtype) for v, d in enumerate(depths)]
    wide: list[Tensor | None] = [None] * len(labels)
    narrow: list[Tensor | None] = [None] * len(labels)
    for v, mask in enumerate(labels):
        if mask is not None:
            of_type, dtype_of_labels = (narrow, mask.dtype) if mask.dtype == torch.uint8 else (wide, torch.int32)
            of_type[v] = extension.plain(f"labels[{v}]", mask, tuple(depths[v].shape), dtype_of_labels)
    maps = extension.plain("maps", maps, (len(maps), len(depths), 12), dtype)
    voted, confidence = [], []
    for view, mask in zip(range(first, first + len(maps)), own, strict=True):
        shape, device = tuple(depths[view].shape), depths[view].device
        blank = torch.full(shape, ignore, dtype=torch.int32, device=device)
        voted.append(blank if mask is None else extension.plain("own", mask, shape, torch.int32).clone())
        confidence.append(torch.empty(shape, dtype=torch.float32, device=device))
    arguments = (depths, wide, narrow, first, maps, voted, confidence, num_classes, tau)
    if (module := cuda_extension.module_for(*depths)) is not None:
        pixels = max((image.numel() for image in voted), default=0)
        counters = torch.empty(pixels * num_classes, dtype=torch.int32, device=depths[0].device)
        cuda_extension.call(module, "reprojection_votes", depths[0], *arguments, counters)
    else:
        extension.function("reprojection_votes", maps)(*arguments, extension.threads())
    return voted, confidence
