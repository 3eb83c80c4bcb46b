"""SAGD: members are chosen by the masks under their centres, and those at an object's rim are moved into it.

Hu et al., "SAGD: Boundary-Enhanced Segment Anything in 3D Gaussian via Gaussian Decomposition", arXiv 2401.17857. A
Gaussian is a member of an object if its centre lies in the object's mask in more than 0.7 of the views, occluded or
not. A member is then decomposed if the outline separates its two ends, 1.5 sigma to both sides along its major axis in
a picture. With ``ratio`` the share of the pixels between the ends that lie in the mask,

    mean += 0.5 (1 - ratio) 3 s_max a,    scales *= 0.8 ratio,

where a is its major axis in space, towards the end inside. The new mean is the middle of the inner part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from beags_baselines.pixels import pixels_under, project_directions
from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE

THRESHOLD = 0.7
"""Share of votes that a member exceeds."""
INTERVAL = 20
"""Number of views from one decomposition to the next."""
VOTES = ("seen", "all")
"""Views that vote: "seen", the default, those that show the object and have the centre in the picture; "all", as in the
source, all with masks."""

EXTENT = 3.0  # sigma from end to end
SHRINK = 0.8  # factor on the scales


def members(
    points: Tensor,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor],
    num_classes: int,
    threshold: float = THRESHOLD,
    votes: str = VOTES[0],
) -> Tensor:
    """Return the object of which each point is a member, [N] int32, 0 for none; ties go to the lower id.

    points: [N, 3], centres. labels: per camera [H, W] int class ids below ``num_classes`` or IGNORE. Views without
    labels do not vote, and a view with IGNORE under a centre does not vote about it. Memory is linear in the number of
    (Gaussian, object) pairs; masks are read one at a time.
    """
    views = [view for view, mask in enumerate(labels) if bool((mask != IGNORE).any())]
    sums, unlabelled = TorchSparseSums(points.device), torch.zeros(len(points), device=points.device)
    for view in views:
        places, row, column, mask = *pixels_under(points, cameras[view]), labels[view]
        label = mask[row, column].long()
        unlabelled[places[label == IGNORE]] += 1
        keys = (places * num_classes + label)[(label != IGNORE) & (label != BACKGROUND)]
        sums.add(keys, torch.ones_like(keys, dtype=torch.float64))
    keys, counts = sums.totals()
    rows = keys // num_classes
    if votes == "all":
        voters = len(views) - unlabelled.double()[rows]
    else:
        voters = torch.zeros_like(counts)
        for view in views:  # a second pass: the pairs are known now
            places, row, column, mask = *pixels_under(points, cameras[view]), labels[view]
            voting = torch.zeros(len(points), dtype=torch.bool, device=points.device)
            voting[places] = mask[row, column] != IGNORE
            visible = torch.zeros(num_classes, dtype=torch.bool, device=points.device)
            visible[mask[mask != IGNORE].long()] = True
            voters += voting[rows] & visible[keys % num_classes]
    class_ids, share, _ = largest_in_rows(keys, counts / voters, len(points), num_classes)
    return class_ids.masked_fill(share <= threshold, BACKGROUND).int()


def decompose(surfels: Surfels, class_ids: Tensor, camera: Camera, labels: Tensor) -> tuple[Surfels, Tensor]:
    """Move and shrink the members that straddle the outline of their object in a view; the others keep every bit.

    surfels: N without gradients. class_ids: [N] int, 0 for no member. labels: [H, W] int class ids or IGNORE, which is
    neither inside nor outside. Returns the surfels, and the indices [M] int64 of those that changed.
    """
    member = class_ids.nonzero()[:, 0]
    seen, row, column = pixels_under(surfels.means[member].double(), camera)
    member, size = member[seen], labels.new_tensor([camera.width - 1, camera.height - 1])
    means, logs = surfels.means[member].double(), surfels.log_scales[member].double()
    axes = rotation_from_quat(surfels.quats[member].double())[:, :, :2]
    u, v = (project_directions(axes[:, :, k] * logs[:, k : k + 1].exp(), means, camera) for k in (0, 1))
    reach = _major_axis(u, v) * (EXTENT / 2)
    sound = torch.isfinite(reach).all(dim=1)
    center = torch.stack([column, row], dim=1).double()
    ends = torch.stack([center + reach, center - reach], dim=1).nan_to_num().round()
    ends = ends.clamp(min=torch.zeros_like(size), max=size).long()  # [M, 2, (column, row)]

    at_ends = labels[ends[..., 1], ends[..., 0]]
    inside = at_ends == class_ids[member, None]
    acts = sound & (inside[:, 0] != inside[:, 1]) & (at_ends != IGNORE).all(dim=1)
    member, ends, reach, axes, logs = member[acts], ends[acts], reach[acts], axes[acts], logs[acts]
    first = inside[acts, 0]
    inner = torch.where(first[:, None], reach, -reach)
    start, stop = (torch.where(which[:, None], ends[:, 0], ends[:, 1]) for which in (first, ~first))
    ratio = _share_inside(labels, start, stop, class_ids[member])

    longest = logs.argmax(dim=1)
    axis = axes.gather(2, longest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    length = logs.gather(1, longest[:, None]).exp()
    towards = (project_directions(axis, surfels.means[member].double(), camera) * inner).sum(dim=1, keepdim=True)
    shift = torch.where(towards < 0, -0.5, 0.5) * (1 - ratio)[:, None] * EXTENT * length * axis
    moved, shrunk = surfels.means.clone(), surfels.log_scales.clone()
    moved[member] = (moved[member].double() + shift).to(moved)
    shrunk[member] = (logs + (SHRINK * ratio).log()[:, None]).to(shrunk)
    return replace(surfels, means=moved, log_scales=shrunk), member


def _major_axis(u: Tensor, v: Tensor) -> Tensor:
    """Return the major semi-axis [M, 2] of the ellipse that the conjugate semi-axes u, v [M, 2] span.

    It is sqrt(l) d, with the larger eigenvalue l of u u^T + v v^T and its eigenvector d, of either sign.
    """
    a, b, c = u[:, 0] ** 2 + v[:, 0] ** 2, u[:, 0] * u[:, 1] + v[:, 0] * v[:, 1], u[:, 1] ** 2 + v[:, 1] ** 2
    half = (a - c) / 2
    root = (half * half + b * b).sqrt()
    # The form of the eigenvector without cancellation is used; for a circle the axis is x.
    x = torch.where(half >= 0, half + root, b)
    y = torch.where(half >= 0, b, root - half)
    norm = (x * x + y * y).sqrt()
    x, y = torch.where(norm > 0, x / norm, 1.0), torch.where(norm > 0, y / norm, 0.0)
    return torch.stack([x, y], dim=1) * ((a + c) / 2 + root).sqrt()[:, None]


def _share_inside(labels: Tensor, start: Tensor, stop: Tensor, class_ids: Tensor) -> Tensor:
    """Return [M] float64: the share of the labelled pixels from start to stop that have the class.

    start, stop: [M, 2] int64, column and row, both included. class_ids: [M].
    """
    span = stop - start
    steps = span.abs().amax(dim=1)
    order = steps.argsort(descending=True, stable=True)  # long lines first: the unfinished ones are then a prefix
    start, span, steps, class_ids = start[order], span[order], steps[order], class_ids[order]
    going = torch.bincount(steps).flip(0).cumsum(0).flip(0).tolist()
    inside = torch.zeros_like(steps)
    labelled = torch.zeros_like(steps)
    for step, count in enumerate(going):
        twice = 2 * steps[:count, None].clamp(min=1)
        column, row = (start[:count] + (2 * step * span[:count] + twice // 2) // twice).unbind(dim=1)  # rounded
        label = labels[row, column]
        inside[:count] += label == class_ids[:count]
        labelled[:count] += label != IGNORE
    shares = torch.zeros(len(steps), dtype=torch.float64, device=steps.device)
    shares[order] = inside.double() / labelled
    return shares
