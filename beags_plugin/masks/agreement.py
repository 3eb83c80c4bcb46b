"""Masks of all views that agree in space: one decision per Gaussian, from which the masks are drawn anew.

A vote per pixel cannot correct an error that a third of the views share. Here a view that contradicts the others loses
weight, and the classes of Gaussians are a minimum cut of the surface's graph, as in ``picking.cutter``. With the light
L_vic that Gaussian i gives to the pixels of view v that its mask labels c, and the weight a_v of the view,

    S_ic = sum_v a_v L_vic,   p_ic = S_ic / (sum_c' S_ic' + 1),   c_i = argmax_c S_ic,
    e_v = sum_{i, c != c_i} L_vic / sum_{i, c or c_i an object} L_vic,   a_v = 1 / (1 + (e_v / median e)^2),

and 0 where e_v exceeds ``SILENT``; both settle in a few rounds. A view whose mask shows no object starts with weight 0,
because a network that found nothing there may have missed the object; it has no e_v if the others see none there either
(NaN), so that empty views are no sign of agreement. Each object's cut has the unary terms
0.3 logit p_ic, and the links of ``picking.graph``, which are cheap to cut along creases, depth edges and changes of
colour.

Where the pose of a view is wrong, its mask fits its photo, but contradicts the Gaussians. Such a mask is recognised by
a shift in the image after which it fits, and it is not redrawn.
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

ROUNDS = 4  # rounds in which weights are computed from errors, and errors from weighted votes
LEAST_ERROR = 0.02  # lower bound of the median e: outlines alone cause as much
TRACE = 0.01  # share of the objects' light in the median view up to which a view only has their glow at its border
SILENT = 0.5  # largest e of a mask with weight: one that is more wrong than right is redrawn from the other views
CONTRADICTS = 1.5  # e, in medians, up to which a mask keeps all its pixels, as Gaussians are coarser than photos
BELIEF, LIMIT = 0.3, 0.02  # weight of logit p beside links of at most 1; bound of p that keeps its logit finite
NO_VOTE = 0.4  # prior votes for the object, out of 1: a Gaussian without votes is more likely background
SURE = 0.15  # least p - 1/2 at which votes alone make a class certain
FITS, NEAR = 0.8, 1 / 3  # least IoU of a misplaced view's mask with what is drawn, after and before the shift
LESS = 2 / 3  # largest share of the former 1 - IoU that remains after the shift
SMALL = 256  # longer side of the masks in which the shift is searched, pixels
DRAWN = 0.5  # least share of a pixel's light that a class needs to label it

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Agreement:
    """The decisions on N Gaussians by the masks of V views.

    class_ids: [N] int32. sure: [N] bool, where the votes clearly support the cut. errors: [V] float64, e_v; NaN without
    a mask, and where neither the mask nor the other views show an object. weights: [V] float64, a_v; 0 for a view that
    is silenced or shows no object. light: [N] float64, the weighted light over all classes.
    """

    class_ids: Tensor
    sure: Tensor
    errors: np.ndarray
    weights: np.ndarray
    light: np.ndarray

    @property
    def contradicted(self) -> list[int]:
        """Return the views whose errors are well above the median, ascending."""
        return [int(view) for view in np.flatnonzero(self.errors > CONTRADICTS * median_error(self.errors))]

    @property
    def silenced(self) -> list[int]:
        """Return the views with a mask that is more wrong than right, ascending."""
        return [int(view) for view in np.flatnonzero(self.errors > SILENT)]


@dataclass(frozen=True)
class AgreedMask:
    """The labels of a view [H, W] int32 after agreement: class ids or IGNORE.

    changed: [H, W] bool, pixels whose class differs from the given one. doubtful: [H, W] bool, pixels left unlabelled
    because no class is certain. misplaced: the pose of the view, not its mask, contradicts the other views.
    """

    labels: Tensor
    changed: Tensor
    doubtful: Tensor
    misplaced: bool = False


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
    seen, normals = seen_from(surfels, cameras, rasterizer, settings)
    graph = surface_graph(surfels, seen, normals)
    votes = _Votes(surfels, cameras, labels, rasterizer, settings, num_classes, progress)
    weights, errors = votes.shows_object.astype(np.float64), np.full(len(labels), np.nan)
    for _ in range(ROUNDS):
        errors = votes.errors(votes.sums(weights))
        weights = votes.weights(errors)
    sums = votes.sums(weights)
    total = sums.sum(axis=1)
    share = sums / np.maximum(total, 1e-12)[:, None]
    claims = np.stack([_claimed(graph, sums[:, c], total) for c in range(1, num_classes)], axis=1)
    class_ids = np.where(claims.any(axis=1), np.where(claims, share[:, 1:], -1.0).argmax(axis=1) + 1, BACKGROUND)
    own = np.take_along_axis(sums, class_ids[:, None], axis=1)[:, 0]
    sure = own / np.maximum(total + 1.0, 1.0) > 0.5 + SURE
    return Agreement(torch.from_numpy(class_ids.astype(np.int32)), torch.from_numpy(sure), errors, weights, total)


def _claimed(graph: SurfaceGraph, of_object: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Return which of N Gaussians the cut gives to an object, [N] bool; of_object, total: [N] votes."""
    p = ((of_object + NO_VOTE) / (total + 1.0))[graph.nodes].clip(LIMIT, 1.0 - LIMIT)
    belief = BELIEF * np.log(p / (1.0 - p))
    terminals = torch.from_numpy(np.stack([belief.clip(0.0), (-belief).clip(0.0)], axis=1))
    pairs = torch.from_numpy(np.stack([graph.first, graph.second], axis=1))
    inside = cut(pairs, torch.from_numpy(graph.weights), terminals).numpy()
    return inside[graph.nearest] if len(inside) else np.zeros(len(graph.nearest), dtype=bool)


