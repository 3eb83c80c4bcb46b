"""ObjectGS as a refiner, on surfels: fixed classes, and a cross-entropy of their blend (``object_entropy``).

The source trains anchors and their networks from scratch, with the classes of seed points. Here the Gaussians of a
trained base get classes (``object_labels``) and are trained in the same number at the refinement's rates, since the
rates of the base's start would destroy it. With ``joint`` a base grows with the classes of its seed points.

Without anchors these properties are lost: opacity, shape and colour from networks for each view, so that a leak may be
hidden in some views; the bound on a Gaussian's distance from its anchor, which gives its class; networks that all
objects share; joint growth and pruning of the Gaussians of an anchor. A ``joint`` base grows like any other, and new
Gaussians inherit their class, where the source's new anchors have the highest id of several.

Other differences from the source: classes come from blending weights in all views, or from projected centres, where in
the source seed points vote, by default by their tracks; pixels with the source's id 0, "unlabelled", are IGNORE here,
and the background is one more object; the term of sizes is of areas, there of volumes; the weight of the cross-entropy
is the same for all data, there it is chosen by data set.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_baselines import object_entropy
from beags_baselines.object_labels import LABELS, labels_by_majority, labels_by_weight
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.preparation.refiner_training import OwnTraining, Terms, TrainedScene
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.errors import UserError, check_choice


@dataclass(frozen=True)
class ObjectGsRefiner(Refiner):
    """Trains all parameters of the scene on its photos and its classes; the classes stay fixed."""

    weight: float = object_entropy.WEIGHT
    """Weight of the cross-entropy."""
    ignore_background: bool = object_entropy.IGNORE_BACKGROUND
    """Background pixels are left out."""
    labels: str = LABELS[0]
    """Rule of the classes: e6 (ours), majority, nonzero."""
    scale_weight: float = object_entropy.SCALE_WEIGHT
    """Weight of the mean area of Gaussians."""
    joint: bool = False
    """Trains a base of its own, as published."""

    def __post_init__(self) -> None:
        check_choice(self.labels, LABELS, "rule of labels")
        for name in ("weight", "scale_weight"):
            if not 0.0 <= (value := getattr(self, name)) < math.inf:
                raise UserError(f"{name} is {value:g}: give the weight of a loss, 0 or more.")

    @property
    def joins_base(self) -> bool:
        return self.joint

    def steps(self, asked: int, views: int, objects: int) -> int:
        return 0 if self.joint else asked

    def seed_classes(self, scene: TrainedScene) -> Tensor:
        points = scene.surfels().means.detach()
        return labels_by_majority(points, scene.cameras, scene.labels, max(scene.names) + 1)

    def members(self, scene: AssignedScene) -> Membership | None:
        if self.labels == "majority":
            labels = labels_by_majority(scene.surfels.means, scene.cameras, scene.labels, scene.num_classes)
            return Membership(labels)
        if self.labels == "nonzero":
            table, ranks = scene.contributions, scene.contributions.classes
            labels = labels_by_weight(table.keys, table.sums, table.count, table.columns, nonzero=True)
            return Membership(labels if ranks is None else ranks.class_ids(labels))
        return None

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return LabelledTraining(scene, self)


class LabelledTraining(OwnTraining):
    """Trains the scene with the classes of its Gaussians; checkpoints hold these, so it has no state of its own."""

    def __init__(self, scene: TrainedScene, options: ObjectGsRefiner) -> None:
        self.scene, self.options = scene, options
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=scene.class_ids().device))

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms, scene, options = base(), self.scene, self.options
        if inputs.labels is not None and options.weight > 0:
            phi = self.ranks.ranks(scene.class_ids())
            carried = torch.bincount(phi, minlength=len(self.ranks)) > 0
            labels = self.ranks.ranked_labels(inputs.labels)
            labels = object_entropy.counted_labels(labels, carried, options.ignore_background)
            ranked = surfel_inputs(inputs.surfels, inputs.camera, sh_degree=0, class_ids=phi)
            ranked = replace(ranked, screen_shift=inputs.screen_shift)
            rasterizer = optional_products(scene.rasterizer)
            blend = rasterizer.class_channels(ranked, inputs.camera, scene.settings, len(self.ranks))
            terms["classes"] = options.weight * object_entropy.label_entropy(blend, labels)
        if options.scale_weight > 0:
            logs = inputs.surfels.log_scales - math.log(scene.scale)  # published in units of the input poses
            terms["areas"] = options.scale_weight * object_entropy.mean_area(logs, inputs.render.visible)
        return terms

    def finish(self) -> Membership:
        return Membership(self.scene.class_ids())
