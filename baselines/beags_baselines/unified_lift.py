"""Unified-Lift as a refiner: codes and a codebook of objects are trained on a frozen base (``object_codebook``).

The source trains both together with the scene. Their terms do not reach the geometry, so that training them afterwards
differs in the start only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_baselines import identity_codes, object_codebook
from beags_baselines.learned_codes import CodeTraining
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import say

SAMPLES = 0  # purpose of random numbers


@dataclass(frozen=True)
class UnifiedLiftRefiner(Refiner):
    """Takes every object out of the base by the codes of the codebook that belong to it."""

    codes: int = object_codebook.CODES
    """Codes of the codebook, at least one for each class."""
    rule: str = object_codebook.RULES[0]
    """Rule of objects: softmax or argmax."""
    threshold: float = identity_codes.THRESHOLD
    """Least probability of an object (softmax)."""
    hull: bool = identity_codes.HULL
    """Gaussians inside the object's hull join it (softmax)."""

    def __post_init__(self) -> None:
        check_choice(self.rule, object_codebook.RULES, "rule of objects")
        if self.codes < 2:
            raise UserError(f"codes is {self.codes}: give a number of codes, 2 or more.")
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a probability, from 0 to below 1.")

    def check(self, names: Mapping[int, str]) -> None:
        if self.codes < len(names):
            raise UserError(f"codes is {self.codes}, but there are {len(names)} classes: give as many codes at least.")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return CodebookTraining(scene, self)


class CodebookTraining(CodeTraining):
    """Trains a code of each Gaussian and the codebook; the scene stays fixed."""

    def __init__(self, scene: TrainedScene, options: UnifiedLiftRefiner) -> None:
        super().__init__(scene, options.codes, bias=False)
        self.options = options

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        if inputs.labels is None:
            return {}
        labels = ranked_labels(self.ranks, inputs.labels).flatten()
        labelled = labels != IGNORE
        if not bool(labelled.any()):  # a view without a mask
            return {}
        rendered = self.learned.rendered(inputs.surfels.detach(), inputs.camera).flatten(0, 1)
        places = labelled.nonzero()[:, 0]
        code_terms = self._terms_of_codes(rendered, labels, places, self.scene.generator(step, SAMPLES))
        terms = {**code_terms, **self._terms_of_codebook(rendered.detach()[places], labels[places].long())}
        return {name: object_codebook.WEIGHTS[name] * value for name, value in terms.items()}

    def _terms_of_codes(self, rendered: Tensor, labels: Tensor, places: Tensor, generator: torch.Generator) -> Terms:
        chosen = places[object_codebook.sampled(len(places), generator).to(places.device)]
        # Determinism: the gradient of rendered[chosen] depends on the number of threads.
        samples = torch.nn.functional.embedding(chosen, rendered)
        return {
            "contrast": object_codebook.contrast(samples, labels[chosen].long()),
            "norms": object_codebook.norms(rendered, labels != IGNORE),
        }

    def _terms_of_codebook(self, rendered: Tensor, labels: Tensor) -> Terms:
        """Return the terms of labelled pixels; rendered: [P, C] without gradient. labels: [P] ranks."""
        codes, codebook = self.options.codes, self.learned.classifier
        ids, group = torch.unique(labels, return_inverse=True)
        masses, largest = object_codebook.code_masses(codebook, rendered, group, len(ids), codes)
        targets = object_codebook.matching(masses)[group]
        counted = object_codebook.reliable(rendered, group, len(ids)).nonzero()[:, 0]
        if len(counted) == 0:
            return {}
        rendered, own_codes = rendered[counted], targets[counted]
        terms = {"concentration": object_codebook.concentration(codebook.weight, rendered, own_codes)}
        if bool((largest != targets).any()):
            terms["classes"] = object_codebook.selection(codebook, rendered, own_codes, codes)
        return terms

    @torch.no_grad()
    def finish(self) -> Membership:
        scene, options, codebook, codes = self.scene, self.options, self.learned.classifier, self.learned.codes
        tables = codes.new_zeros(len(self.ranks), options.codes, dtype=torch.int64)
        for table in self._tables():
            tables += table
        owner = object_codebook.owners(tables)
        owned, used = torch.unique(owner[owner >= 0]).tolist(), int((tables.sum(dim=0) > 0).sum())
        seen = (tables.sum(dim=1) > 0).tolist()
        lost = [scene.names[c] for rank, c in enumerate(self.ranks.ids.tolist()) if seen[rank] and rank not in owned]
        without = f"; none belongs to {', '.join(lost)}: train longer (refine_steps)" if lost else ""
        say(f"  codebook: {used} codes are used, {int((owner >= 0).sum())} of them belong to one class{without}")
        if options.rule == "argmax":
            return Membership(self.ranks.class_ids(object_codebook.ranks_by_argmax(codebook, codes, owner)))
        objects = object_codebook.members_by_softmax(codebook, codes, owner, len(self.ranks), options.threshold)
        means, ids = scene.surfels().means, self.ranks.ids.tolist()
        if options.hull:
            objects = {rank: chosen | identity_codes.inside_hull(means, chosen) for rank, chosen in objects.items()}
        return Membership.of_masks({ids[rank]: chosen for rank, chosen in objects.items()}, scene.class_ids())

    def _tables(self) -> Iterator[Tensor]:
        """Yield for each training view the labelled pixels of each class that get each code, [K, codes] int64."""
        scene, codes, surfels = self.scene, self.options.codes, self.scene.surfels().detach()
        with scene.stage("Giving codes to classes") as progress:
            for index, camera in enumerate(scene.cameras):
                labels = ranked_labels(self.ranks, scene.labels[index]).flatten()
                places = (labels != IGNORE).nonzero()[:, 0]
                if len(places):
                    rendered = self.learned.rendered(surfels, camera).flatten(0, 1)[places]
                    largest = object_codebook.largest_codes(self.learned.classifier, rendered, codes)
                    keys = labels[places].long() * codes + largest
                    yield torch.bincount(keys, minlength=len(self.ranks) * codes).view(-1, codes)
                progress(index + 1, len(scene.cameras))
