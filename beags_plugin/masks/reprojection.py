"""Multiview mask reprojection: all views vote on the labels of each view (E5; method, section 2; paper 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps, to_int32
from beags_plugin.ops import cuda_extension, extension
from beags_plugin.ops.reprojection_votes import reprojection_votes
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import each_view

_CHUNK_PIXELS = 1 << 16  # source pixels projected at a time, so that their temporaries stay in the cache
_DENSE_COUNTERS = 1 << 26  # most (pixel, class) pairs of a view that are counted in one array (256 MiB)


@dataclass(frozen=True)
class ReprojectedMask:
    """The labels M' of one view, on which all views agree.

    labels: [H, W] int32 class ids or IGNORE.
    confidence: [H, W] float32 in 0..1, the winner's share of all votes; 0 without votes.
    """

    labels: Tensor
    confidence: Tensor


def reproject_pairwise(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    num_classes: int,
    tau: float = TAU,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[ReprojectedMask]:
    """Give every pixel of every view the class for which most lifted pixels of all views vote (E5).

    depths: V x [H, W] float, world units along z; 0 where nothing is rendered. Views may differ in size.
    labels: V x [H, W] int32 class ids below ``num_classes`` or IGNORE; None for a view without a mask. ``LabelMaps``
        keep their narrow type.
    tau: a vote counts only if its point is visible, |z - D_i| <= tau z; ``inf`` counts all, as the paper's text says.
    progress: receives (done, V).

    IGNORE pixels and pixels without depth do not vote; a view also votes for itself. A pixel with a tie or without
    votes keeps its label, which is IGNORE in a view without a mask. Time grows with V^2 pixels. Memory holds depth and
    labels of all views (5 bytes a pixel), and a count for each pixel and class of one view.

    Yields the views in order. Raises ``UserError`` for a mask of the wrong size or with ids out of range.
    """
    check_counts(depths, cameras, labels, tau)
    for index, (depth, camera, mask) in enumerate(zip(depths, cameras, labels, strict=True)):
        check_view(index, depth, camera, mask, num_classes)
    if not cameras:
        return
    depths = list(depths)  # kept in memory, as every view is projected into every other
    maps, narrow = PixelMaps(cameras), _narrow(labels)
    compiled = cuda_extension.supports(*depths)
    size = max(camera.height * camera.width for camera in cameras) * num_classes
    dense = compiled and size <= _DENSE_COUNTERS
    # Each thread counts one view at a time, with its own counters.
    together = max(1, min(extension.threads(), 2 * _DENSE_COUNTERS // size)) if dense else 1
    batches = [range(i, min(i + together, len(cameras))) for i in range(0, len(cameras), together)]

    def votes(number: int) -> list[tuple[Tensor, Tensor]]:
        batch = batches[number]
        if not dense:
            return [_by_torch(depths, cameras, labels, num_classes, tau, i, maps) for i in batch]
        towards = torch.stack([torch.cat([A.flatten(1), b], dim=1) for A, b in map(maps.towards, batch)])
        own = [labels[view] for view in batch]
        voted = reprojection_votes(depths, narrow, own, towards.to(depths[0].dtype), batch[0], num_classes, tau, IGNORE)
        return list(zip(*voted, strict=True))

    for number, results in enumerate(each_view(len(batches), votes)):
        for i, result in zip(batches[number], results, strict=True):
            if progress:
                progress(i + 1, len(cameras))
            yield ReprojectedMask(*result)


def _narrow(labels: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Return the maps in the types of the compiled op: int32, or uint8 of ``label_maps.to_compact``."""
    if not isinstance(labels, LabelMaps):
        return list(labels)
    masks = (labels.narrow(index) for index in range(len(labels)))
    return [mask if mask is None or mask.dtype == torch.uint8 else to_int32(mask) for mask in masks]


