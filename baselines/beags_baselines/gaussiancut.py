"""GaussianCut as a refiner: a minimum cut of the Gaussians' graph for each object (``graph_cut``).

Differences from the source: the masks are those of the data in all training views, so that clicks, scribbles and the
tracking of masks over the views are left out; masks are not resized here, which the source does bilinearly, taking all
values above 0; pixels without a label, which the source does not have, enter no share. Each of several objects is cut
out against all else. For the cut see ``graph_cut``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from beags_baselines import graph_cut
from beags_plugin.core.membership import Membership
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class GaussianCutRefiner(Refiner):
    """Cuts every object out of the base against the rest; nothing is trained, and objects may overlap."""

    num_edges: int = graph_cut.NUM_EDGES
    """Nearest neighbours of a Gaussian in the graph."""
    foreground_threshold: float = graph_cut.FOREGROUND_THRESHOLD
    """Share that makes an example of the object; without examples it is empty."""

    def __post_init__(self) -> None:
        if self.num_edges < 1:
            raise UserError(f"num_edges is {self.num_edges}: give a number of neighbours, 1 or more.")
        if not 0.0 <= self.foreground_threshold <= 1.0:
            raise UserError(f"foreground_threshold is {self.foreground_threshold}: give a share, 0 to 1.")

    def members(self, scene: AssignedScene) -> Membership:
        means = scene.surfels.means / scene.scale  # the published decays are per unit of the input poses
        dc, total = scene.surfels.sh_dc, scene.contributions.total()
        links = graph_cut.n_links(means, dc, self.num_edges)
        masks = {}
        for class_id in scene.objects:
            share = torch.where(total > 0, scene.contributions.of(class_id) / total.clamp_min(1e-300), 0.0)
            masks[class_id] = graph_cut.members(means, dc, share, links, self.foreground_threshold)
        return Membership.of_masks(masks, scene.class_ids)
