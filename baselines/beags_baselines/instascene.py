"""InstaScene as a refiner: masks are tracked over a frozen base, and features are contrasted with the cleaned masks.

Before the first step ``mask_tracking`` finds masks that hold several objects, and seeds of each object. Each step then
renders unit features in one view and contrasts them (``prototypes``) with the masks of single objects. Every tenth step
also does so in five views together, and every step contrasts the features of the seeds. The Gaussians of an object are
those whose features are similar to the mean of its seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding

from beags_baselines import mask_tracking, prototypes
from beags_baselines.isolated_render import FeatureTraining
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import each_view, say

RATE = 0.025  # learning rate of the features, constant
SAMPLES = 32_768
SINGLE, MULTI, SPACE, UNFILTERED = 0.5e-6, 1e-6, 2.5e-6, 1e-6  # weights of terms; Adam depends on ratios only
TOGETHER, INTERVAL = 5, 10  # views that are contrasted together, and steps from one such step to the next
FEATURES, VIEWS, PROTOTYPES, PIXELS, ALL_PIXELS, SEVERAL, SEVERAL_PIXELS, SEEDS = range(8)  # purposes of random numbers


@dataclass(frozen=True)
class InstaSceneRefiner(Refiner):
    """Takes objects out of the base by learned features; they may overlap, and Gaussians may belong to none."""

    consider_negative: bool = True
    """The background is a class."""
    gram_feat: bool = False
    """Fixed, orthogonal prototypes: at most 16 classes."""
    ground_votes: bool = False
    """The background splits masks."""
    min_gaussians: int = mask_tracking.MIN_GAUSSIANS
    """Gaussians of a mask that is tracked."""
    min_weight: float = mask_tracking.MIN_WEIGHT
    """Blending weight that a traced Gaussian exceeds."""
    cosine: float = prototypes.COSINE
    """Least cosine with the object's prototype."""
    samples: int = SAMPLES
    """Samples of each term."""

    def __post_init__(self) -> None:
        if not 0.0 < self.cosine <= 1.0:
            raise UserError(f"cosine is {self.cosine:g}: give one above 0, up to 1.")
        if not 0.0 <= self.min_weight < 1.0:
            raise UserError(f"min_weight is {self.min_weight:g}: give a blending weight, from 0 to below 1.")
        for name in ("min_gaussians", "samples"):
            if (value := getattr(self, name)) < 1:
                raise UserError(f"{name} is {value}: give a number, 1 or more.")

    def check(self, names: Mapping[int, str]) -> None:
        if self.gram_feat and len(names) > prototypes.CHANNELS:
            raise UserError(
                f"gram_feat has room for {prototypes.CHANNELS} classes, the background among them, and there are "
                f"{len(names)}: leave it out."
            )

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return ContrastTraining(scene, self)


