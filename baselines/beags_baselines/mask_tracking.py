"""InstaScene's tracking: the Gaussians behind each mask, masks that hold several objects, and seeds of objects.

Yang et al., "InstaScene: Towards Complete 3D Instance Decomposition and Reconstruction from Cluttered Scenes",
ICCV 2025. Gaussian i is traced in view v, to class c, iff w_i > 0.1 at a pixel there, of class c. Only labelled pixels
count; the background is a class. A mask (v, c) of an object is tracked if at least 50 Gaussians, the set Q, are traced
to it. In another view v' each of Q has the object class to which it is traced with most pixels, or 0. The mask shows in
v' unless more than 0.7 of Q have 0; it is contained there if more than 0.8 of the others have one class, else split. It
is under-segmented if it shows in no view, or is split in more than 0.3 of the views that show it. With F_c the views
with other masks of c,

    seeds of c = { i:  sum over F_c of [i traced to c in v]  >  0.5 sum over F_c of [i traced in v] },

if F_c has two views. An under-segmented mask is accepted again if more than 0.8 of its set are seeds of one class.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

MIN_WEIGHT = 0.1
MIN_GAUSSIANS = 50
HIDDEN, CONTAINED, SPLIT, SEEDED, TAKEN_BACK = 0.7, 0.8, 0.3, 0.5, 0.8
LEAST_VIEWS = 2  # views that F_c needs


@dataclass(frozen=True)
class TracedView:
    """The Gaussians that are traced in one view.

    traced: [T] int32, ascending. members, classes, counts: [M] int32: the Gaussian, the class to which it is traced, a
    rank from 0 (background), and the number of pixels; ascending by Gaussian, then class.
    """

    traced: Tensor
    members: Tensor
    classes: Tensor
    counts: Tensor

    @classmethod
    def of_counts(cls, keys: Tensor, counts: Tensor, num_classes: int) -> TracedView:
        """Return the view of pixel counts with keys i * num_classes + c, ascending."""
        rows, columns = keys // num_classes, keys % num_classes
        return cls(torch.unique_consecutive(rows).int(), rows.int(), columns.int(), counts.int())

    def strongest(self, count: int, ground: bool = False) -> Tensor:
        """Return [count] int64: the object to which each Gaussian is traced with most pixels, 0 without any.

        Ties go to the lower class. ground: whether the background counts as an object.
        """
        own = torch.ones_like(self.classes, dtype=torch.bool) if ground else self.classes > 0
        members, classes, counts = self.members[own].long(), self.classes[own].long(), self.counts[own]
        most = counts.new_zeros(count).scatter_reduce(0, members, counts, "amax")
        leads = counts == most[members]
        beyond = int(classes.max()) + 2 if len(classes) else 1
        lowest = classes.new_full((count,), beyond)
        lowest = lowest.scatter_reduce(0, members[leads], classes[leads] + int(ground), "amin")
        return lowest.masked_fill(lowest == beyond, 0)


@dataclass(frozen=True)
class TrackedMasks:
    """Results of tracking.

    seeds: by rank, the seeds [S] int64 of each class, ascending; none for the background. suspect: (view, rank) of
    under-segmented masks.
    """

    seeds: tuple[Tensor, ...]
    suspect: frozenset[tuple[int, int]]

    def seed_classes(self, count: int) -> Tensor:
        """Return [count] int64: the lowest class of which each Gaussian is a seed, else 0."""
        classes = torch.zeros(count, dtype=torch.int64, device=self.seeds[0].device)
        for rank in reversed(range(1, len(self.seeds))):
            classes[self.seeds[rank]] = rank
        return classes

    def filtered(self, view: int, ranks: Tensor) -> Tensor:
        """Return the map of a view with its under-segmented masks set to the background."""
        for each, rank in sorted(self.suspect):
            if each == view:
                ranks = ranks.masked_fill(ranks == rank, 0)
        return ranks


def tracked_masks(
    views: list[TracedView],
    count: int,
    num_classes: int,
    min_gaussians: int = MIN_GAUSSIANS,
    ground_votes: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> TrackedMasks:
    """Track the masks of all views through all views.

    count: number of Gaussians. num_classes: number of ranks, including the background. ground_votes: whether the
    background counts as an object, as the ground does in the source's masks.
    """
    masks, sets = _masks(views, min_gaussians)
    split, visible = _splits(views, sets, count, ground_votes, progress)
    under = (visible == 0) | (split > SPLIT * visible)
    accepted = [mask for mask, bad in zip(masks, under.tolist(), strict=True) if not bad]
    seeds = _seeds(views, accepted, count, num_classes)
    suspect = under.nonzero()[:, 0].tolist()
    best = torch.zeros(len(masks), dtype=torch.int64)
    for each in seeds[1:]:
        if len(each):
            is_seed = torch.zeros(count, dtype=torch.bool, device=each.device)
            is_seed[each] = True
            for place in suspect:
                best[place] = max(int(best[place]), int(is_seed[sets[place].long()].sum()))
    rejected = [masks[place] for place in suspect if not int(best[place]) > TAKEN_BACK * len(sets[place])]
    return TrackedMasks(seeds, frozenset(rejected))


def _masks(views: list[TracedView], min_gaussians: int) -> tuple[list[tuple[int, int]], list[Tensor]]:
    """Return (view, rank) of the tracked masks of objects, and the Gaussians Q of each."""
    masks, sets = [], []
    for view, trace in enumerate(views):
        for rank in torch.unique(trace.classes).tolist():
            own = trace.members[trace.classes == rank]
            if rank > 0 and len(own) >= min_gaussians:
                masks.append((view, rank))
                sets.append(own)
    return masks, sets


def _splits(
    views: list[TracedView], sets: list[Tensor], count: int, ground: bool, progress: Callable[[int, int], None] | None
) -> tuple[Tensor, Tensor]:
    """Return for each mask the numbers of views in which it is split and in which it shows, [masks] int64."""
    if not sets:
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
    device = sets[0].device
    sizes = torch.tensor([len(each) for each in sets], device=device)
    members = torch.cat(sets)
    owners = torch.arange(len(sets), device=device, dtype=torch.int32).repeat_interleave(sizes)
    split, visible = torch.zeros_like(sizes), torch.zeros_like(sizes)
    for done, view in enumerate(views, start=1):
        classes = view.strongest(count, ground)[members.long()]
        labelled = classes > 0
        width = int(classes.max()) + 1
        pairs, counts = torch.unique(owners[labelled].long() * width + classes[labelled], return_counts=True)
        largest = torch.zeros_like(sizes).scatter_reduce(0, pairs // width, counts, "amax")
        total = torch.bincount(owners[labelled].long(), minlength=len(sets))
        not_hidden = (sizes - total) <= HIDDEN * sizes
        visible += not_hidden
        split += not_hidden & ~(largest > CONTAINED * total)
        if progress:
            progress(done, len(views))
    return split, visible


def _seeds(
    views: list[TracedView], masks: Iterable[tuple[int, int]], count: int, num_classes: int
) -> tuple[Tensor, ...]:
    """Return the seeds of each class by the views of ``masks``, which are not under-segmented."""
    device = views[0].traced.device
    own_views: list[list[int]] = [[] for _ in range(num_classes)]
    for view, rank in masks:
        own_views[rank].append(view)
    seeds = []
    for rank, those in enumerate(own_views):
        to_class = torch.zeros(count, dtype=torch.int32, device=device)
        anywhere = torch.zeros_like(to_class)
        for view in those if len(those) >= LEAST_VIEWS else []:
            trace = views[view]
            to_class[trace.members[trace.classes == rank].long()] += 1
            anywhere[trace.traced.long()] += 1
        seeds.append((to_class / (anywhere + 1e-6) > SEEDED).nonzero()[:, 0])
    return tuple(seeds)
