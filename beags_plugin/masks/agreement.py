"""Masks of all views that agree in space: one decision per Gaussian, from which the masks are drawn anew.

A vote per pixel cannot mend what a third of the views have wrong together. Here a view that contradicts the others
loses its say, and the classes of Gaussians are a minimum cut of the surface's graph, as in ``cutter``. With the light
L_vic that Gaussian i gives to the pixels of view v that its mask calls c, and the say a_v of the view,

    S_ic = sum_v a_v L_vic,   p_ic = S_ic / (sum_c' S_ic' + 1),   c_i = argmax_c S_ic,
    e_v = sum_{i, c != c_i} L_vic / sum_{i, c or c_i an object} L_vic,   a_v = 1 / (1 + (e_v / median e)^2),

and 0 where e_v exceeds ``SILENT``; a few rounds settle both. A view that shows no object starts without a say: the
network found nothing there, which does not mean that nothing is there. Each object's cut has the unary terms
0.3 logit p_ic beside the links of ``graph``, which cut along creases, depth edges and changes of colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.minimum_cut import cut
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.snapping import snap_to_edges
from beags_plugin.picking.graph import SurfaceGraph, surface_graph
from beags_plugin.picking.sight import seen_from
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs

ROUNDS = 4  # The views are weighed, and the votes by them, so many times.
LEAST_ERROR = 0.02  # of the median e: outlines alone make as much, so that it sets no view apart
SILENT = 0.5  # of e: a mask that is more wrong than right has no say, and is drawn anew from the other views
CONTRADICTS = 1.5  # of the usual e: a mask that errs less keeps all its pixels, as Gaussians are coarser than photos
BELIEF, LIMIT = 0.3, 0.02  # of the logit of p beside links of at most 1; of p, so that its logit is finite
NO_VOTE = 0.4  # of a pixel, for the object: where nothing votes, a Gaussian is rather not the object's
SURE = 0.15  # of |p - 1/2|: the votes alone decide, else the cut does
DRAWN = 0.5  # share of a pixel's light from which on it shows a class

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Agreement:
    """The decisions on N Gaussians by the masks of V views.

    class_ids: [N] int32. sure: [N] bool, where the votes say clearly what the cut says. errors: [V] float64, e_v; NaN
    without a mask. say: [V] float64, a_v; 0 for a view that has lost its say or shows no object. light: [N] float64, of
    all classes, by the say of the views.
    """

    class_ids: Tensor
    sure: Tensor
    errors: np.ndarray
    say: np.ndarray
    light: np.ndarray

    @property
    def contradicted(self) -> list[int]:
        """Return the views whose masks the others contradict more than is usual, ascending."""
        return [int(view) for view in np.flatnonzero(self.errors > CONTRADICTS * usual(self.errors))]

    @property
    def silenced(self) -> list[int]:
        """Return the views whose masks are not believed at all, ascending; those without a mask are not among them."""
        return [int(view) for view in np.flatnonzero((self.say == 0) & ~np.isnan(self.errors))]


@dataclass(frozen=True)
class AgreedMask:
    """The labels of a view [H, W] int32 after agreement: class ids or IGNORE. changed, doubtful: [H, W] bool, pixels
    whose class is another than given, and pixels left unlabelled because neither side is sure."""

    labels: Tensor
    changed: Tensor
    doubtful: Tensor


def decide(
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    progress: Progress | None = None,
) -> Agreement:
    """Return the class of each of N Gaussians, from masks that may contradict one another.

    labels: per camera [H, W] int32 class ids below ``num_classes`` or IGNORE, or None. progress: receives (done, total)
    views.
    """
    steps = None if progress is None else (lambda done, _: progress(done, len(labels)))
    seen, normals = seen_from(surfels, cameras, rasterizer, settings)
    graph = surface_graph(surfels, seen, normals)
    votes = _Votes(surfels, cameras, labels, rasterizer, settings, num_classes, steps)
    say, errors = votes.say_from_start(), np.full(len(labels), np.nan)
    for _ in range(ROUNDS):
        errors = votes.errors(votes.sums(say))
        say = votes.say(errors)
    sums = votes.sums(say)
    total = sums.sum(axis=1)
    share = sums / np.maximum(total, 1e-12)[:, None]
    claims = np.stack([_claimed(graph, sums[:, c], total) for c in range(1, num_classes)], axis=1)
    class_ids = np.where(claims.any(axis=1), np.where(claims, share[:, 1:], -1.0).argmax(axis=1) + 1, BACKGROUND)
    own = np.take_along_axis(sums, class_ids[:, None], axis=1)[:, 0]
    sure = own / np.maximum(total + 1.0, 1.0) > 0.5 + SURE
    return Agreement(torch.from_numpy(class_ids.astype(np.int32)), torch.from_numpy(sure), errors, say, total)


def _claimed(graph: SurfaceGraph, of_object: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Return which of N Gaussians the cut gives to an object, [N] bool; of_object, total: [N] votes."""
    p = ((of_object + NO_VOTE) / (total + 1.0))[graph.nodes].clip(LIMIT, 1.0 - LIMIT)
    belief = BELIEF * np.log(p / (1.0 - p))
    terminals = torch.from_numpy(np.stack([belief.clip(0.0), (-belief).clip(0.0)], axis=1))
    pairs = torch.from_numpy(np.stack([graph.first, graph.second], axis=1))
    inside = cut(pairs, torch.from_numpy(graph.weights), terminals).numpy()
    return inside[graph.nearest] if len(inside) else np.zeros(len(graph.nearest), dtype=bool)