class ContrastTraining(FeatureTraining):
    """Trains a feature of each Gaussian; the scene stays fixed."""

    def __init__(self, scene: TrainedScene, options: InstaSceneRefiner) -> None:
        means = scene.surfels().means
        first = torch.rand(len(means), prototypes.CHANNELS, generator=scene.generator(0, FEATURES))
        super().__init__(scene, prototypes.unit(first.to(means.device)), RATE, VIEWS)
        self.options = options
        count, device = len(means), means.device
        self.tracked: mask_tracking.TrackedMasks | None = None
        self.seed_classes = torch.zeros(count, dtype=torch.int64, device=device)
        self.fixed: Tensor | None = None
        if options.gram_feat:
            self.fixed = prototypes.orthonormal(len(self.ranks), scene.generator(0, PROTOTYPES)).to(device)
        self._visible: dict[int, np.ndarray] = {}  # packed bits of each view; the scene stays fixed

    def before_step(self, step: int) -> Edit | None:
        self.adam.zero_grad()
        if self.tracked is None:
            self._track()
            if self.fixed is not None:
                seeds = self.seed_classes.nonzero()[:, 0]
                with torch.no_grad():
                    self.features[seeds] = self.fixed[self.seed_classes[seeds]]
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        if not self.masked or self.tracked is None:
            return {}
        units, view = prototypes.unit(self.features), self.view_of(step)
        rendered, ranks = self.drawing.channels(view, units), self.ranks_of(view).flatten()
        filtered = self.tracked.filtered(view, ranks)
        least = 0 if self.options.consider_negative else 1
        terms = {"single": SINGLE * self._of_pixels([rendered], [filtered], least, step, PIXELS)}
        if self.fixed is not None:
            terms["unfiltered"] = UNFILTERED * self._of_pixels([rendered], [ranks], least, step, ALL_PIXELS)
        if step % INTERVAL == 0:
            several = self._several(step)
            images = [self.drawing.channels(each, units) for each in several]
            maps = [self.ranks_of(each).flatten() for each in several]
            terms["multi"] = MULTI * self._of_pixels(images, maps, 1, step, SEVERAL_PIXELS, self.fixed)
        seeds = ((self.seed_classes > 0) & self._seen(view)).nonzero()[:, 0]
        chosen = seeds[self._chosen(len(seeds), step, SEEDS)]
        own = embedding(chosen, units)
        terms["space"] = SPACE * prototypes.prototype_loss(own, self.seed_classes[chosen], self.fixed)
        return terms

    @torch.no_grad()
    def finish(self) -> Membership:
        seeds = self.tracked.seeds if self.tracked is not None else ()
        masks, alone, without = {}, 0, 0
        for rank, class_id in enumerate(self.ranks.ids.tolist()):
            if class_id != 0 and rank < len(seeds):
                masks[class_id], similar = prototypes.members(self.features, seeds[rank], self.options.cosine)
                alone += bool(len(seeds[rank])) and not similar
                without += not len(seeds[rank])
        suspect = len(self.tracked.suspect) if self.tracked is not None else 0
        say(
            f"  tracking: {suspect} masks left out; {without} objects without seeds are empty, and {alone} "
            "consist of their seeds, as no Gaussian is similar"
        )
        return Membership.of_masks(masks, self.scene.class_ids())

    def state(self) -> dict[str, Any]:
        tracked = self.tracked
        state = {"features": self.features.detach(), "adam": self.adam.state_dict()}
        if tracked is not None:
            state |= {"seeds": list(tracked.seeds), "suspect": sorted(map(list, tracked.suspect))}
        return state

    def restore(self, state: dict[str, Any]) -> None:
        with torch.no_grad():
            self.features.copy_(state["features"])
        self.adam.load_state_dict(state["adam"])
        if "seeds" in state:
            seeds = tuple(each.to(self.features.device) for each in state["seeds"])
            self._take(mask_tracking.TrackedMasks(seeds, frozenset((view, rank) for view, rank in state["suspect"])))

    def _take(self, tracked: mask_tracking.TrackedMasks) -> None:
        self.tracked, self.seed_classes = tracked, tracked.seed_classes(len(self.drawing))

    @torch.no_grad()
    def _track(self) -> None:
        """Trace the Gaussians in all views and track the masks."""
        scene, inputs, count = self.scene, self.drawing.inputs, len(self.ranks)

        def trace(view: int) -> mask_tracking.TracedView:
            inputs_of_view = (inputs, scene.cameras[view], scene.settings, self.ranks_of(view))
            product = optional_products(scene.rasterizer).sparse_class_pixel_counts
            return mask_tracking.TracedView.of_counts(*product(*inputs_of_view, count, self.options.min_weight), count)

        with scene.stage("Tracing Gaussians") as progress:
            views = list(each_view(len(scene.cameras), trace, progress))
        with scene.stage("Tracking masks") as progress:
            options = self.options
            numbers = (len(self.drawing), count, options.min_gaussians, options.ground_votes)
            self._take(mask_tracking.tracked_masks(views, *numbers, progress))

    def _several(self, step: int) -> list[int]:
        """Return up to ``TOGETHER`` views in a row by name, without those that have no mask."""
        count = len(self.scene.cameras)
        most = min(TOGETHER, count)
        start = int(torch.randint(count - most + 1, (), generator=self.scene.generator(step, SEVERAL)))
        return [view for view in range(start, start + most) if view in set(self.masked)]

    def _chosen(self, count: int, step: int, purpose: int) -> Tensor:
        """Return ``samples`` random indices below ``count``, with replacement; none if ``count`` is 0."""
        number = self.options.samples if count else 0
        generator = self.scene.generator(step, purpose)
        return torch.randint(max(count, 1), (number,), generator=generator).to(self.features.device)

    def _of_pixels(
        self, images: list[Tensor], maps: list[Tensor], least: int, step: int, purpose: int, fixed: Tensor | None = None
    ) -> Tensor:
        """Return the loss of random pixels of all maps [P] with classes from ``least`` on; images: [P, C] each."""
        places = [((ranks >= least) & (ranks != IGNORE)).nonzero()[:, 0] for ranks in maps]
        chosen = self._chosen(sum(map(len, places)), step, purpose)
        features, classes, first = [], [], 0
        for image, ranks, own in zip(images, maps, places, strict=True):
            mine = own[chosen[(chosen >= first) & (chosen < first + len(own))] - first]
            features.append(embedding(mine, image))  # its gradient is the same for any number of threads
            classes.append(ranks[mine].long())
            first += len(own)
        if not features:
            return prototypes.prototype_loss(self.features[:0], self.seed_classes[:0])
        return prototypes.prototype_loss(torch.cat(features), torch.cat(classes), fixed)

    def _seen(self, view: int) -> Tensor:
        """Return [N] bool: the Gaussians that reach the image of a view."""
        if view not in self._visible:
            self._visible[view] = np.packbits(self.drawing.visible(view).cpu().numpy())
        bits = np.unpackbits(self._visible[view], count=len(self.drawing))
        return torch.from_numpy(bits.astype(bool)).to(self.features.device)