def _by_torch(depths, cameras, labels, num_classes: int, tau: float, i: int, maps: PixelMaps) -> tuple[Tensor, Tensor]:
    """Reproject view i in torch, the reference of the compiled op."""
    camera = cameras[i]
    votes = _Votes(camera.height * camera.width, num_classes, depths[i].device)
    for depth, mask, A, b in zip(depths, labels, *maps.towards(i), strict=True):
        if mask is not None:
            _cast(votes, depth, mask, depths[i], (A, b), tau)
    return _decide(votes, labels[i], camera)


def check_counts(depths, cameras, labels, tau: float) -> None:
    """Raise ``ValueError`` for unequal numbers of views, ``UserError`` for a negative tau."""
    if not len(depths) == len(cameras) == len(labels):
        raise ValueError(f"{len(depths)} depths, {len(cameras)} cameras and {len(labels)} masks do not belong together")
    if not tau >= 0:
        raise UserError(f"tau is {tau}: it must be 0 or more (inf counts every vote).")


def check_view(index: int, depth: Tensor, camera: Camera, mask: Tensor | None, num_classes: int) -> None:
    """Raise ``UserError`` for a mask of the wrong size or with ids out of range, ``ValueError`` for such a depth."""
    size = (camera.height, camera.width)
    if tuple(depth.shape) != size:
        raise ValueError(f"depth {index} must be {list(size)}, not {list(depth.shape)}")
    if mask is None:
        return
    if tuple(mask.shape) != size:
        raise UserError(
            f"the mask of view {index} is {mask.shape[1]} x {mask.shape[0]} pixels but its image is "
            f"{camera.width} x {camera.height}: give both the same size."
        )
    low, high = (int(value) for value in torch.where(mask == IGNORE, 0, mask).aminmax())
    if low < 0 or high >= num_classes:
        raise UserError(
            f"the mask of view {index} holds class ids {low}..{high}, but only "
            f"0..{num_classes - 1} are known: name all classes."
        )


class PixelMaps:
    """The maps between the pixels of any two views: lifting and projection in one step."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        views = [camera.to("cpu", torch.float64) for camera in cameras]
        self.K = torch.stack([view.K for view in views])
        self.rotation = torch.stack([view.rotation for view in views])
        self.translation = torch.stack([view.translation for view in views])
        # W^T K^-1, from pixels to directions in the world.
        self.lift = _product(self.rotation.transpose(1, 2), torch.linalg.inv(self.K))

    def towards(self, i: int) -> tuple[Tensor, Tensor]:
        """Return A [V, 3, 3] and b [V, 3], float64, with which d A (x, y, 1) + b = z (x', y', 1).

        (x, y) is a pixel of view v at depth d, (x', y') its place in view i at depth z.
        """
        A = _product(_product(self.K[i], self.rotation[i]), self.lift)
        turn = _product(self.rotation[i], self.rotation.transpose(1, 2))
        moved = self.translation[i] - _product(turn, self.translation[..., None])[..., 0]
        b = _product(self.K[i], moved[..., None])[..., 0]
        A[i], b[i] = torch.eye(3, dtype=torch.float64), 0.0  # exact, without the rounding of the products
        return A, b


def _product(left: Tensor, right: Tensor) -> Tensor:
    """Multiply [.., 3, 3] by [.., 3, C]. Determinism: a fixed order of operations, unlike a library's product."""
    return sum(left[..., k, None] * right[..., k, None, :] for k in range(3))  # type: ignore[return-value]


