"""ObjectGS as a refiner, on surfels: fixed classes, and a cross-entropy of their blend (``object_entropy``).

The source trains anchors and their networks from scratch, with the classes of seed points. Here the Gaussians of a
trained base get classes and are trained in the same number. They have the refinement's rates, since the rates of the
base's start would destroy it. With ``joint`` a base grows with the classes of its seed points.

Without anchors these properties are lost: opacity, shape and colour from networks for each view, so that a leak may be
hidden in some views; the bound on a Gaussian's distance from its anchor, which gives its class; networks that all
objects share; joint growth and pruning of the Gaussians of an anchor. A ``joint`` base grows like any other, and new
Gaussians inherit their class, where the source's new anchors have the highest id of several.

Other differences from the source: classes come from blending weights in all views, or from projected centres, where in
the source seed points vote, by default by their tracks; pixels with the source's id 0, "unlabelled", are IGNORE here,
and the background is one more object; the term of sizes is of areas, there of volumes; the weight of the cross-entropy
is the same for all data, there it is chosen by data set.

The option ``labels`` chooses among three rules of classes. "e6" is the assignment of beags: phi_i = argmax_c W[i, c].
"nonzero", for study, is the argmax over objects only, like the source's vote that drops the background; there one stray
object vote of twenty makes an object. "majority" projects centres into all views, without a test of occlusion, and
takes the most frequent id there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_baselines import object_entropy
from beags_baselines.pixels import pixels_under
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.preparation.refiner_training import OwnTraining, Terms, TrainedScene
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.errors import UserError, check_choice

LABELS = ("e6", "majority", "nonzero")  # the first is the default


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

    def steps(self, requested: int, views: int, objects: int) -> int:
        return 0 if self.joint else requested

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
            labels = ranked_labels(self.ranks, inputs.labels)
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


def labels_by_weight(keys: Tensor, sums: Tensor, count: int, num_classes: int, nonzero: bool = False) -> Tensor:
    """Return [count] int32: the class of most weight for each Gaussian; ties go to the lower id, 0 without weight.

    keys: [M] int64, i * num_classes + c, ascending; sums: [M] float64 above 0, W[i, c] over all views.
    nonzero: leave out the background if an object has any weight.
    """
    if nonzero:
        objects = keys % num_classes != BACKGROUND
        keys, sums = keys[objects], sums[objects]
    return largest_in_rows(keys, sums, count, num_classes)[0].int()


def labels_by_majority(
    points: Tensor, cameras: Sequence[Camera], labels: Sequence[Tensor | None], num_classes: int
) -> Tensor:
    """Return [N] int32: the class under most projections of each point [N, 3]; ties go to the lower id, 0 without any.

    labels: per camera [H, W] int class ids or IGNORE, which does not vote; or None.
    """
    votes = TorchSparseSums(points.device)
    for camera, mask in zip(cameras, labels, strict=True):
        if mask is None:
            continue
        seen, row, column = pixels_under(points, camera)
        label = mask[row, column].long()
        keys = (seen * num_classes + label)[label != IGNORE]
        votes.add(keys, torch.ones_like(keys, dtype=torch.float64))
    return labels_by_weight(*votes.totals(), len(points), num_classes)
