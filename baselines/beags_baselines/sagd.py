"""SAGD as a refiner: votes of centres, then decomposition of the members at the rim (``centre_votes``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from beags_baselines import centre_votes
from beags_plugin.core.densification import Densified
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import say

OFF = -1  # interval without decomposition


@dataclass(frozen=True)
class SagdRefiner(Refiner):
    """Takes objects out of the base by votes, and moves and shrinks Gaussians at their rims; nothing is trained."""

    threshold: float = centre_votes.THRESHOLD
    """Share of the votes that a member exceeds."""
    gd_interval: int = centre_votes.INTERVAL
    """Views from one decomposition to the next; -1: none."""
    votes: str = centre_votes.VOTES[0]
    """Views that vote: seen (the object shows) or all."""

    def __post_init__(self) -> None:
        check_choice(self.votes, centre_votes.VOTES, "rule of votes")
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a share of the votes, from 0 to below 1.")
        if self.gd_interval < 1 and self.gd_interval != OFF:
            raise UserError(f"gd_interval is {self.gd_interval}: give a number of views, 1 or more, or -1 for none.")

    def members(self, scene: AssignedScene) -> Membership:
        views = (scene.surfels.means, scene.cameras, scene.labels, scene.num_classes)
        return Membership(centre_votes.members(*views, self.threshold, self.votes))

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return Decomposition(scene, self)


class Decomposition(OwnTraining):
    """Decomposes Gaussians at the end and trains nothing; the members are those of the votes."""

    def __init__(self, scene: TrainedScene, options: SagdRefiner) -> None:
        self.scene, self.options = scene, options

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        return {}

    @torch.no_grad()
    def last_edit(self) -> Edit | None:
        if self.options.gd_interval == OFF:
            return None
        scene, surfels = self.scene, self.scene.surfels().detach()
        views = [index for index, labels in enumerate(scene.labels) if bool((labels != IGNORE).any())]
        views = views[:: self.options.gd_interval]
        changed, times = torch.zeros_like(scene.class_ids(), dtype=torch.bool), 0
        with scene.stage("Decomposing Gaussians") as progress:
            for done, index in enumerate(views):
                labels = scene.labels[index]
                surfels, member = centre_votes.decompose(surfels, scene.class_ids(), scene.cameras[index], labels)
                changed[member] = True
                times += len(member)
                progress(done + 1, len(views))
        say(f"  decomposition: {int(changed.sum())} Gaussians, {times} times in all, in {len(views)} views")
        return Edit(Densified.unchanged(surfels))

    def finish(self) -> Membership:
        return Membership(self.scene.class_ids())
