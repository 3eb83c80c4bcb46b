"""SAGD: Gaussians vote by where their centres fall in the masks, and those at an object's rim are drawn into it.

Hu et al., "SAGD: Boundary-Enhanced Segment Anything in 3D Gaussian via Gaussian Decomposition", arXiv 2401.17857. A
Gaussian is a member of an object if its centre lies in the object's mask in more than 0.7 of the views, whatever hides
it there. A member whose two ends, 1.5 sigma to both sides along its major axis in a picture, lie on different sides of
the outline is then decomposed: with the share ``ratio`` of the pixels between the ends that the mask has,

    mean += 0.5 (1 - ratio) 3 s_max a,    scales *= 0.8 ratio,

a being its major axis in space, turned towards the end inside. That is the middle of the inner part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import pixels_under, project_directions
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE

THRESHOLD = 0.7
"""Share of the votes that a member exceeds."""
INTERVAL = 20
"""Views from one in which Gaussians are decomposed to the next."""
VOTES = ("seen", "all")
"""Which views a share is of: those that show the object at all and have the centre in the picture, or all with masks,
as in the source. The first is the default."""

EXTENT = 3.0  # sigma from end to end
SHRINK = 0.8


def members(
    points: Tensor,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor],
    num_classes: int,
    threshold: float = THRESHOLD,
    votes: str = VOTES[0],
) -> Tensor:
    """Return [N] int32: the object of which each point is a member, 0 for none; ties of shares go to the lower id.

    points: [N, 3], centres. labels: per camera [H, W] int class ids below ``num_classes`` or IGNORE. A view in which
    all is IGNORE has no vote, nor has one that has IGNORE under a centre, about that one. Memory is linear in the
    (Gaussian, object) pairs that occur; masks are read one at a time.
    """
    views = [view for view, mask in enumerate(labels) if bool((mask != IGNORE).any())]
    found, unlabelled = TorchSparseSums(points.device), torch.zeros(len(points), device=points.device)
    for view in views:
        places, row, column, mask = *pixels_under(points, cameras[view]), labels[view]
        label = mask[row, column].long()
        unlabelled[places[label == IGNORE]] += 1
        keys = (places * num_classes + label)[(label != IGNORE) & (label != BACKGROUND)]
        found.add(keys, torch.ones_like(keys, dtype=torch.float64))
    keys, counts = found.totals()
    rows = keys // num_classes
    if votes == "all":
        asked = len(views) - unlabelled.double()[rows]
    else:
        asked = torch.zeros_like(counts)
        for view in views:  # again, now that the pairs are known
            places, row, column, mask = *pixels_under(points, cameras[view]), labels[view]
            voting = torch.zeros(len(points), dtype=torch.bool, device=points.device)
            voting[places] = mask[row, column] != IGNORE
            shown = torch.zeros(num_classes, dtype=torch.bool, device=points.device)
            shown[mask[mask != IGNORE].long()] = True
            asked += voting[rows] & shown[keys % num_classes]
    class_ids, share, _ = largest_in_rows(keys, counts / asked, len(points), num_classes)
    return class_ids.masked_fill(share <= threshold, BACKGROUND).int()


def decompose(surfels: Surfels, class_ids: Tensor, camera: Camera, labels: Tensor) -> tuple[Surfels, Tensor]:
    """Draw the members that straddle the outline of their object in a view into it; the others keep every bit.

    surfels: N without gradients. class_ids: [N] int, 0 for no member. labels: [H, W] int class ids or IGNORE, which
    counts neither as inside nor as outside. Returns the surfels, and the places [M] int64 of those that changed.
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

    found = labels[ends[..., 1], ends[..., 0]]
    inside = found == class_ids[member, None]
    acts = sound & (inside[:, 0] != inside[:, 1]) & (found != IGNORE).all(dim=1)
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

    It is sqrt(l) d of the larger eigenvalue and its eigenvector of u u^T + v v^T; either sign may come out.
    """
    a, b, c = u[:, 0] ** 2 + v[:, 0] ** 2, u[:, 0] * u[:, 1] + v[:, 0] * v[:, 1], u[:, 1] ** 2 + v[:, 1] ** 2
    half = (a - c) / 2
    root = (half * half + b * b).sqrt()
    # of both forms of the eigenvector the one without cancellation; of a circle, whose axes are any, x
    x = torch.where(half >= 0, half + root, b)
    y = torch.where(half >= 0, b, root - half)
    norm = (x * x + y * y).sqrt()
    x, y = torch.where(norm > 0, x / norm, 1.0), torch.where(norm > 0, y / norm, 0.0)
    return torch.stack([x, y], dim=1) * ((a + c) / 2 + root).sqrt()[:, None]


def _share_inside(labels: Tensor, start: Tensor, stop: Tensor, class_ids: Tensor) -> Tensor:
    """Return [M] float64: of the labelled pixels between two each, both included, the share that has the class.

    start, stop: [M, 2] int64, column and row. class_ids: [M].
    """
    span = stop - start
    steps = span.abs().amax(dim=1)
    order = steps.argsort(descending=True, stable=True)  # long ones first, so that those still going come first
    start, span, steps, class_ids = start[order], span[order], steps[order], class_ids[order]
    going = torch.bincount(steps).flip(0).cumsum(0).flip(0).tolist()
    inside = torch.zeros_like(steps)
    labelled = torch.zeros_like(steps)
    for step, count in enumerate(going):
        twice = 2 * steps[:count, None].clamp(min=1)
        column, row = (start[:count] + (2 * step * span[:count] + twice // 2) // twice).unbind(dim=1)  # rounded
        found = labels[row, column]
        inside[:count] += found == class_ids[:count]
        labelled[:count] += found != IGNORE
    shares = torch.zeros(len(steps), dtype=torch.float64, device=steps.device)
    shares[order] = inside.double() / labelled
    return shares
