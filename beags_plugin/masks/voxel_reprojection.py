"""Multiview mask reprojection through fine voxels: one vote a pixel, O(views x pixels) (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.pooled_votes import LOOKS, TorchVotes
from beags_plugin.masks.reprojection import PixelMaps, ReprojectedMask, check_counts, check_view, landing
from beags_plugin.masks.spatial_chunks import SpatialChunks, divide_space
from beags_plugin.ops.voxel_votes import votes_for
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import each_view

VOXEL_PIXELS = 1.5  # side of a voxel, in pixels seen at the objects' median depth
_DOUBTS = 0.95  # share of depth errors that the second look covers
_FOOTPRINTS = 1 << 16  # pixels, spread over all views, from which the voxel size is measured
_VIEWS = 48  # most views whose depth is compared with that of a neighbouring view
_SAMPLES = 1 << 16  # most pixels of these views
_ALIKE = 0.7  # least cosine between the axes of neighbouring views: 45 degrees


def reproject_voxel(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    num_classes: int,
    tau: float = TAU,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[ReprojectedMask]:
    """Give every pixel of every view the class with the most votes by lifted pixels of all views near its point.

    Arguments, results and ties are those of ``reprojection.reproject_pairwise``; ``tau`` only decides which points two
    neighbouring views share. A pixel votes in the voxel of its lifted point; voxels are ``VOXEL_PIXELS`` pixels wide at
    the median depth of the objects. It reads the votes of the eight voxels around its point with trilinear weights,
    which hides the grid. Unless one class has more than half of the votes of each of them, it also reads votes before
    and behind its point along its ray, because its own depth may be wrong. That second look reaches as far as depths
    disagree between neighbouring views, at most two voxels: with exact depth it would only add votes for other things.
    The confidence is the label's share of the votes in the point's own voxel, or of all votes read if that voxel has
    none.
    The cost is O(V pixels) for any number of classes. Depth and labels are read several times, one view at a time,
    perhaps from disk (``system.filed_tensors``). If voxels need more than about 0.4 GB, space is cut into chunks
    (``masks.spatial_chunks``) and all views are read for each chunk; the results have the same bits.
    """
    check_counts(depths, cameras, labels, tau)
    if not cameras:
        return
    size, alike = _survey(depths, cameras, labels, num_classes)
    lifts = _to_voxels(cameras, _origin(cameras), size)
    lifts[:, -1] *= _second_look(depths, cameras, tau) / LOOKS[-1]
    chunks = divide_space(depths, cameras, lifts)
    votes = _Votes(depths, labels, lifts, chunks, alike, progress)
    if len(chunks) == 1:
        yield from (ReprojectedMask(labels, confidence) for labels, confidence, _ in votes.of_chunk(0))
        return
    pieces = [filed(votes.pieces_of(chunk), depths[0].device) for chunk in range(len(chunks))]
    for i, (depth, mask) in enumerate(zip(depths, labels, strict=True)):
        voted, confidence = _known(depth, mask), torch.zeros(depth.shape, dtype=torch.float32, device=depth.device)
        coordinates = chunks.coordinates(depth, lifts[i].to(depth))
        for chunk, piece in enumerate(pieces):
            inside = chunks.inside(coordinates, chunk)
            voted[inside], confidence[inside] = piece[2 * i], piece[2 * i + 1]
        yield ReprojectedMask(voted, confidence)


class _Votes:
    """Casting and reading of votes, chunk by chunk."""

    def __init__(self, depths, labels, lifts: Tensor, chunks: SpatialChunks, alike: bool, progress) -> None:
        self.depths, self.labels, self.lifts, self.chunks = depths, labels, lifts, chunks
        self._alike, self._progress = alike, progress
        self._done, self._total = 0, 2 * len(chunks) * len(depths)

    def of_chunk(self, chunk: int) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
        """Yield labels [H, W] int32, confidence [H, W] float32 and a mask [H, W] of the chunk's pixels for each view.

        The mask is None where all pixels are in the chunk. Other pixels keep their label, with confidence 0.
        """
        compiled = votes_for([self.depths[0]], IGNORE) if self._alike else None
        votes = compiled or TorchVotes(IGNORE)
        for i, (depth, mask) in enumerate(zip(self.depths, self.labels, strict=True)):
            about = self._part(i, depth, chunk, self.chunks.about)
            if mask is not None and (about is None or bool(about.any())):
                votes.add(_where(about, depth), self.lifts[i].to(depth), mask.int())
            self._tick()
        votes.decide()

        def read(i: int) -> tuple[Tensor, Tensor, Tensor | None]:
            depth = self.depths[i]
            inside = self._part(i, depth, chunk, self.chunks.inside)
            known = _known(depth, self.labels[i])
            return *votes.read(_where(inside, depth), self.lifts[i].to(depth), known), inside

        for view in each_view(len(self.depths), read):
            yield view
            self._tick()

    def pieces_of(self, chunk: int) -> Iterator[Tensor]:
        """Yield labels [P], then confidence [P], of each view's points in the chunk, in the order of pixels."""
        for labels, confidence, inside in self.of_chunk(chunk):
            yield from (labels[inside], confidence[inside])

    def _part(self, i: int, depth: Tensor, chunk: int, choose) -> Tensor | None:
        if len(self.chunks) == 1:
            return None
        return choose(self.chunks.coordinates(depth, self.lifts[i].to(depth)), chunk)

    def _tick(self) -> None:
        self._done += 1
        if self._progress:
            self._progress(self._done, self._total)


