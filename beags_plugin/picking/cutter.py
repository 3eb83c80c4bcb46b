"""Cut an object out of a trained scene: choose its Gaussians from a few prompts.

After GaussianCut (Jain, Mirzaei, Gilitschenski, "GaussianCut: Interactive Segmentation via Graph Cut for 3D Gaussian
Splatting", NeurIPS 2024), which also cuts a graph of the Gaussians, but takes the object from masks of many views.
Here a few marks spread over the surface: with p and the level t of ``walk.Walker`` and the weights of ``graph``, the
object minimises

    E = sum_{i in object} [a_i]- + sum_{i not in it} [a_i]+ + sum_{links between both} w_ij,
    a_i = 0.3 (logit p_i - logit t + g),

where g is the growth that the user asks for. A Gaussian that a mark shows, or that is excluded, is bound to its side.
Marks beside the object have two more effects: walks end more often on the tangent planes of what they show (such as the
floor in the hole of a ring, which no walk reaches), and p is 0 where a walk is more likely to meet them than marks on
the object. Marks on other objects have neither effect: the object's walks end there, but walks from marks beside it
pass, as a Gaussian nearer to another object's mark may still belong to this object.
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
from beags_plugin.core.lifting import pixels_of
from beags_plugin.core.minimum_cut import cut
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.picking.graph import surface_graph
from beags_plugin.picking.sight import seen_from
from beags_plugin.picking.walk import Walker, least_size
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

# A mark shows a Gaussian that gives at least LEAST_SHARE of the mark's light; if none does, those that give at least
# LEAST_OF_LARGEST of the largest share, and at least LEAST_LIGHT.
LEAST_SHARE, LEAST_OF_LARGEST, LEAST_LIGHT = 0.1, 0.5, 0.02
LEAST_OWN = 0.5  # least share of that light from Gaussians that no mark of the other kind shows better
BELIEF = 0.3  # weight of logit p, beside links of at most 1
BOUND = 1e3  # more than the sum of all links of a Gaussian
NOTHING = -30.0  # logit of an invisible opacity
MUCH = 0.5  # share of the scene above which a cut is reported as large
LIMIT = 1e-6  # bound of p that keeps its logit finite


def takes_much(members: Tensor) -> str | None:
    """Return a note on a cut, [N] bool, that takes more than half of a scene, or None."""
    share = float(members.double().mean())
    if share <= MUCH:
        return None
    percent = math.ceil(100.0 * share - 1e-9)
    return f"more than half of the scene ({percent}%): if that is too much, mark what is beside it or draw a box"


def takes_little(members: Tensor) -> str | None:
    """Return a note on a cut, [N] bool, that takes little more than its points, or None."""
    count = int(members.sum())
    if count >= least_size(len(members)):
        return None
    return "little more than the points themselves: click on other parts of the object too, or press Grow"


@dataclass(frozen=True)
class ViewMarks:
    """A user's marks in one view without lens distortion.

    name: of the view, for errors. numbers: [h, w] int32, the number of the mark at a marked pixel, else IGNORE. inside:
    for each mark, whether it lies on the object. within: [h, w] bool, False outside the user's box, or None without a
    box. of_others: whether the marks lie on other objects, and so all beside this one. drawn: [N] bool, the Gaussians
    that the view shows, or None for all.
    """

    name: str
    camera: Camera
    numbers: Tensor
    inside: tuple[bool, ...]
    within: Tensor | None = None
    of_others: bool = False
    drawn: Tensor | None = None


class Cutter:
    """Cuts objects out of one scene; the graph that all cuts share is built once.

    surfels: N Gaussians. cameras: of the training views. progress: receives (done, total) views.
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
        """Return which Gaussians belong to the object, [N] bool on the CPU; earlier calls do not matter.

        excluded: [N] bool, Gaussians that do not belong to it, or None. name: of the object, for errors. growth: g; a
        larger one adds Gaussians, a negative one removes some. part: whether the object must be less than all
        Gaussians that are neither excluded nor outside a box. Raises ``UserError`` if no mark lies on the object or on
        a Gaussian, if marks contradict each other, or if the object has no Gaussian or all of them.
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
        with ThreadPoolExecutor() as threads:  # both walks run at once, as their products hold no lock
            walk = threads.submit(self._walker.potential, inside, beside, barred, behind)
            nearer = self._walker.potential(ground, inside, barred, np.zeros_like(behind)) if ground.any() else 0.0
            p = walk.result()
        p[nearer > p] = 0.0
        ends = self._graph.first, self._graph.second
        weights = np.where(barred[ends[0]] | barred[ends[1]], 0.0, self._graph.weights)
        level = self._walker.border_level(p, weights, part)
        side = self._minimum(p, level, growth, weights, inside, beside | barred)
        if side.all():
            raise UserError(f"the cut of {name} takes the whole scene: mark points beside it, or draw a box about it.")
        members = side[self._graph.nearest] & ~outside
        if not members.any():
            raise UserError(f"the cut of {name} takes nothing: mark points on it that no box or limit leaves out.")
        return torch.from_numpy(members)

    def outside(self, marks: Sequence[ViewMarks]) -> Tensor:
        """Return which Gaussians lie outside a box of the marks, [N] bool on the CPU."""
        outside = np.zeros(len(self._inputs.means), dtype=bool)
        for view in marks:
            if view.within is not None:
                outside |= ~self._shown_within(view)
        return torch.from_numpy(outside)

    def shown_share(self, view: ViewMarks, among: Tensor) -> float:
        """Return the share of the light of a view's marks that Gaussians ``among`` [N] bool give; 0 without light."""
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
        """Return which nodes the cut gives to the object, [M] bool; ``inside`` and ``beside`` are bound."""
        p, t = p.clip(LIMIT, 1.0 - LIMIT), min(max(level, LIMIT), 1.0 - LIMIT)
        belief = BELIEF * (np.log(p / (1.0 - p)) - np.log(t / (1.0 - t)) + growth)
        belief[inside], belief[beside] = BOUND, -BOUND
        terminals = torch.from_numpy(np.stack([belief.clip(0.0), (-belief).clip(0.0)], axis=1))
        return cut(self._pairs, torch.from_numpy(weights), terminals).numpy()

    def _bound(
        self, marks: Sequence[ViewMarks], excluded: np.ndarray, name: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nodes bound to the object, those bound to the rest, and the ground; each [M] bool.

        The first two are disjoint: a node is bound to the kind of mark of which it gives the larger share of the light.
        The ground are nodes of the rest shown by marks that do not lie on other objects.
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
        if view.drawn is not None:  # an invisible Gaussian stops no light
            unseen = ~view.drawn.to(inputs.means.device)
            inputs = replace(inputs, opacity_logits=inputs.opacity_logits.masked_fill(unseen, NOTHING))
        numbers = view.numbers.to(inputs.means.device)  # marks come from the CPU
        with torch.no_grad():
            keys, weights = self._rasterizer.sparse_class_contributions(
                inputs, view.camera, self._settings, numbers, count
            )
        pixels = torch.bincount(view.numbers[view.numbers != IGNORE].long(), minlength=count).double().cpu().numpy()
        light = np.zeros((count, len(self._inputs.means)))
        index = keys.cpu().numpy()
        light[index % count, index // count] = weights.double().cpu().numpy()
        return light[:, self._graph.nodes] / pixels.clip(1)[:, None]

    def _shown_within(self, view: ViewMarks) -> np.ndarray:
        """Return which Gaussians have their centre in front of the camera and in the view's box, [N] bool."""
        assert view.within is not None
        shown, row, column, _ = pixels_of(self._inputs.means.double().cpu(), view.camera.host)
        return (shown & view.within.cpu()[row, column]).numpy()
