"""COB-GS as a refiner: mask phases (``mask_logits``) between steps alternate with texture phases.

Differences from the source: a mask phase is computed from sums over each view, which equals rendering it; with fewer
than 24 views it is longer, since logits would not move far enough; pixels without a label are neither inside nor
outside, and a view without labels trains texture only; halves of a split lie in the plane of their disc; texture phases
keep the base's loss of normals and have none of depths, which the source adds if there are depth maps; an object that
no Gaussian exceeds the threshold for is empty, where the source falls back to the whole scene. Taking all objects out
of one scene follows a fork of the source; the fork's clean-up by voxels, off by default there, is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beags_baselines import mask_logits
from beags_plugin.core.densification import Densified, split_by_sampling
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, TrainedScene
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import each_view

RATES = {"features_dc": 2.5e-3, "features_rest": 1.25e-4, "opacities": 0.025, "scales": 0.005, "quats": 0.001}
POSITION_RATE = 1.6e-6  # final rate of the base, for a scene of extent 1
PLAY, SPLIT, LAST_PLAY = range(3)  # purposes of random numbers between two steps


@dataclass(frozen=True)
class CobGsRefiner(Refiner):
    """Takes the objects out of one scene in turn, or one object only; the data determine the number of steps."""

    object: str = ""
    """The only object, as published; empty: all in turn."""
    order: str = mask_logits.ORDERS[0]
    """Order of the objects: area_desc, area_asc, label_asc."""
    epochs: int = 14
    """Epochs of an object: 6, 10, 14, ..; captures from one side: 22."""
    tau: float = mask_logits.TAU
    """Agreement below which a Gaussian is split; captures from one side: 0.5."""
    outside_weight: float = mask_logits.OUTSIDE_WEIGHT
    """Weight of pixels outside the mask."""
    threshold: float = mask_logits.THRESHOLD
    """Probability that a member exceeds."""

    def __post_init__(self) -> None:
        check_choice(self.order, mask_logits.ORDERS, "order of objects")
        if self.epochs < 6 or self.epochs % 4 != 2:
            raise UserError(f"epochs is {self.epochs}: give 6, 10, 14, .., so that a mask phase is the last.")
        for name in ("tau", "threshold"):
            if not 0.0 <= (value := getattr(self, name)) <= 1.0:
                raise UserError(f"{name} is {value:g}: give a share, 0 to 1.")
        if not self.outside_weight >= 0.0:
            raise UserError(f"outside_weight is {self.outside_weight:g}: give 0 or more.")

    @property
    def texture_phases(self) -> int:
        """Return the number of texture phases of an object; mask phases are one more."""
        return self.epochs // (2 * mask_logits.EPOCHS)

    def check(self, names: Mapping[int, str]) -> None:
        if self.object:
            check_choice(self.object, [name for c, name in names.items() if c != BACKGROUND], "object")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return mask_logits.EPOCHS * views * self.texture_phases * (1 if self.object else objects)

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return CobGsTraining(scene, self)


class CobGsTraining(OwnTraining):
    """Runs a mask phase before each texture phase and after all steps; texture steps are those of the base.

    With one object Adam continues from the base. With several, each object starts with a new Adam in the scene of the
    previous one, and takes Gaussians for which it has the higher probability.

    logits: those of the present object. class_ids, scores: [N], the objects taken so far and their probabilities.
    """

    def __init__(self, scene: TrainedScene, options: CobGsRefiner) -> None:
        self.scene, self.options = scene, options
        areas, self.masked = {c: 0 for c in scene.names if c != BACKGROUND}, []
        for view, labels in enumerate(scene.labels):
            counts = dict(zip(*(each.tolist() for each in torch.unique(labels, return_counts=True)), strict=True))
            areas = {c: area + counts.get(c, 0) for c, area in areas.items()}
            if counts.keys() - {IGNORE}:
                self.masked.append(view)
        ordered = mask_logits.object_order(areas, options.order)
        self.objects = [c for c in ordered if options.object in ("", scene.names[c])]
        self.phase_steps = mask_logits.EPOCHS * len(scene.cameras)
        self._begin(scene.surfels())
        self.scores = torch.zeros_like(self.logits.logits)
        self.class_ids = torch.zeros_like(self.scores, dtype=torch.int32)

    def rates(self, step: int) -> Mapping[str, float]:
        return {**RATES, "means": POSITION_RATE * self.scene.extent}

    def before_step(self, step: int) -> Edit | None:
        if step % self.phase_steps != 0:
            return None
        turn, phase = divmod(step // self.phase_steps, self.options.texture_phases)
        edited = Densified.unchanged(self.scene.surfels().detach())
        if phase == 0 and turn > 0:
            edited = self._last_phase(edited, self.objects[turn - 1], step)
        if phase == 0:
            self._begin(edited.surfels)
        agreement = self._learn(edited.surfels, self.objects[turn], self.scene.generator(step, PLAY))
        scales, tau = edited.surfels.log_scales, self.options.tau
        chosen = mask_logits.to_split(agreement, scales, self.scene.extent, tau)
        divided = split_by_sampling(edited.surfels, chosen, self.scene.generator(step, SPLIT))
        return Edit(self._followed(edited, divided), fresh_adam=phase == 0 and not self.options.object)

    def last_edit(self) -> Edit:
        edited = Densified.unchanged(self.scene.surfels().detach())
        return Edit(self._last_phase(edited, self.objects[-1], self.scene.steps))

    def finish(self) -> Membership:
        return Membership(self.class_ids)

    def state(self) -> dict[str, Any]:
        return {"logits": self.logits.state(), "class_ids": self.class_ids, "scores": self.scores}

    def restore(self, state: dict[str, Any]) -> None:
        device = self.scores.device
        self.class_ids, self.scores = state["class_ids"].to(device), state["scores"].to(device)
        # Adam keeps its count of steps, a scalar, on the CPU.
        moved = {name: values.to(device) if values.dim() else values for name, values in state["logits"].items()}
        self.logits.restore(moved)

    def _begin(self, surfels: Surfels) -> None:
        """Start new logits for the next object."""
        self.logits = mask_logits.MaskLogits(torch.zeros_like(surfels.opacity_logits))

    def _last_phase(self, edited: Densified, class_id: int, step: int) -> Densified:
        """Remove mixed Gaussians after an object's last mask phase, and let the object take its Gaussians."""
        agreement = self._learn(edited.surfels, class_id, self.scene.generator(step, LAST_PLAY))
        pure = Densified.unchanged(edited.surfels).only(~mask_logits.mixed(agreement, self.options.tau))
        edited = self._followed(edited, pure)
        self.class_ids, self.scores = mask_logits.claim(
            self.class_ids, self.scores, self.logits.logits, class_id, self.options.threshold
        )
        return edited

    def _followed(self, edited: Densified, then: Densified) -> Densified:
        """Return both edits as one; logits, ids and scores follow the second one."""
        self.logits.follow(then.source, then.fresh)
        self.class_ids, self.scores = self.class_ids[then.source], self.scores[then.source]
        return edited.then(then)

    def _learn(self, surfels: Surfels, class_id: int, generator: torch.Generator) -> Tensor:
        """Take the steps of a mask phase; return the agreement of each Gaussian's pixels, [N]."""
        scene, inputs, count = self.scene, geometry_inputs(surfels), len(self.masked)
        cameras = [scene.cameras[view] for view in self.masked]

        def mask(place: int) -> Tensor:
            labels = scene.labels[self.masked[place]]
            return (labels == class_id).int().masked_fill_(labels == IGNORE, IGNORE)

        def sums(place: int) -> Tensor:
            table = scene.rasterizer.class_contributions(inputs, cameras[place], scene.settings, mask(place), 2)
            return table.T.flip(0)  # rows: inside, outside

        def counts(place: int) -> Tensor:
            rasterizer = optional_products(scene.rasterizer)
            keys, numbers = rasterizer.sparse_class_pixel_counts(inputs, cameras[place], scene.settings, mask(place), 2)
            table = inputs.means.new_zeros(2 * len(surfels))
            table[keys] = numbers.to(table)
            return table.view(-1, 2).T.flip(0)

        with torch.no_grad(), scene.stage(f"Learning {scene.names[class_id]}") as progress:
            tables = filed(each_view(count, sums, lambda done, _: progress(done, 2 * count)), inputs.means.device)
            views = each_view(count, counts, lambda done, _: progress(count + done, 2 * count))
            agreement = mask_logits.mean_agreement(views)
        pixels, epochs = [camera.height * camera.width for camera in cameras], mask_logits.phase_epochs(count)
        mask_logits.play_phase(self.logits, tables.__getitem__, pixels, generator, epochs, self.options.outside_weight)
        return agreement