def landing(
    x: Tensor, y: Tensor, depth: Tensor, pixel_map: tuple[Tensor, Tensor], size: tuple[int, int], counted: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Project pixels to another view; return which land inside [..], and the pixel index [M] and z [M] of these.

    x, y: of the pixels, centres at + 0.5. depth: world units along z. All broadcast to one shape [..]. pixel_map:
    A [3, 3] and b [3] of ``PixelMaps.towards``. size: width and height of the other view. counted: [..] bool, False
    excludes a pixel.
    """
    (A, b), (width, height) = (value.to(depth) for value in pixel_map), size
    hx, hy, z = (depth * (A[r, 0] * x + (A[r, 1] * y + A[r, 2])) + b[r] for r in range(3))
    # These are products, not quotients, so that points with z = 0, infinity or NaN fail the test.
    lands = counted & (z > 0) & (hx >= 0) & (hy >= 0) & (hx < width * z) & (hy < height * z)
    hx, hy, z = hx[lands], hy[lands], z[lands]
    # The quotient may round up to the width or height.
    column, row = (hx / z).long().clamp_(max=width - 1), (hy / z).long().clamp_(max=height - 1)
    return lands, row * width + column, z


def _cast(votes: _Votes, depth: Tensor, mask: Tensor, target_depth: Tensor, pixel_map, tau: float) -> None:
    """Add the votes of one view (``depth``, ``mask``) for another (``target_depth``)."""
    height, width = depth.shape
    x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    rows = max(1, _CHUNK_PIXELS // width)
    for top in range(0, height, rows):
        d, label = depth[top : top + rows], mask[top : top + rows]
        y = torch.arange(top, top + d.shape[0], dtype=depth.dtype, device=depth.device)[:, None] + 0.5
        size = (target_depth.shape[1], target_depth.shape[0])
        lands, pixel, z = landing(x, y, d, pixel_map, size, (d > 0) & (label != IGNORE))
        label = label[lands]
        if not math.isinf(tau):
            visible = (z - target_depth.reshape(-1)[pixel]).abs() <= tau * z
            pixel, label = pixel[visible], label[visible]
        votes.add(pixel, label)


class _Votes:
    """Counts per (pixel, class) of one view, in one array, or as sorted pairs if the array would be too large."""

    def __init__(self, num_pixels: int, num_classes: int, device: torch.device) -> None:
        self.num_pixels, self.num_classes = num_pixels, num_classes
        self.dense = num_pixels * num_classes <= _DENSE_COUNTERS
        size = num_pixels * num_classes if self.dense else 0
        self.counts = torch.zeros(size, dtype=torch.int32, device=device)
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)  # sorted, used if not dense

    def add(self, pixel: Tensor, label: Tensor) -> None:
        """Add a vote for ``label`` [M] int32 at each ``pixel`` [M] int64; integer sums are deterministic."""
        key = pixel * self.num_classes + label.long()
        if self.dense:
            self.counts.scatter_add_(0, key, torch.ones_like(key, dtype=torch.int32))
            return
        fresh, counts = torch.unique(key, return_counts=True)
        self.keys, inverse = torch.unique(torch.cat([self.keys, fresh]), return_inverse=True)
        both = torch.cat([self.counts, counts.int()])
        self.counts = torch.zeros_like(self.keys, dtype=torch.int32).scatter_add_(0, inverse, both)

    def winners(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return for each pixel the winner's id int64, its votes, how many classes have as many, and all votes."""
        if self.dense:
            counts = self.counts.view(self.num_pixels, self.num_classes)
            most, winner = counts.max(dim=1)
            return winner, most, (counts == most[:, None]).sum(1), counts.sum(1)
        pixel = self.keys // self.num_classes
        zeros = torch.zeros(self.num_pixels, dtype=torch.int32, device=self.keys.device)
        total = zeros.scatter_add(0, pixel, self.counts)
        most = zeros.scatter_reduce(0, pixel, self.counts, "amax")
        best = self.counts == most[pixel]
        leaders = zeros.scatter_add(0, pixel, best.int())
        winner = zeros.long()
        winner[pixel[best]] = self.keys[best] % self.num_classes  # A tie does not use it.
        return winner, most, leaders, total


def _decide(votes: _Votes, original: Tensor | None, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return label and confidence of each pixel."""
    winner, most, leaders, total = votes.winners()
    size = (camera.height, camera.width)
    if original is None:
        original = torch.full(size, IGNORE, dtype=torch.int32, device=winner.device)
    clear = (most > 0) & (leaders == 1)
    labels = torch.where(clear, winner.int(), original.reshape(-1).int())
    confidence = most.float() / total.clamp(min=1).float()
    return labels.view(size), confidence.view(size)
