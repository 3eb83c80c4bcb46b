"""The cut: which Gaussians of a trained scene belong to an object that a few prompts point at.

After GaussianCut (Jain, Mirzaei, Gilitschenski, "GaussianCut: Interactive Segmentation via Graph Cut for 3D Gaussian
Splatting", NeurIPS 2024), which cuts a graph of the Gaussians too, but knows the object from masks of many views. Here
a few marks reach over the surface: with p of ``walk.Walker``, its level t and the weights of ``graph``, the object
minimises

    E = sum_{i in object} [a_i]- + sum_{i not in it} [a_i]+ + sum_{links between both} w_ij,
    a_i = 0.3 (logit p_i - logit t + g),

where g is how much it shall grow, and a Gaussian that a mark shows, or that is excluded, is bound to its side. Walks
end more often on the tangent planes of what marks show beside the object (a floor goes on in a ring's hole, which no
walk reaches), and p is 0 where a walk meets marks beside the object more surely than those on it. Neither holds for
marks on other objects: the object's walks end there, those from marks beside it pass, as what marks on other objects
meet more surely may still be this object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.minimum_cut import cut
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.picking.graph import surface_graph
from beags_plugin.picking.sight import seen_from
from beags_plugin.picking.walk import Walker
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

LEAST_SHARE = 0.1  # of the light of a mark: a Gaussian that gives less is not what the mark shows,
LEAST_OF_LARGEST = 0.5  # but if none gives so much, those that give half of the most,
LEAST_LIGHT = 0.02  # unless it is next to nothing
LEAST_OWN = 0.5  # of that light from Gaussians which no mark of the other kind shows better
BELIEF = 0.3  # of the logit of p, beside links of at most 1
BOUND = 1e3  # more than all links of a Gaussian can be worth
NOTHING = -30.0  # logit of an opacity that no picture shows
MUCH = 0.5  # of the scene: a cut that takes more may be right, but is said
LITTLE, FEW = 0.002, 100  # of the scene, and Gaussians: a cut that takes less of both is said too
LIMIT = 1e-6  # of p, so that its logit is finite


def takes_much(members: Tensor) -> str | None:
    """Return what to say of a cut, [N] bool, that takes more than half of a scene, or None."""
    share = float(members.double().mean())
    if share <= MUCH:
        return None
    percent = math.ceil(100.0 * share - 1e-9)
    return f"more than half of the scene ({percent}%): if that is too much, mark what is beside it or draw a box"


def takes_little(members: Tensor) -> str | None:
    """Return what to say of a cut, [N] bool, that has hardly left its points, or None."""
    count = int(members.sum())
    if count >= min(FEW, LITTLE * len(members)):
        return None
    return "little more than the points themselves: click on other parts of the object too, or press Grow"


@dataclass(frozen=True)
class ViewMarks:
    """What a user has marked in one view without lens distortion.

    name: of the view, for errors. numbers: [h, w] int32, at a marked pixel the number of its mark, else IGNORE.
    inside: per mark whether it lies on the object. within: [h, w] bool, False where a box says that the object is not,
    or None. of_others: whether the marks lie on other objects, and so all beside this one. drawn: [N] bool, the
    Gaussians that the view shows, or None for all.
    """

    name: str
    camera: Camera
    numbers: Tensor
    inside: tuple[bool, ...]
    within: Tensor | None = None
    of_others: bool = False
    drawn: Tensor | None = None


class Cutter:
    """Cuts objects out of one scene; what the cuts share is made once.

    surfels: N Gaussians. cameras: the views that have seen the scene. progress: receives (done, total) of them.
    """

    def __init__(
        self,
        surfels: Surfels,
        cameras: Sequence[Camera],
        rasterizer: Rasterizer,
        settings: RasterSettings,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._inputs = geometry_inputs(surfels)
        self._rasterizer = rasterizer
        self._settings = replace(settings, geometry=False, distortion=False)
        seen, normals = seen_from(surfels, cameras, rasterizer, settings, progress)
        self._graph = surface_graph(surfels, seen, normals)
        self._pairs = torch.from_numpy(np.stack([self._graph.first, self._graph.second], axis=1))
        self._walker = Walker(self._graph)

    def solve(
        self,
        marks: Sequence[ViewMarks],
        excluded: Tensor | None = None,
        name: str = "the object",
        growth: float = 0.0,
        part: bool = False,
    ) -> Tensor:
        """Return which Gaussians belong to the object, [N] bool on the CPU; the same whatever was solved before.

        excluded: [N] bool, Gaussians that do not, or None. name: of the object, for errors. growth: g; a larger one
        takes the same Gaussians and more, a negative one fewer. part: whether the object is not all of what is neither
        excluded nor outside of a box. Raises ``UserError`` if no mark lies on the object or on a Gaussian, if marks
        contradict one another, or if no Gaussian belongs to it, or all do.
        """
        if not any(inside for view in marks for inside in view.inside):
            raise UserError(f"no point lies on {name}: give at least one in a view that shows it.")
        nodes = self._graph.nodes
        outside = self.outside(marks).numpy()
        if excluded is not None:
            outside |= excluded.cpu().numpy()
        barred = outside[nodes]
        inside, beside, ground = self._bound(marks, barred, name)
        behind = self._graph.on_plane_of(ground) & ~self._graph.on_plane_of(inside)
        with ThreadPoolExecutor() as threads:  # both walks at once: their products hold no lock
            walk = threads.submit(self._walker.potential, inside, beside, barred, behind)
            nearer = self._walker.potential(ground, inside, barred, np.zeros_like(behind)) if ground.any() else 0.0
            p = walk.result()
        p[nearer > p] = 0.0
        ends = self._graph.first, self._graph.second
        weights = np.where(barred[ends[0]] | barred[ends[1]], 0.0, self._graph.weights)
        level = self._walker.border_level(p, weights, part)
        found = self._minimum(p, level, growth, weights, inside, beside | barred)
        if found.all():
            raise UserError(f"the cut of {name} takes the whole scene: mark points beside it, or draw a box about it.")
        members = found[self._graph.nearest] & ~outside
        if not members.any():
            raise UserError(f"the cut of {name} takes nothing: mark points on it that no box or limit leaves out.")
        return torch.from_numpy(members)

    def outside(self, marks: Sequence[ViewMarks]) -> Tensor:
        """Return which Gaussians lie outside of a box of the marks, [N] bool on the CPU."""
        found = np.zeros(len(self._inputs.means), dtype=bool)
        for view in marks:
            if view.within is not None:
                found |= ~self._shown_within(view)
        return torch.from_numpy(found)

    def shown_share(self, view: ViewMarks, among: Tensor) -> float:
        """Return the share of the light of a view's marks that comes from Gaussians ``among`` [N] bool; 0 without."""
        light = self._shares(view).sum(axis=0)
        return float(light[among.cpu().numpy()[self._graph.nodes]].sum() / max(light.sum(), 1e-12))

    def _minimum(
        self,
        p: np.ndarray,
        level: float,
        growth: float,
        weights: np.ndarray,
        inside: np.ndarray,
        beside: np.ndarray,
    ) -> np.ndarray:
        """Return the side of the object, [M] bool; ``inside`` and ``beside`` are bound to theirs."""
        p, t = p.clip(LIMIT, 1.0 - LIMIT), min(max(level, LIMIT), 1.0 - LIMIT)
        belief = BELIEF * (np.log(p / (1.0 - p)) - np.log(t / (1.0 - t)) + growth)
        belief[inside], belief[beside] = BOUND, -BOUND
        terminals = torch.from_numpy(np.stack([belief.clip(0.0), (-belief).clip(0.0)], axis=1))
        return cut(self._pairs, torch.from_numpy(weights), terminals).numpy()

    def _bound(
        self, marks: Sequence[ViewMarks], excluded: np.ndarray, name: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nodes that the marks bind to the object and to the rest, disjoint [M] bool.

        Third come those bound to the rest that marks which lie on no other object show.

        A Gaussian belongs to the kind of mark of which it gives the larger share of the light.
        """
        shares = np.zeros((2, len(excluded)))
        ground = np.zeros_like(excluded)
        by_mark: list[tuple[str, bool, np.ndarray]] = []
        for view in marks:
            for inside, share in zip(view.inside, self._shares(view), strict=True):
                largest = share.max(initial=0.0)
                shown = share >= max(min(LEAST_SHARE, LEAST_OF_LARGEST * largest), LEAST_LIGHT)
                shares[int(inside)] = np.maximum(shares[int(inside)], np.where(shown, share, 0.0))
                by_mark.append((view.name, inside, np.where(shown, share, 0.0)))
                ground |= shown & (not inside and not view.of_others)
        on_object = shares[1] > shares[0]
        beside = (shares[0] >= shares[1]) & (shares[0] > 0)
        for view, inside, light in by_mark:
            where = f"a point {'on' if inside else 'beside'} {name} in {view}"
            if inside and not light.any():
                raise UserError(f"{where} shows nothing of the scene: move it onto the object.")
            if inside and excluded[light > 0].all():
                raise UserError(f"{where} lies outside a box or another limit of it: correct one of them.")
            if light[on_object if inside else beside].sum() < LEAST_OWN * light.sum():
                raise UserError(f"{where} contradicts another point at the same place: remove one of them.")
        beside &= ~excluded
        return on_object & ~excluded, beside, beside & ground

    def _shares(self, view: ViewMarks) -> np.ndarray:
        """Return the share of each mark's light that each node gives, [marks, M] float64."""
        count, inputs = len(view.inside), self._inputs
        if count == 0:
            return np.zeros((0, len(self._graph.nodes)))
        if view.drawn is not None:  # what cannot be seen stops no light
            unseen = ~view.drawn.to(inputs.means.device)
            inputs = replace(inputs, opacity_logits=inputs.opacity_logits.masked_fill(unseen, NOTHING))
        numbers = view.numbers.to(inputs.means.device)  # marks are made on the CPU
        with torch.no_grad():
            keys, weights = self._rasterizer.sparse_class_contributions(
                inputs, view.camera, self._settings, numbers, count
            )
        pixels = torch.bincount(view.numbers[view.numbers != IGNORE].long(), minlength=count).double().cpu().numpy()
        found = np.zeros((count, len(self._inputs.means)))
        index = keys.cpu().numpy()
        found[index % count, index // count] = weights.double().cpu().numpy()
        return found[:, self._graph.nodes] / pixels.clip(1)[:, None]

    def _shown_within(self, view: ViewMarks) -> np.ndarray:
        """Return which Gaussians have their centre before the camera and in the view's box, [N] bool."""
        assert view.within is not None
        camera = view.camera.host
        means = self._inputs.means.double().cpu()
        local = means @ camera.rotation.double().T + camera.translation.double()
        projected = local @ camera.K.double().T
        depth = projected[:, 2]
        pixel = torch.nan_to_num(projected[:, :2] / depth[:, None], nan=-1.0, posinf=-1.0, neginf=-1.0).floor()
        column, row = pixel[:, 0], pixel[:, 1]
        shown = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        found = torch.zeros(len(means), dtype=torch.bool)
        found[shown] = view.within.cpu()[row[shown].long(), column[shown].long()]
        return found.numpy()