def _second_look(depths: Sequence[Tensor], cameras: Sequence[Camera], tau: float) -> float:
    """Return the reach of the second look before and behind a point, in voxels."""
    pixels = disagreement(depths, cameras, tau, _DOUBTS)
    return LOOKS[-1] if pixels is None else min(pixels / VOXEL_PIXELS, LOOKS[-1])


def disagreement(depths: Sequence[Tensor], cameras: Sequence[Camera], tau: float, share: float) -> float | None:
    """Return the ``share`` quantile of depth differences between neighbouring views, in pixels (z / focal length).

    depths: V x [H, W] float, world units along z; 0: nothing rendered. Each view, or ``_VIEWS`` of many, is compared
    with the nearest view that looks the same way. tau: points that differ by more than tau z are taken for hidden and
    do not count. None if no two views show the same point.
    """
    pairs = [(i, j) for i, j in enumerate(_neighbours(cameras)) if j is not None]
    pairs = [pairs[n * len(pairs) // _VIEWS] for n in range(_VIEWS)] if len(pairs) > _VIEWS else pairs
    step = max(1, sum(cameras[i].height * cameras[i].width for i, _ in pairs) // _SAMPLES)
    apart = [_apart(depths[i], depths[j], cameras[i], cameras[j], tau, step) for i, j in pairs]
    differences = torch.cat(apart) if apart else torch.zeros(0)
    return float(differences.quantile(share)) if len(differences) else None


def _neighbours(cameras: Sequence[Camera]) -> list[int | None]:
    """Return the index of each view's neighbour, or None."""
    views = [camera.to("cpu", torch.float64) for camera in cameras]
    centres, axes = (torch.stack(values) for values in zip(*((v.center, v.rotation[2]) for v in views), strict=True))
    neighbours = []
    for i in range(len(views)):
        distance = (centres - centres[i]).norm(dim=1)
        distance[(axes * axes[i]).sum(dim=1) < _ALIKE] = torch.inf
        distance[i] = torch.inf
        nearest = int(distance.argmin())
        neighbours.append(nearest if distance[nearest] < torch.inf else None)
    return neighbours


def _apart(depth: Tensor, other_depth: Tensor, camera: Camera, other: Camera, tau: float, step: int) -> Tensor:
    """Return the depth differences [P] float64 at each ``step``-th pixel whose point the other view sees."""
    pixel = torch.arange(0, depth.numel(), step)
    # Computed on the CPU, so that every device gets the same bits.
    d, other_depth = depth.reshape(-1)[::step].cpu(), other_depth.cpu()
    x, y = pixel % camera.width + 0.5, pixel // camera.width + 0.5
    A, b = (values[0] for values in PixelMaps([camera, other]).towards(1))
    _, there, z = landing(x, y, d, (A, b), (other.width, other.height), d > 0)
    error = (z - other_depth.reshape(-1)[there]).abs()
    seen = error <= tau * z  # False for NaN
    return (error[seen] * other.focal / z[seen]).double()


def _where(chosen: Tensor | None, depth: Tensor) -> Tensor:
    return depth if chosen is None else torch.where(chosen, depth, 0.0)


def _known(depth: Tensor, mask: Tensor | None) -> Tensor:
    """Return a copy of the labels, [H, W] int32; IGNORE without a mask."""
    return torch.full_like(depth, IGNORE, dtype=torch.int32) if mask is None else mask.to(torch.int32, copy=True)


def _survey(depths, cameras, labels, num_classes: int) -> tuple[float, bool]:
    """Return the size of the voxels, and whether all depths share type and device; raise as ``check_view``.

    The size, world units, is ``VOXEL_PIXELS`` times the median of depth / focal length over the objects' pixels, or
    over all rendered pixels if there are no objects: the background may be far away.
    """
    step = max(1, sum(camera.height * camera.width for camera in cameras) // _FOOTPRINTS)
    thinned, labelled, kinds = [], [], set()
    for index, (depth, camera, mask) in enumerate(zip(depths, cameras, labels, strict=True)):
        check_view(index, depth, camera, mask, num_classes)
        # Computed on the CPU: on a GPU torch multiplies by the rounded 1 / focal length, and another voxel size changes
        # votes.
        thinned.append((depth.reshape(-1)[::step].cpu() / camera.focal).double())
        label = torch.zeros(len(thinned[-1]), dtype=torch.int32) if mask is None else mask.reshape(-1)[::step].cpu()
        labelled.append(label.clone())  # a slice would keep the view's whole map in memory
        kinds.add((depth.dtype, depth.device))
    return _voxel_size(torch.cat(thinned), torch.cat(labelled)), len(kinds) == 1


def _voxel_size(footprints: Tensor, label: Tensor) -> float:
    """Return the voxel size from sides of pixels [P] float64, world units, and labels [P] int32."""
    rendered = (footprints > 0) & footprints.isfinite()
    for counted in (rendered & (label > 0) & (label != IGNORE), rendered):
        if counted.any():
            return VOXEL_PIXELS * float(footprints[counted].median())
    return 1.0


def _origin(cameras: Sequence[Camera]) -> Tensor:
    """Return the mean of the camera centres, [3] float64, as voxels reach equally far to all sides."""
    return torch.stack([camera.to("cpu", torch.float64).center for camera in cameras]).mean(0)


def _to_voxels(cameras: Sequence[Camera], origin: Tensor, size: float) -> Tensor:
    """Return [V, 13] float64: A row by row, b, and the depth of one voxel along the central ray, the unit of ``LOOKS``.

    A pixel (x, y) at depth d lies at d A (x, y, 1) + b, in voxels.
    """
    views = [camera.to("cpu", torch.float64) for camera in cameras]
    to_world = torch.stack([view.rotation for view in views]).transpose(1, 2)
    A = to_world @ torch.linalg.inv(torch.stack([view.K for view in views])) / size
    middles = torch.tensor([[view.width / 2, view.height / 2, 1.0] for view in views], dtype=torch.float64)
    centres = (A @ middles[:, :, None])[..., 0]
    b = (torch.stack([view.center for view in views]) - origin) / size
    return torch.cat([A.flatten(1), b, 1.0 / centres.norm(dim=1, keepdim=True)], dim=1)