def median_error(errors: np.ndarray) -> float:
    """Return the median of the errors [V] that are at most ``SILENT``; at least ``LEAST_ERROR``."""
    counted = errors[errors <= SILENT]
    return max(float(np.median(counted)) if len(counted) else 0.0, LEAST_ERROR)


class _Votes:
    """L of the module's docstring, sparse: per view keys [M] (Gaussian * classes + class) and light [M], or None."""

    def __init__(self, surfels, cameras, labels, rasterizer, settings, num_classes: int, progress) -> None:
        inputs = geometry_inputs(surfels)
        settings = replace(settings, geometry=False, distortion=False)
        self._count, self._classes = len(surfels), num_classes
        self._views: list[tuple[np.ndarray, np.ndarray] | None] = []
        self._areas = np.array([float(camera.K[0, 0] * camera.K[1, 1]) for camera in cameras])
        for index, (camera, mask) in enumerate(zip(cameras, labels, strict=True)):
            if mask is None:
                self._views.append(None)
            else:
                with torch.no_grad():
                    keys, light = rasterizer.sparse_class_contributions(inputs, camera, settings, mask, num_classes)
                self._views.append((keys.cpu().numpy(), light.float().cpu().numpy()))
            if progress is not None:
                progress(index + 1, len(labels))
        shows = [view is not None and bool((view[0] % num_classes != BACKGROUND).any()) for view in self._views]
        self.shows_object = np.array(shows, bool)

    def sums(self, weights: np.ndarray) -> np.ndarray:
        """Return S, [N, C] float64."""
        total = np.zeros(self._count * self._classes)
        for weight, view in zip(weights, self._views, strict=True):
            if view is not None and weight > 0:
                total[view[0]] += weight * view[1]
        return total.reshape(self._count, self._classes)

    def errors(self, sums: np.ndarray) -> np.ndarray:
        """Return e, [V] float64; NaN without a mask, and where neither the view nor the others see an object."""
        agreed, known = sums.argmax(axis=1), sums.sum(axis=1) > 0
        wrong, seen = np.zeros(len(self._views)), np.zeros(len(self._views))
        for index, view in enumerate(self._views):
            if view is None:
                continue
            keys, light = view
            gaussians, classes = keys // self._classes, keys % self._classes
            of_objects = known[gaussians] & ((classes != BACKGROUND) | (agreed[gaussians] != BACKGROUND))
            seen[index] = float(light[of_objects].sum())
            wrong[index] = float(light[of_objects & (classes != agreed[gaussians])].sum())
        # Close-ups hold more light of the same object than whole photos: areas are compared at one focal length.
        usual = np.median((seen / self._areas)[self.shows_object]) if self.shows_object.any() else 0.0
        least = np.where(self.shows_object, 0.0, TRACE * usual * self._areas)
        return np.divide(wrong, seen, out=np.full(len(seen), np.nan), where=seen > least)

    def weights(self, errors: np.ndarray) -> np.ndarray:
        """Return a, [V] float64."""
        errors, median = np.nan_to_num(errors), median_error(errors)
        return np.where(self.shows_object & (errors <= SILENT), 1.0 / (1.0 + (errors / median) ** 2), 0.0)


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
    """Yield the masks of all views; contradicted masks are redrawn from the Gaussians where the two differ.

    A given outline is finer than that of Gaussians, so only differences wider than 2 ``reach`` pixels count. There a
    pixel takes the class of the Gaussians if these are certain, else IGNORE. Masks of silenced views, and of views
    without one, are redrawn whole. Masks of misplaced views stay, but for all differences, which become IGNORE.
    reach: 1 at the size of the training, more at larger photos. photos: per view a function that returns the photo
    [H, W, 3] uint8 RGB; new outlines move to its edges. None: they stay.
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
        of_classes, certain = light[..., :-1], light[..., -1] > DRAWN
        rendered = np.where(of_classes.max(axis=-1) > DRAWN, of_classes.argmax(axis=-1), IGNORE)
        given = np.full(rendered.shape, IGNORE, np.int64) if mask is None else mask.cpu().numpy().astype(np.int64)
        if mask is not None and is_shifted(given, rendered):
            doubtful = torch.from_numpy((rendered != given) & (given != IGNORE)).to(mask.device)
            yield AgreedMask(mask.masked_fill(doubtful, IGNORE), torch.zeros_like(doubtful), doubtful, misplaced=True)
            continue
        if mask is None or view in whole:
            redrawn = np.ones(rendered.shape, dtype=bool)
        else:
            redrawn = _wide((rendered != IGNORE) & (rendered != given) & (given != IGNORE), reach)
        labelled = np.where(redrawn, rendered, given).astype(np.uint16)
        if photos is not None and redrawn.any():
            near = _grown(redrawn, 2 * reach)
            labelled = np.where(near, snap_to_edges(labelled, photos[view](), 2 * reach), labelled)
        labelled[redrawn & ~certain] = IGNORE
        new = torch.from_numpy(labelled.astype(np.int32))
        doubtful = torch.from_numpy(redrawn & (labelled == IGNORE))
        changed = torch.from_numpy((labelled != given) & (labelled != IGNORE))
        yield AgreedMask(new.to(inputs.means.device), changed, doubtful)


def is_shifted(given: np.ndarray, rendered: np.ndarray) -> bool:
    """Return whether the objects of given labels [H, W] fit rendered ones after a shift, and much better than without.

    Neither an object that a mask lacks nor a part that it takes in too much goes away by a shift.
    """
    import cv2

    scale = min(SMALL / max(given.shape), 1.0)
    size = (max(round(scale * given.shape[1]), 1), max(round(scale * given.shape[0]), 1))
    first, second = (
        cv2.resize(np.where((each != IGNORE) & (each != BACKGROUND), 1.0, 0.0), size, interpolation=cv2.INTER_AREA)
        for each in (given, rendered)
    )
    padded = (2 * size[1], 2 * size[0])  # A shift moves nothing over the border to the other side.
    product = np.fft.rfft2(first, padded) * np.fft.rfft2(second, padded).conj()
    common = np.fft.irfft2(product, padded)  # pixels that both have in common after each shift
    total = max(float(first.sum() + second.sum()), 1e-12)
    before, after = (float(each) / max(total - float(each), 1e-12) for each in (common[0, 0], common.max()))
    return after > FITS and before > NEAR and 1.0 - after < LESS * (1.0 - before)


def _wide(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the parts of a mask [H, W] bool that are wider than 2 ``reach`` pixels."""
    return mask & _grown(~_grown(~mask, reach), reach + 1)


def _grown(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return a mask [H, W] bool dilated by ``reach`` pixels."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
