"""Dr. Splat: each pixel gives the code of its mask to the Gaussians of largest weight on its ray; nothing is trained.

Kim Jun-Seong et al., "Dr. Splat: Directly Referring 3D Gaussian Splatting via Direct Language Embedding Registration",
CVPR 2025. The code of a mask is a language feature in the source, and here the unit vector e_c of its class. With C[i,
c] the sum of w_i over the pixels of class c where i is among the K largest of the first 100 on the ray,

    f_i = C_i / (||C_i||_2 + 1e-9),   r_i(c) = min over negatives n of sigmoid(10 (f_i . e_c - f_i . n)),

and i belongs to c iff r_i(c) > t. The negatives are the codes of all other classes, including the background; with
t = 1/2 a Gaussian then has the class that strictly exceeds all others, or none. Alternatively they are fixed texts,
which are orthogonal to codes of classes: f_i . n = 0, and objects overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from beags_plugin.assignment.contributions import Contributions, contributions
from beags_plugin.assignment.sparse_sums import largest_in_rows
from beags_plugin.core.membership import Membership
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import say

TOP_K = 45
"""Gaussians of largest weight on a ray that count."""
WITHIN = 100
"""First Gaussians of a ray, from which these are chosen."""
NEGATIVES = ("others", "zero")  # the first is the default
THRESHOLD = 0.5
SHARPNESS = 10.0


def margins(table: Contributions, negatives: str = NEGATIVES[0]) -> Tensor:
    """Return f_i . e_c - max_n f_i . n for each entry (i, c) of the table, [M] float64; it is at most 0 for others.

    table: C, with at least two columns.
    """
    rows = table.keys // table.columns
    norms = table.sums.new_zeros(table.count).index_add(0, rows, table.sums.square()).sqrt()
    values = table.sums / (norms[rows] + 1e-9)
    if negatives == "zero":
        return values
    first, top, _ = largest_in_rows(table.keys, values, table.count, table.columns)
    leads = first[rows] == table.keys % table.columns
    second = torch.zeros_like(top).scatter_reduce(0, rows[~leads], values[~leads], "amax")
    return values - torch.where(leads, second[rows], top[rows])


@dataclass(frozen=True)
class DrSplatRefiner(Refiner):
    """Takes objects out of the base by the codes of the strongest Gaussians of each ray; nothing is trained."""

    top_k: int = TOP_K
    """Strongest Gaussians of a ray that count."""
    within: int = WITHIN
    """First Gaussians of a ray, among which these are."""
    negatives: str = NEGATIVES[0]
    """Negatives: others, the other classes; or zero (bloated objects)."""
    threshold: float = THRESHOLD
    """Least activation, 0.5 or more."""

    def __post_init__(self) -> None:
        for name in ("top_k", "within"):
            if not 1 <= (value := getattr(self, name)) < 2**31:
                raise UserError(f"{name} is {value}: give a number of Gaussians, 1 or more.")
        check_choice(self.negatives, NEGATIVES, "choice of negatives")
        if not 0.5 <= self.threshold < 1.0:  # lower values would include Gaussians without weight in the class
            raise UserError(f"threshold is {self.threshold:g}: give an activation, from 0.5 to below 1.")

    def members(self, scene: AssignedScene) -> Membership:
        views = (scene.surfels, scene.cameras, scene.labels, scene.rasterizer, scene.settings, scene.num_classes)
        with scene.stage("Registering masks") as progress:
            strongest = optional_products(scene.rasterizer).sparse_top_contributions
            table = contributions(*views, progress, partial(strongest, most=self.top_k, within=self.within))
        whole = float(scene.contributions.sums.sum())
        beyond = 1.0 - float(table.sums.sum()) / whole if whole > 0 else 0.0
        say(f"  registration: {max(beyond, 0.0):.2%} of the weight lies beyond the {self.top_k} strongest of a ray")
        return self.of_table(table, scene.class_ids)

    def of_table(self, table: Contributions, class_ids: Tensor) -> Membership:
        """Return the objects. table: C, with class ids as columns. class_ids: [N] int32, phi."""
        bound = math.log(self.threshold / (1.0 - self.threshold)) / SHARPNESS
        chosen = table.keys[margins(table, self.negatives) > bound]  # r > t, without rounding at t = 1/2
        members, classes = chosen // table.columns, chosen % table.columns
        if self.negatives == "others":  # a Gaussian has at most one object
            labels = torch.zeros_like(class_ids)
            labels[members] = classes.int()
            return Membership(labels)
        masks = {}
        for class_id in torch.unique(classes[classes != 0]).tolist():
            masks[class_id] = torch.zeros_like(class_ids, dtype=torch.bool)
            masks[class_id][members[classes == class_id]] = True
        return Membership.of_masks(masks, class_ids)
