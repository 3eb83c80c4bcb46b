"""Multiview mask reprojection through fine voxels: one vote a pixel, O(views x pixels) (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.masks.pooled_votes import TorchVotes
from beags_plugin.masks.reprojection import ReprojectedMask, check_views
from beags_plugin.ops import extension
from beags_plugin.ops.voxel_votes import VoxelVotes
from beags_plugin.rasterizers.interface import IGNORE

VOXEL_PIXELS = 1.5  # side of a voxel, in pixels seen at the objects' median depth
_FOOTPRINTS = 1 << 16  # pixels that measure the voxel size, spread over all views


def reproject_voxel(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    num_classes: int,
    tau: float = 0.02,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[ReprojectedMask]:
    """Give every pixel of every view the class for which most lifted pixels of all views vote about its point.

    Arguments and results are those of ``reprojection.reproject_pairwise``, and so is what a tie does. A pixel votes in
    the voxel that holds its lifted point; voxels are ``VOXEL_PIXELS`` pixels wide at the median depth of the objects.
    It reads the votes of the eight voxels about its point, each weighted by how near it is (trilinear), so that it does
    not matter where the borders of the voxels lie. Unless one class has more than half of the votes of each, it reads
    them two voxels before and two behind its point along its ray too: an error of its own depth then does less harm.
    The confidence is the label's share of the votes in the voxel of the point, or of those read if that has none.
    The points are lifted from what each view sees, so no vote passes through a surface, and ``tau`` is not used.
    Cost O(V pixels), memory linear in the voxels; neither depends on the number of classes.
    """
    check_views(depths, cameras, labels, num_classes, tau)
    if not cameras:
        return
    size, origin = _voxel_size(depths, cameras, labels), _origin(cameras)
    votes = VoxelVotes(IGNORE) if extension.can_take(*depths) else TorchVotes(IGNORE)
    views = len(cameras)
    lifts = [lift.to(depth) for depth, lift in zip(depths, _to_voxels(cameras, origin, size), strict=True)]
    for i, (depth, mask) in enumerate(zip(depths, labels, strict=True)):
        if mask is not None:
            votes.add(depth, lifts[i], mask.int())
        if progress:
            progress(i + 1, 2 * views)
    votes.decide()
    for i, (depth, mask) in enumerate(zip(depths, labels, strict=True)):
        known = torch.full_like(depth, IGNORE, dtype=torch.int32) if mask is None else mask.int()
        found = ReprojectedMask(*votes.read(depth, lifts[i], known))
        if progress:
            progress(views + i + 1, 2 * views)
        yield found


def _voxel_size(depths: Sequence[Tensor], cameras: Sequence[Camera], labels: Sequence[Tensor | None]) -> float:
    """``VOXEL_PIXELS`` times the median of depth / focal length over the objects' pixels (over all that are drawn, if
    there are none); world units. Objects, as it is about them that classes meet: what is behind them may be far away.
    """
    pixels = sum(depth.numel() for depth in depths)
    step = max(1, pixels // _FOOTPRINTS)
    thinned, labelled = [], []
    for depth, camera, mask in zip(depths, cameras, labels, strict=True):
        focal = (float(camera.K[0, 0]) * float(camera.K[1, 1])) ** 0.5
        thinned.append((depth.reshape(-1)[::step] / focal).double().cpu())
        label = torch.zeros(len(thinned[-1]), dtype=torch.int32) if mask is None else mask.reshape(-1)[::step].cpu()
        labelled.append(label)
    footprints, label = torch.cat(thinned), torch.cat(labelled)
    drawn = (footprints > 0) & footprints.isfinite()
    for counted in (drawn & (label > 0) & (label != IGNORE), drawn):
        if counted.any():
            return VOXEL_PIXELS * float(footprints[counted].median())
    return 1.0


def _origin(cameras: Sequence[Camera]) -> Tensor:
    """[3] float64: amid the cameras, as the voxels reach equally far to all sides."""
    return torch.stack([camera.to("cpu", torch.float64).center for camera in cameras]).mean(0)


def _to_voxels(cameras: Sequence[Camera], origin: Tensor, size: float) -> Tensor:
    """[V, 13] float64: A row by row, b, and the depth that is one voxel long along the ray of the image's centre.

    A pixel (x, y) at depth d lies at d A (x, y, 1) + b, in voxels.
    """
    views = [camera.to("cpu", torch.float64) for camera in cameras]
    to_world = torch.stack([view.rotation for view in views]).transpose(1, 2)
    A = to_world @ torch.linalg.inv(torch.stack([view.K for view in views])) / size
    middles = torch.tensor([[view.width / 2, view.height / 2, 1.0] for view in views], dtype=torch.float64)
    centres = (A @ middles[:, :, None])[..., 0]
    b = (torch.stack([view.center for view in views]) - origin) / size
    return torch.cat([A.flatten(1), b, 1.0 / centres.norm(dim=1, keepdim=True)], dim=1)
