"""Split one object into things that do not touch in space, and give each a class.

A network for salient objects does not tell them apart. Gaussians i and j of the object are linked if
|mu_i - mu_j| <= GAP d + s_i + s_j, where d is the object's size and s the larger standard deviation of a Gaussian.
Connected parts are things; parts that give little light are crumbs, and join the nearest thing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.agreement import Agreement
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs

NEIGHBOURS = 24
GAP = 0.01  # share of d that links bridge, as a Gaussian's light reaches beyond its deviation
LARGEST = 0.1  # deviation, in d, from which on a Gaussian is a streak and links nothing
THING = 0.1  # least light of a thing, as a share of the largest part's; parts with less are crumbs
SEEN = 0.05  # least light of a mask's pixel from the things; pixels with less take the nearest one's thing


@dataclass(frozen=True)
class Things:
    """Numbers of things: requested, found, and found beyond the requested number."""

    asked: int
    found: int
    more: int

    def sentence(self) -> str:
        """Return a sentence for users where the numbers differ, else ""."""
        if self.found < self.asked:
            count = "Only one separate thing was" if self.found == 1 else f"Only {self.found} separate things were"
            return f"{count} found, not {self.asked}: click on things that touch, or that most masks lack."
        count = "One more separate thing was" if self.more == 1 else f"{self.more} more separate things were"
        more = f"{count} found and became background: ask for {self.found + self.more}."
        return more if self.more else ""


@dataclass(frozen=True)
class Separation:
    """Things of one object, the largest first.

    agreement: with the things' classes 1, 2, ... of_more: [N] bool, Gaussians of things beyond the requested number,
    which became background.
    """

    agreement: Agreement
    things: Things
    of_more: Tensor


def separate(agreement: Agreement, surfels: Surfels, most: int) -> Separation:
    """Split the object 1 of N Gaussians into at most ``most`` things, by what touches in space."""
    mine = np.flatnonzero(agreement.class_ids.numpy() != BACKGROUND)
    centres = torch.nan_to_num(surfels.means.detach().double().cpu()).numpy()[mine]
    deviations = surfels.log_scales.detach().double().cpu().amax(dim=1).exp().numpy()[mine]
    parts = parts_of(centres, deviations)
    light = np.bincount(parts, agreement.light[mine], minlength=int(parts.max(initial=-1)) + 1)
    order = np.argsort(-light, kind="stable")
    things = order[light[order] >= THING * light.max(initial=0.0)]
    chosen = things[:most]
    of_part = np.full(len(light), -1)
    of_part[things], of_part[chosen] = BACKGROUND, np.arange(1, len(chosen) + 1)
    thing = of_part[parts]
    if (crumbs := thing < 0).any():
        from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

        thing[crumbs] = thing[~crumbs][cKDTree(centres[~crumbs]).query(centres[crumbs])[1]]
    class_ids, of_more = np.zeros(len(surfels), np.int32), np.zeros(len(surfels), bool)
    class_ids[mine], of_more[mine] = thing, thing == BACKGROUND
    separated = replace(agreement, class_ids=torch.from_numpy(class_ids))
    counts = Things(most, len(chosen), len(things) - len(chosen))
    return Separation(separated, counts, torch.from_numpy(of_more))


def parts_of(centres: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the index of the connected part of each of M Gaussians, [M] int64; centres [M, 3], deviations [M]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    count = len(centres)
    if count < 2:
        return np.zeros(count, np.int64)
    low, high = np.quantile(centres, (0.02, 0.98), axis=0)
    size = float(np.linalg.norm(high - low))
    distances, near = cKDTree(centres).query(centres, k=np.arange(2, min(NEIGHBOURS + 1, count) + 1))
    own = np.broadcast_to(np.arange(count)[:, None], near.shape)
    linked = distances <= GAP * size + deviations[own] + deviations[near]
    linked &= np.maximum(deviations[own], deviations[near]) < LARGEST * size
    first, second = own[linked], near[linked]
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def separated_labels(
    found: Separation,
    surfels: Surfels,
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    rasterizer: Rasterizer,
    settings: RasterSettings,
) -> Iterator[Tensor | None]:
    """Yield the masks of all views, in which each pixel of the object has the class of the thing rendered there.

    labels: per view [H, W] int32, 1 for the object, IGNORE, or None. Pixels of the object where no thing is rendered
    take the class of the nearest one; IGNORE if the view shows none.
    """
    from scipy.ndimage import distance_transform_edt

    inputs = geometry_inputs(surfels)
    last = found.things.found
    ids = found.agreement.class_ids.long().masked_fill(found.of_more, last + 1)
    features = torch.nn.functional.one_hot(ids, last + 2)[:, 1:].to(inputs.means)
    for camera, mask in zip(cameras, labels, strict=True):
        if mask is None:
            yield None
            continue
        with torch.no_grad():
            light = draw_features(rasterizer, inputs, features, camera, settings).cpu().numpy()
        separated = mask.cpu().numpy().astype(np.int64)
        inside = (separated != BACKGROUND) & (separated != IGNORE)
        rendered = light.argmax(axis=-1) + 1
        known = inside & (light.sum(axis=-1) > SEEN)
        if known.any():
            rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)  # pyright: ignore
            rendered = rendered[rows, columns]
            rendered[rendered > last] = BACKGROUND
            separated[inside] = rendered[inside]
        else:
            separated[inside] = IGNORE
        yield torch.from_numpy(separated.astype(np.int32)).to(mask.device)
