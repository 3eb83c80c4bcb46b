"""OpenGaussian as a refiner: features of a frozen base, codebooks of them, and classes of their leaves.

Training has three stages (``instance_features``). In the first, a quarter of the steps, features learn to agree within
masks and to differ between them. In the second, also a quarter, k-means of features and positions makes ``coarse``
clusters; each is rendered with the feature of its centre, which is pulled towards the masks' means. In the third, one
cluster after the other is divided into leaves and trained in the same way, rendered alone. At the end each leaf is
rendered alone in every view and matched with a mask (``leaf_labels``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import log
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding

from beags_baselines import instance_features as parts
from beags_baselines import leaf_labels
from beags_baselines.isolated_render import FeatureTraining
from beags_plugin.core.membership import Membership
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import say

FULL_STEPS = 40_000
FASTEST = 10.0  # largest factor on the rates in short runs
RATES = (1e-3, 1e-4, 1e-3)  # learning rates of the features by stage
COARSE_INTERVAL, FINE_INTERVAL, TURN = 200, 50, 300  # steps of 40,000 between updates, and for each cluster
LEAST_SIZE = 1e-3  # least random factor on the sizes of Gaussians
SHOWS = 0.8  # largest alpha of a cluster or leaf rendered alone above which a view shows it
CLUSTER_SILHOUETTE, LEAF_SILHOUETTE = 0.9, 0.8  # alpha above which a pixel belongs to the silhouette
VIEWS, FEATURES, COARSE, FINE, SIZES = range(5)  # purposes of random numbers


@dataclass(frozen=True)
class OpenGaussianRefiner(Refiner):
    """Gives leaves of Gaussians the class of the masks that they resemble; a Gaussian has one class or none."""

    coarse: int = 64
    """Clusters."""
    fine: int = 10
    """The most leaves of a cluster."""
    position_weight: float = 0.5
    """Weight of positions beside features."""
    cohesion_weight: float = 0.1
    """Weight of agreement within masks."""
    exclude_dropped: bool = False
    """Leaves out masks whose features disagree."""
    min_gaussians: int = 100
    """Gaussians of a cluster that a view must show; small scenes need fewer."""
    max_scale: float = 0.5
    """Largest size of these Gaussians, units of the input poses."""
    rule: str = leaf_labels.RULES[0]
    """Rule of extraction: classes or query."""
    min_views: int = leaf_labels.MIN_VIEWS
    """Matches that a leaf needs."""
    min_leaf: int = leaf_labels.MIN_LEAF
    """Visible Gaussians of a leaf."""

    def __post_init__(self) -> None:
        check_choice(self.rule, leaf_labels.RULES, "rule of extraction")
        for name in ("coarse", "fine", "min_gaussians", "min_views", "min_leaf"):
            if (value := getattr(self, name)) < 1:
                raise UserError(f"{name} is {value}: give a number, 1 or more.")
        for name in ("position_weight", "cohesion_weight"):
            if not 0.0 <= (value := getattr(self, name)) < float("inf"):
                raise UserError(f"{name} is {value:g}: give a weight, 0 or more.")
        if not self.max_scale > 0.0:
            raise UserError(f"max_scale is {self.max_scale:g}: give a length above 0, or inf.")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return CodebookTraining(scene, self)


class CodebookTraining(FeatureTraining):
    """Trains a feature of each Gaussian; the scene stays fixed."""

    def __init__(self, scene: TrainedScene, options: OpenGaussianRefiner) -> None:
        count, device = len(scene.surfels().means), scene.surfels().means.device
        first = torch.rand(count, parts.CHANNELS, generator=scene.generator(0, FEATURES))
        super().__init__(scene, first, RATES[0], VIEWS)
        self.options = options
        self.starts = (0, scene.steps // 4, scene.steps // 2)  # first steps of the stages
        share = scene.steps / FULL_STEPS
        fine_steps = scene.steps - self.starts[2]
        self.turn_steps = min(TURN, max(fine_steps // options.coarse, 1))
        self.coarse_interval = max(round(COARSE_INTERVAL * min(share, 1.0)), 1)
        self.fine_interval = max(round(FINE_INTERVAL * self.turn_steps / TURN), 1)
        self.masks = parts.PseudoMasks.none(self.features)
        whole, (k1, k2) = torch.zeros(count, dtype=torch.int64, device=device), (options.coarse, options.fine)
        self.book = parts.Codebook(
            coarse=first.new_zeros(k1, parts.CHANNELS + 3, device=device),
            clusters=whole,
            fine=first.new_zeros(k1, k2, parts.CHANNELS, device=device),
            leaves=torch.full_like(whole, k1 * k2),
            used=whole.new_ones(k1),
            occurs=whole.new_zeros(len(scene.cameras), k1).bool(),
        )

    def stage(self, step: int) -> int:
        """Return the stage of a step, 0 to 2."""
        return sum(step >= start for start in self.starts) - 1

    def before_step(self, step: int) -> Edit | None:
        self.adam.param_groups[0]["lr"] = min(FULL_STEPS / self.scene.steps, FASTEST) * RATES[self.stage(step)]
        self.adam.zero_grad()
        book, (_, second, third) = self.book, self.starts
        if step == second:
            self._take_pseudo_masks()
            generator = self.scene.generator(step, COARSE)
            book.coarse = parts.first_centres(self._vectors(), self.options.coarse, generator)
        if step == second or (second < step < third and (step - second) % self.coarse_interval == 0):
            book.coarse, book.clusters = parts.lloyd(self._vectors(), book.coarse)
        if step == third:
            self._begin_leaves(self.scene.generator(step, FINE))
        if step >= third:
            place, cluster = self._turn(step)
            if place % self.fine_interval == 0:
                self._update_leaves(cluster)
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        if not self.masked:
            return {}
        view, stage, size = self.view_of(step), self.stage(step), self._size(step)
        masks, labels = self._masks(view), self.masks.of(view)
        if stage == 0:
            return self._first_terms(view, masks, late=2 * step >= self.starts[1])
        book, options, own = self.book, self.options, None
        if stage == 1:
            centres = book.coarse[:, : parts.CHANNELS][book.clusters]
        else:
            _, cluster = self._turn(step)
            own = (book.clusters == cluster).nonzero()[:, 0]
            if not bool(book.occurs[view, cluster]) or len(own) == 0:
                return {}
            centres = book.fine.flatten(0, 1)[book.leaves[own]]
        features = self.features if own is None else embedding(own, self.features)
        quantised = parts.drawn_form(parts.straight_through(features, centres))
        rendered, alpha = self.drawing.draw(view, quantised, own, size)
        if own is not None and not bool((alpha > SHOWS).any()):
            return {}
        loss = parts.label_loss(rendered, alpha, masks, labels, own is not None, options.exclude_dropped)
        return {"clusters" if own is None else "leaves": loss}

    def _first_terms(self, view: int, masks: parts.MaskedPixels, late: bool) -> Terms:
        rendered, alpha = self.drawing.draw(view, parts.drawn_form(self.features))
        means = masks.means(rendered, alpha > parts.SOLID)
        close = parts.cohesion(rendered, means, masks)
        return {"cohesion": self.options.cohesion_weight * close, "separation": parts.separation(means, late)}

    def _size(self, step: int) -> float:
        """Return the factor on the sizes of all Gaussians in a step: 1 in half of the steps."""
        shrinks, factor = torch.rand(2, generator=self.scene.generator(step, SIZES)).tolist()
        return max(factor, LEAST_SIZE) if shrinks < 0.5 else 1.0

    def _turn(self, step: int) -> tuple[int, int]:
        """Return the step's place within the turn of a cluster, and the cluster."""
        turns, place = divmod(step - self.starts[2], self.turn_steps)
        return place, turns % self.options.coarse

    def _masks(self, view: int) -> parts.MaskedPixels:
        return parts.MaskedPixels.of(self.ranks_of(view))

    def _vectors(self) -> Tensor:
        """Return [N, 9]: features and weighted positions, in units of the input poses."""
        positions = self.drawing.inputs.means * (self.options.position_weight / self.scene.scale)
        return torch.cat([self.features.detach(), positions], dim=1)

    @torch.no_grad()
    def _take_pseudo_masks(self) -> None:
        masks, features = [], parts.drawn_form(self.features)
        with self.scene.stage("Averaging features") as progress:
            for done, view in enumerate(self.masked, start=1):
                rendered, _ = self.drawing.draw(view, features)
                masks.append(parts.PseudoMasks.of_view(view, rendered, self._masks(view)))
                progress(done, len(self.masked))
        self.masks = parts.PseudoMasks.joined(masks) if masks else self.masks

    @torch.no_grad()
    def _begin_leaves(self, generator: torch.Generator) -> None:
        """Find the views that show each cluster and its number of leaves; choose centres from the whole scene."""
        self._take_pseudo_masks()
        book, options, drawing = self.book, self.options, self.drawing
        largest = drawing.inputs.log_scales.max(dim=1).values
        small = largest < log(options.max_scale * self.scene.scale)
        features, seen = parts.drawn_form(self.features), torch.zeros_like(book.used)
        with self.scene.stage("Counting leaves") as progress:
            for done, view in enumerate(self.masked, start=1):
                usable = small & drawing.visible(view)
                masks, labels = self._masks(view), self.masks.of(view)
                counts = torch.bincount(book.clusters[usable], minlength=options.coarse)
                for cluster in (counts >= options.min_gaussians).nonzero()[:, 0].tolist():
                    own = (usable & (book.clusters == cluster)).nonzero()[:, 0]
                    rendered, alpha = drawing.draw(view, features[own], own)
                    if bool((alpha > SHOWS).any()):
                        leaves = parts.fine_clusters(rendered, alpha > CLUSTER_SILHOUETTE, masks, labels)
                        book.occurs[view, cluster] = leaves > 0
                        seen[cluster] = max(int(seen[cluster]), leaves)
                progress(done, len(self.masked))
        book.used = (seen.clamp_min(1) + 1).clamp_max(options.fine)
        chosen = torch.randint(len(drawing), (options.coarse * options.fine,), generator=generator)
        book.fine = self.features.detach()[chosen.to(features.device)].view(options.coarse, options.fine, -1)

    def _update_leaves(self, cluster: int) -> None:
        book, used = self.book, int(self.book.used[cluster])
        own = (book.clusters == cluster).nonzero()[:, 0]
        if len(own):
            book.fine[cluster, :used], local = parts.lloyd(self.features.detach()[own], book.fine[cluster, :used])
            book.leaves[own] = cluster * self.options.fine + local

    @torch.no_grad()
    def finish(self) -> Membership:
        options, leaves, votes = self.options, self.book.leaves, self._votes()
        class_ids = torch.zeros_like(self.scene.class_ids())
        if options.rule == "classes":
            # The last entry stands for Gaussians in no leaf.
            table = class_ids.new_zeros(options.coarse * options.fine + 1)
            named = leaf_labels.classes_of_leaves(votes, options.min_views)
            for leaf, rank in named.items():
                table[leaf] = self.ranks.ids[rank]
            inside = float(torch.isin(leaves, leaves.new_tensor(list(named))).double().mean())
            like = f"{len(named)} of {len(torch.unique(leaves))} resemble a mask in {options.min_views} views or more"
            say(f"  leaves: {like}; they hold {inside:.0%} of the Gaussians; the others have no class")
            return Membership(table[leaves])
        masks, surfels, centres = {}, self.scene.surfels().detach(), self.book.fine.flatten(0, 1)
        for rank, class_id in enumerate(self.ranks.ids.tolist()):
            if class_id != 0:
                wanted = leaf_labels.queried_leaves(votes, rank, centres, options.fine)
                chosen = torch.isin(leaves, leaves.new_tensor(wanted))
                masks[class_id] = leaf_labels.queried_object(surfels, chosen, self.scene.scale, options.min_gaussians)
        return Membership.of_masks(masks, class_ids)

    def _votes(self) -> leaf_labels.Votes:
        """Render every leaf alone in every view that shows its cluster; return the classes of matching masks."""
        book, drawing, options = self.book, self.drawing, self.options
        features, votes = parts.drawn_form(self.features), {}
        with self.scene.stage("Matching leaves") as progress:
            for done, view in enumerate(self.masked, start=1):
                visible, masks, labels = drawing.visible(view), self._masks(view), self.masks.of(view)
                counts = torch.bincount(book.leaves[visible], minlength=options.coarse * options.fine + 1)[:-1]
                occurs = book.occurs[view].repeat_interleave(options.fine)
                for leaf in ((counts >= options.min_leaf) & occurs).nonzero()[:, 0].tolist():
                    own = (book.leaves == leaf).nonzero()[:, 0]
                    rendered, alpha = drawing.draw(view, features[own], own)
                    place = parts.matched_mask(rendered, alpha > LEAF_SILHOUETTE, masks, labels)
                    if place is not None:
                        votes.setdefault(leaf, Counter())[int(masks.classes[place])] += 1
                progress(done, len(self.masked))
        return votes

    def state(self) -> dict[str, Any]:
        return {
            "features": self.features.detach(),
            "adam": self.adam.state_dict(),
            "masks": dict(vars(self.masks)),
            "book": dict(vars(self.book)),
        }

    def restore(self, state: dict[str, Any]) -> None:
        device = self.features.device
        with torch.no_grad():
            self.features.copy_(state["features"])
        self.adam.load_state_dict(state["adam"])
        self.masks = parts.PseudoMasks(**{name: values.to(device) for name, values in state["masks"].items()})
        self.book = parts.Codebook(**{name: values.to(device) for name, values in state["book"].items()})
