"""Multiview mask reprojection through fine voxels: one vote a pixel, O(views x pixels) (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.depth_agreement import disagreement
from beags_plugin.masks.pooled_votes import LOOKS, TorchVotes
from beags_plugin.masks.reprojection import ReprojectedMask, check_counts, check_view
from beags_plugin.masks.spatial_chunks import SpatialChunks, divide_space
from beags_plugin.ops.voxel_votes import votes_for
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import each_view

VOXEL_PIXELS = 1.5  # side of a voxel, in pixels seen at the objects' median depth
_DOUBTS = 0.95  # share of depths with errors within the second look
_FOOTPRINTS = 1 << 16  # pixels that measure the voxel size, spread over all views


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
    the median depth of the objects. It reads the votes of the eight voxels about its point with trilinear weights,
    which hides the grid. Unless one class has more than half of the votes of each, it also reads before and behind its
    point along its ray, against errors of its own depth. That second look reaches as far as depths disagree between
    neighbouring views, up to two voxels: with exact depth it would only add votes about other things.
    The confidence is the label's share of the votes in the voxel of the point, or of those read if that has none.
    Cost O(V pixels) for any number of classes. Depth and labels are read several times, one view at a time, perhaps
    from disk (``system.filed_tensors``). If voxels need more than about 0.4 GB, space is cut into chunks
    (``masks.spatial_chunks``) and all views are read for each; results are the same bits.
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
        found, confidence = _known(depth, mask), torch.zeros(depth.shape, dtype=torch.float32, device=depth.device)
        coordinates = chunks.coordinates(depth, lifts[i].to(depth))
        for chunk, piece in enumerate(pieces):
            inside = chunks.inside(coordinates, chunk)
            found[inside], confidence[inside] = piece[2 * i], piece[2 * i + 1]
        yield ReprojectedMask(found, confidence)


class _Votes:
    """Casting and reading of votes, chunk by chunk."""

    def __init__(self, depths, labels, lifts: Tensor, chunks: SpatialChunks, alike: bool, progress) -> None:
        self.depths, self.labels, self.lifts, self.chunks = depths, labels, lifts, chunks
        self._alike, self._progress = alike, progress
        self._done, self._total = 0, 2 * len(chunks) * len(depths)

    def of_chunk(self, chunk: int) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
        """Yield per view labels [H, W] int32, confidence [H, W] float32, and a mask [H, W] of the pixels with points in
        the chunk (None: all); the others keep their label, with confidence 0."""
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

        for found in each_view(len(self.depths), read):
            yield found
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


def _where(chosen: Tensor | None, depth: Tensor) -> Tensor:
    return depth if chosen is None else torch.where(chosen, depth, 0.0)


def _known(depth: Tensor, mask: Tensor | None) -> Tensor:
    """Return a copy of the labels, [H, W] int32; IGNORE without a mask."""
    return torch.full_like(depth, IGNORE, dtype=torch.int32) if mask is None else mask.to(torch.int32, copy=True)


def _survey(depths, cameras, labels, num_classes: int) -> tuple[float, bool]:
    """Return the size of the voxels, and whether all depths share type and device; raise as ``check_views``.

    The size is ``VOXEL_PIXELS`` times the median of depth / focal length over the objects' pixels (or all rendered
    ones, without objects); world units. The background, which may be far away, does not count.
    """
    step = max(1, sum(camera.height * camera.width for camera in cameras) // _FOOTPRINTS)
    thinned, labelled, kinds = [], [], set()
    for index, (depth, camera, mask) in enumerate(zip(depths, cameras, labels, strict=True)):
        check_view(index, depth, camera, mask, num_classes)
        # On the CPU: torch multiplies by the rounded 1 / focal length on a GPU; voxels of another size get other votes.
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
