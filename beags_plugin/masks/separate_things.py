"""Several things out of one object: its Gaussians fall apart where nothing of it links them, and each part is a class.

A network that marks what stands out tells no things apart. In space they are apart if they do not touch: Gaussians i
and j of the object are linked if |mu_i - mu_j| <= GAP d + s_i + s_j, with the object's size d and the larger deviation
s of a Gaussian. Connected parts that give little light are crumbs, and belong to the nearest thing.
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
GAP = 0.01  # of the size of all things: a Gaussian's light reaches beyond its deviation
LARGEST = 0.1  # of the same: a Gaussian of such a deviation is a streak, and links nothing
THING = 0.1  # of the light that the largest part gives: less is a crumb, as in the masks of a network
SEEN = 0.05  # of a pixel's light: a pixel of the mask with less of the things is as the nearest with more


@dataclass(frozen=True)
class Things:
    """How many things were asked for and found, and how many more there are."""

    asked: int
    found: int
    more: int

    def sentence(self) -> str:
        """Return a sentence for users where they are not as many as were asked for, else nothing."""
        if self.found < self.asked:
            count = "Only one thing lies" if self.found == 1 else f"Only {self.found} things lie"
            return f"{count} apart, not {self.asked}: things that touch, or that most masks lack, take clicks."
        more = f"{self.more} more of what stands out lies apart, and is background: ask for {self.found + self.more}."
        return more if self.more else ""


@dataclass(frozen=True)
class Separation:
    """Things of one object, the largest first. agreement: with the classes 1, 2, ... of the things that were found.

    of_more: [N] bool, Gaussians of the things that nobody asked for, which are background.
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
    kept = things[:most]
    of_part = np.full(len(light), -1)
    of_part[things], of_part[kept] = BACKGROUND, np.arange(1, len(kept) + 1)
    thing = of_part[parts]
    if (crumbs := thing < 0).any():
        from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

        thing[crumbs] = thing[~crumbs][cKDTree(centres[~crumbs]).query(centres[crumbs])[1]]
    class_ids, of_more = np.zeros(len(surfels), np.int32), np.zeros(len(surfels), bool)
    class_ids[mine], of_more[mine] = thing, thing == BACKGROUND
    found = replace(agreement, class_ids=torch.from_numpy(class_ids))
    counts = Things(most, len(kept), len(things) - len(kept))
    return Separation(found, counts, torch.from_numpy(of_more))


def parts_of(centres: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the number of the connected part of each of M Gaussians, [M] int64; centres [M, 3], deviations [M]."""
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
    """Yield the masks of all views with each pixel of the object given to the thing that is drawn there.

    labels: per view [H, W] int32, 1 for the object, IGNORE, or None. Pixels of the object at which no thing is drawn
    become the nearest one's; without any in the view, IGNORE.
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
        given = mask.cpu().numpy().astype(np.int64)
        wanted = (given != BACKGROUND) & (given != IGNORE)
        drawn = light.argmax(axis=-1) + 1
        known = wanted & (light.sum(axis=-1) > SEEN)
        if known.any():
            rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)  # pyright: ignore
            drawn = drawn[rows, columns]
            drawn[drawn > last] = BACKGROUND
            given[wanted] = drawn[wanted]
        else:
            given[wanted] = IGNORE
        yield torch.from_numpy(given.astype(np.int32)).to(mask.device)