def usual(errors: np.ndarray) -> float:
    """Return the median of the errors [V] of masks that have one and are not silent, ``LEAST_ERROR`` at least."""
    heard = errors[errors <= SILENT]
    return max(float(np.median(heard)) if len(heard) else 0.0, LEAST_ERROR)


class _Votes:
    """L of the module's docstring, sparse, view by view."""

    def __init__(self, surfels, cameras, labels, rasterizer, settings, num_classes: int, progress) -> None:
        inputs = geometry_inputs(surfels)
        settings = replace(settings, geometry=False, distortion=False)
        self._count, self._classes = len(surfels), num_classes
        self._views: list[tuple[np.ndarray, np.ndarray] | None] = []
        for index, (camera, mask) in enumerate(zip(cameras, labels, strict=True)):
            if mask is None:
                self._views.append(None)
            else:
                with torch.no_grad():
                    keys, light = rasterizer.sparse_class_contributions(inputs, camera, settings, mask, num_classes)
                self._views.append((keys.cpu().numpy(), light.float().cpu().numpy()))
            if progress is not None:
                progress(index + 1, len(labels))

    def say_from_start(self) -> np.ndarray:
        """Return 1 for each view whose mask shows an object, else 0; [V] float64."""
        shows = [found is not None and bool((found[0] % self._classes != BACKGROUND).any()) for found in self._views]
        return np.array(shows, np.float64)

    def sums(self, say: np.ndarray) -> np.ndarray:
        """Return S, [N, C] float64."""
        total = np.zeros(self._count * self._classes)
        for weight, found in zip(say, self._views, strict=True):
            if found is not None and weight > 0:
                total[found[0]] += weight * found[1]
        return total.reshape(self._count, self._classes)

    def errors(self, sums: np.ndarray) -> np.ndarray:
        """Return e, [V] float64; NaN for a view without a mask, and 0 where neither it nor the others see an object."""
        agreed, known = sums.argmax(axis=1), sums.sum(axis=1) > 0
        errors = np.full(len(self._views), np.nan)
        for view, found in enumerate(self._views):
            if found is None:
                continue
            gaussians, classes = found[0] // self._classes, found[0] % self._classes
            of_objects = known[gaussians] & ((classes != BACKGROUND) | (agreed[gaussians] != BACKGROUND))
            wrong = of_objects & (classes != agreed[gaussians])
            errors[view] = float(found[1][wrong].sum()) / max(float(found[1][of_objects].sum()), 1e-12)
        return errors

    def say(self, errors: np.ndarray) -> np.ndarray:
        """Return a, [V] float64."""
        shows = self.say_from_start() > 0
        say = 1.0 / (1.0 + (np.nan_to_num(errors) / usual(errors)) ** 2)
        return np.where(shows & (np.nan_to_num(errors) <= SILENT), say, 0.0)


