"""The silhouette loss: an object rendered alone covers nothing visible beside its mask (our extension; section 10).

The boundary loss (E7) hardly sees a Gaussian that others cover; once the object is extracted, nothing covers it, and it
shows. So this term renders the object alone, as extraction does. It does not ask the object to cover its mask: where
many masks take in a plinth, the cheapest way would be a spike behind the plinth, which no photo contradicts.
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
"""Number of the 27 voxels around a point that a plane fills which ends one voxel before it; at its edge it fills 6."""

SLACK = 0.4
"""How much alpha is free in a pixel next to another class, since such a pixel shows both."""


@dataclass(frozen=True)
class SilhouetteLoss(Loss):
    """Mean over the labelled pixels of A_c where M' != c, beyond ``SLACK`` at borders, summed over the view's objects.

    A_c is the alpha of the Gaussians of class c rendered alone. A pixel does not count where the object lies behind
    what the whole scene shows, because there it may be hidden rightly.

    objects: how many objects of the view are rendered in each step. They are chosen at random and counted in
        proportion; each costs a render of its Gaussians.
    seen: leaves alone the surface that goes on behind another object near a contact, too close to it for TAU. A pixel
        of another object does not count if the surface there lies behind what the scene shows and at least ``seen`` of
        the 27 voxels around it were seen as this object's (a plane fills 9). Nor does it if ``EDGE`` of them were, and
        no more as the other object's. With 0, all such pixels count.
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
        nothing = inputs.render.color.new_zeros(())
        if inputs.labels is None:
            return nothing
        if inputs.draw is None or inputs.class_ids is None or inputs.render.median_depth is None:
            raise ValueError("the silhouette loss needs class ids, a way to draw, and a render with geometry")
        known = inputs.labels != IGNORE
        present = objects_in(inputs.labels) if inputs.present is None else inputs.present
        if not present:
            return nothing
        members = ClassMembers(inputs.class_ids) if inputs.members is None else inputs.members
        chosen = _chosen(len(present), int(self.objects), inputs.seed, inputs.step)
        terms = [self._of_object(present[rank], members.of(present[rank]), known, inputs) for rank in chosen]
        count = known.sum().double()
        share = torch.full_like(count, len(present) / len(terms)) / count
        return torch.stack(terms).sum() * share.to(nothing)

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
        shown = inputs.render.median_depth.detach()
        hidden = (shown > 0) & (depth > (1.0 + TAU) * shown)
        outside = known & (inputs.labels != class_id) & ~hidden
        if self.seen > 0:
            of_others = outside & (inputs.labels != 0) & (alone.alpha.detach() > 0) & (depth > shown)
            outside &= ~self._own_surface(of_others, depth, class_id, inputs)
        return ordered_sum(beyond_slack(torch.where(outside, alone.alpha, 0.0), inputs.labels))

    def _own_surface(self, asked: Tensor, depth: Tensor, class_id: int, inputs: LossInputs) -> Tensor:
        """Return the pixels of ``asked`` [H, W] bool at whose ``depth`` [H, W] the object's surface goes on."""
        if inputs.grid is None or inputs.labels is None:
            raise ValueError("the silhouette loss needs labels and a visibility grid where seen > 0")
        points = lift(depth, inputs.camera).reshape(-1, 3)
        # All pixels are passed, since choosing some would make the host wait for the GPU; IGNORE reads no voxel.
        ids = torch.where(asked, class_id, IGNORE).int().reshape(-1)
        others = torch.where(asked, inputs.labels, IGNORE).int().reshape(-1)
        own, other = inputs.grid.count(points, ids), inputs.grid.count(points, others)
        return ((own >= self.seen) | (own >= other.clamp_min(EDGE))).view_as(asked)


def beyond_slack(wrong: Tensor, labels: Tensor) -> Tensor:
    """Return ``wrong`` [H, W], but only its excess over ``SLACK`` in pixels next to another class of M' [H, W] int."""
    return torch.where(at_border(labels), (wrong - SLACK).clamp_min(0.0), wrong)


def _chosen(count: int, wanted: int, seed: int, step: int) -> list[int]:
    """Choose the ranks of the objects to render, from (seed, step) alone."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    return torch.randperm(count, generator=generator)[:wanted].tolist()
