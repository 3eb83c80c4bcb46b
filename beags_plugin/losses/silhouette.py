"""The silhouette loss: an object rendered alone covers nothing visible beside its mask (our extension; section 10).

The boundary loss (E7) hardly sees a Gaussian that other Gaussians cover. Once the object is extracted, nothing covers
it any longer. So this term renders the object alone, as extraction does. The object need not cover its mask: where many
masks include a plinth, such a term would grow a spike behind the plinth, which no photo contradicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from beags_plugin.core.lifting import TAU, lift
from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.class_members import ClassMembers
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.rasterizers.rendering import shape_inputs
from beags_plugin.system.errors import UserError

EDGE = 3
"""Of the 27 voxels around a point, a plane fills 9 inside, 6 at its edge, and 3 where it ends one voxel before."""

SLACK = 0.4
"""Alpha without penalty in a pixel next to another class, since such a pixel shows both."""


@dataclass(frozen=True)
class SilhouetteLoss(Loss):
    """Mean over the labelled pixels of A_c where M' != c, beyond ``SLACK`` at borders, summed over the view's objects.

    A_c is the alpha of the Gaussians of class c rendered alone. A pixel does not count where the object lies behind
    what the whole scene shows, because the object may well be hidden there.

    objects: how many objects of the view are rendered in each step. They are chosen at random and counted in
        proportion; each costs a render of its Gaussians.
    seen: spares a surface that continues behind another object, but too close to it for TAU. A pixel of another object
        does not count if the surface there lies behind what the scene shows, and at least ``seen`` of the 27 voxels
        around it were seen as this object's. ``EDGE`` of them are enough if no more were seen as the other object's.
        With 0, all such pixels count.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"geometry"})

    weight: float = 0.5

    objects: int = 1
    seen: int = 0

    def __post_init__(self) -> None:
        if not (self.objects >= 1 and float(self.objects).is_integer()):
            raise UserError(f"the silhouette loss has objects = {self.objects}: it must be a whole number, 1 or more.")
        if not (0 <= self.seen <= 27 and float(self.seen).is_integer()):
            raise UserError(f"the silhouette loss has seen = {self.seen}: it must be a whole number from 0 to 27.")

    def value(self, inputs: LossInputs) -> Tensor:
        zero = inputs.render.color.new_zeros(())
        if inputs.labels is None:
            return zero
        if inputs.draw is None or inputs.class_ids is None or inputs.render.median_depth is None:
            raise ValueError("the silhouette loss needs class ids, a way to draw, and a render with geometry")
        known = inputs.labels != IGNORE
        present = objects_in(inputs.labels) if inputs.present is None else inputs.present
        if not present:
            return zero
        members = ClassMembers(inputs.class_ids) if inputs.members is None else inputs.members
        chosen = _chosen(len(present), int(self.objects), inputs.seed, inputs.step)
        terms = [self._of_object(present[rank], members.of(present[rank]), known, inputs) for rank in chosen]
        count = known.sum().double()
        share = torch.full_like(count, len(present) / len(terms)) / count
        return torch.stack(terms).sum() * share.to(zero)

    def _of_object(self, class_id: int, members: Tensor, known: Tensor, inputs: LossInputs) -> Tensor:
        """Return the sum over the pixels that count, a scalar. members: [M] int64, the object's Gaussians."""
        assert inputs.draw is not None and inputs.labels is not None
        if len(members) == 0:
            return inputs.render.color.new_zeros(())
        alone = inputs.draw(shape_inputs(inputs.surfels, members), inputs.camera)
        assert alone.depth is not None and alone.median_depth is not None
        assert inputs.render.median_depth is not None
        # Thin parts have no median depth; their expected depth shows where they are.
        depth = torch.where(alone.median_depth > 0, alone.median_depth, alone.depth).detach()
        scene_depth = inputs.render.median_depth.detach()
        # The margin is a share of the scene's depth, not of the object's as in ``hides``, which would change training.
        hidden = (scene_depth > 0) & (depth > (1.0 + TAU) * scene_depth)
        outside = known & (inputs.labels != class_id) & ~hidden
        if self.seen > 0:
            of_others = outside & (inputs.labels != 0) & (alone.alpha.detach() > 0) & (depth > scene_depth)
            outside &= ~self._own_surface(of_others, depth, class_id, inputs)
        wrong = torch.where(outside, alone.alpha, 0.0)
        return ordered_sum(torch.where(at_border(inputs.labels), (wrong - SLACK).clamp_min(0.0), wrong))

    def _own_surface(self, candidates: Tensor, depth: Tensor, class_id: int, inputs: LossInputs) -> Tensor:
        """Return the pixels of ``candidates`` [H, W] bool at whose ``depth`` [H, W] the object's surface continues."""
        if inputs.grid is None or inputs.labels is None:
            raise ValueError("the silhouette loss needs labels and a visibility grid where seen > 0")
        points = lift(depth, inputs.camera).reshape(-1, 3)
        # All pixels are passed, since choosing some would make the host wait for the GPU; IGNORE reads no voxel.
        ids = torch.where(candidates, class_id, IGNORE).int().reshape(-1)
        others = torch.where(candidates, inputs.labels, IGNORE).int().reshape(-1)
        own, other = inputs.grid.count(points, ids), inputs.grid.count(points, others)
        return ((own >= self.seen) | (own >= other.clamp_min(EDGE))).view_as(candidates)


def _chosen(count: int, wanted: int, seed: int, step: int) -> list[int]:
    """Choose the ranks of the objects to render, from (seed, step) alone."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    return torch.randperm(count, generator=generator)[:wanted].tolist()