def agreed_masks(
    agreement: Agreement,
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    reach: int = 1,
    photos: Sequence[Callable[[], np.ndarray]] | None = None,
) -> Iterator[AgreedMask]:
    """Yield the masks of all views; those that the others contradict are drawn from the Gaussians where they differ.

    A given outline is finer than that of Gaussians, so that a difference counts where it is wider than 2 ``reach``
    pixels. There a pixel becomes the class of surely decided Gaussians, or IGNORE. A silenced view, and one without a
    mask, is drawn whole. reach: 1 at the size that was trained on, more at larger photos. photos: per view a function
    that returns it [H, W, 3] uint8 RGB, to whose edges new outlines move; without, they stay.
    """
    inputs = geometry_inputs(surfels)
    ids, sure = (each.to(inputs.means.device) for each in (agreement.class_ids, agreement.sure))
    of_class = torch.nn.functional.one_hot(ids.long(), num_classes).to(inputs.means)
    features = torch.cat([of_class, sure[:, None].to(of_class)], dim=1)
    whole, partly = set(agreement.silenced), set(agreement.contradicted)
    for view, (camera, mask) in enumerate(zip(cameras, labels, strict=True)):
        if mask is not None and view not in whole | partly:
            nothing = torch.zeros_like(mask, dtype=torch.bool)
            yield AgreedMask(mask, nothing, nothing)
            continue
        with torch.no_grad():
            light = draw_features(rasterizer, inputs, features, camera, settings).cpu().numpy()
        drawn, certain = _shown(light[..., :-1]), light[..., -1] > DRAWN
        given = np.full(drawn.shape, IGNORE, np.int64) if mask is None else mask.cpu().numpy().astype(np.int64)
        if mask is None or view in whole:
            taken = np.ones(drawn.shape, dtype=bool)
        else:
            taken = _wide((drawn != IGNORE) & (drawn != given) & (given != IGNORE), reach)
        labelled = np.where(taken, drawn, given).astype(np.uint16)
        if photos is not None and taken.any():
            near = _grown(taken, 2 * reach)
            labelled = np.where(near, snap_to_edges(labelled, photos[view](), 2 * reach), labelled)
        labelled[taken & ~certain] = IGNORE
        new = torch.from_numpy(labelled.astype(np.int32))
        doubtful = torch.from_numpy(taken & (labelled == IGNORE))
        changed = torch.from_numpy((labelled != given) & (labelled != IGNORE))
        yield AgreedMask(new.to(inputs.means.device), changed, doubtful)


def _shown(light: np.ndarray) -> np.ndarray:
    """Return the class [H, W] int64 that gives more than ``DRAWN`` of a pixel's light [H, W, C], or IGNORE."""
    return np.where(light.max(axis=-1) > DRAWN, light.argmax(axis=-1), IGNORE)


def _wide(found: np.ndarray, reach: int) -> np.ndarray:
    """Return the parts of a mask [H, W] bool wider than 2 ``reach`` pixels, without what leads away from them."""
    import cv2

    side = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return found & _grown(cv2.erode(found.astype(np.uint8), side) > 0, reach + 1)


def _grown(found: np.ndarray, reach: int) -> np.ndarray:
    import cv2

    return cv2.dilate(found.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
