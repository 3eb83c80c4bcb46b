"""A surface moved along its normals to where the photos agree on its colours.

The depth of trained splats lies behind what they show, by up to a pixel: their pictures are right in each view, and a
splat drawn at least a pixel wide keeps its outline where its middle lies further in. Where a surface lies, the photos
that see a place have one colour for it; a pixel in front or behind they differ, wherever the surface has a texture. But
highlights of something glossy lie behind its surface, as seen in a mirror: so a surface is only moved where its outline
still fits the masks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from beags_plugin.core.lifting import TAU, project
from beags_plugin.surfaces.baking import Places, Shown, exposures_of, interpolated, places_seen
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import rays_through, surface_of, vertex_normals

_SAMPLES = 4000  # vertices that are looked at
_STEP = 0.25  # pixels
_STEPS = _STEP * np.arange(-6, 7)  # that they are moved outwards
_ROUNDS = 2  # the second sees normals and what hides what as the first has left them
_FEWEST = 3  # photos that must see a place
_NEIGHBOURS = 24  # places that are moved alike
_REACH = 10.0  # voxels apart, or normals 60 degrees apart, is far for neighbours
_PULL = 0.1  # of all places' mean agreement, beside a place's own
_LOST = 0.002  # IoU with the masks that moving may cost
_PIXELS = 50_000  # of a photo that outlines are compared at, about
_NOISE = 1e-5  # disagreement a squared pixel, that places of one colour stay where they are


@dataclass(frozen=True)
class Placed:
    """A mesh, and by how many pixels its places were moved, in the mean."""

    mesh: Mesh
    pixels: float


def placed(
    mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int, int], None] = lambda done, total: None
) -> Placed:
    """Return a mesh of at least one face, moved to where photos agree; as it is where too few of them see it.

    A round that takes its outline away from the photos' masks does not count. progress: receives (done, total) photos,
    each of which is looked at once, and then three times in a round.
    """
    count = len(photos)
    if count < _FEWEST:
        return Placed(mesh, 0.0)
    moved, total = 0.0, (1 + 3 * _ROUNDS) * count

    def passed(before: int) -> Callable[[int], None]:
        return lambda done: progress(before + done, total)

    least = outline_iou(mesh, photos, passed(0)) - _LOST
    for turn in range(_ROUNDS):
        first = (1 + 3 * turn) * count
        found = _moved(mesh, photos, passed(first))
        if found is None or outline_iou(found[0], photos, passed(first + 2 * count)) < least:
            break
        mesh, pixels = found
        moved += pixels
    return Placed(mesh, moved)


def outline_iou(mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int], None] = lambda done: None) -> float:
    """Return the IoU of a mesh's outline with the masks of photos, over all of them; what hides the mesh is left out.

    1 where neither shows anything. progress: receives how many photos are done.
    """
    caster, both, either = surface_of(mesh), 0, 0
    for done, photo in enumerate(photos, start=1):
        camera, own, depth = photo.camera, photo.own().numpy(), photo.depth().numpy()
        step = max(1, round((camera.height * camera.width / _PIXELS) ** 0.5))
        rows, columns = (each.reshape(-1) for each in np.mgrid[: camera.height : step, : camera.width : step])
        rays, _ = rays_through(mesh, camera, np.stack([columns, rows], axis=1) + 0.5)
        hit = caster.cast_rays(rays)["t_hit"].numpy()
        mine, scene = own[rows, columns], depth[rows, columns]
        hidden = ~mine & (scene > 0) & (scene < (1.0 - TAU) * hit)
        shown = np.isfinite(hit) & ~hidden
        both, either = both + int((shown & mine).sum()), either + int((shown | mine).sum())
        progress(done)
    return both / either if either else 1.0


def _moved(mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int], None]) -> tuple[Mesh, float] | None:
    from scipy.spatial import KDTree

    if len(photos) < _FEWEST:
        return None
    chosen = np.sort(np.random.default_rng(0).permutation(len(mesh.vertices))[:_SAMPLES])
    normals = vertex_normals(mesh)
    tree = KDTree(_spots(mesh, normals)[chosen])

    def near(rows: Any) -> np.ndarray:
        spots = _spots(mesh, normals)[rows]
        return np.reshape(tree.query(spots, k=min(_NEIGHBOURS, len(chosen)))[1], (len(spots), -1))

    among = near(chosen)
    smooth = normals[chosen][among].sum(axis=1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
    places = Places(mesh.vertices[chosen], smooth, mesh.voxel)
    pixel = _pixels(places.points, photos)
    weight, variance = _disagreement(places, pixel, mesh, photos, progress)
    if not (weight > 0).any():
        return None
    variance += _NOISE * _STEPS**2
    mean = np.einsum("p,pk->k", weight, variance) / weight.sum()
    best = _lowest(mean[None])[0]
    bend = max(float(np.diff(mean, 2)[np.clip(round((best - _STEPS[0]) / _STEP) - 1, 0, len(mean) - 3)]), 0.0)
    pull = _PULL * bend / 2 * ((_STEPS - best) / _STEP) ** 2
    around = np.einsum("pn,pnk->pk", weight[among], variance[among])
    around /= np.maximum(weight[among].sum(axis=1), 1e-300)[:, None]
    shift = _lowest(around + pull)
    shift = shift[among].mean(axis=1)
    of_all = near(slice(None))
    by = (shift * pixel)[of_all].mean(axis=1)
    along = smooth[of_all].sum(axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    return replace(mesh, vertices=mesh.vertices + by[:, None] * along), float(shift.mean())


def _spots(mesh: Mesh, normals: np.ndarray) -> np.ndarray:
    """Return [V, 6], in which places are near each other that are so on one side of the surface."""
    return np.concatenate([(mesh.vertices - mesh.vertices[0]) / (_REACH * mesh.voxel), normals], axis=1)


def _pixels(points: np.ndarray, photos: Sequence[Photo]) -> np.ndarray:
    """Return [P] how large a pixel is at points [P, 3], the median over the photos."""
    sizes = []
    for photo in photos:
        z = project(torch.from_numpy(points), photo.camera.to(torch.float64))[1].numpy()
        sizes.append(np.where(z > 0, z, np.nan) / photo.camera.focal)
    size = np.stack(sizes)
    none = np.isnan(size).all(axis=0)
    size[:, none] = 0.0
    return np.nanmedian(size, axis=0)


def _disagreement(
    places: Places, pixel: np.ndarray, mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights [P], 0 where fewer than three photos see a place, and how much the photos that do differ there.

    The second is [P, K], the variance of the root of light at places moved by each of the steps.
    """
    caster = surface_of(mesh)
    shown: list[Shown] = []

    def looked_at() -> Iterator[Shown]:
        for photo in photos:
            shown.append(places_seen(places, mesh, caster, photo))
            yield shown[-1]

    exposures = exposures_of(len(places.points), len(photos), looked_at(), progress)
    count, steps = len(places.points), len(_STEPS)
    weight, seen = np.zeros(count), np.zeros(count, np.int64)
    first, second = np.zeros((count, steps, 3)), np.zeros((count, steps, 3))
    for view, (photo, exposure) in enumerate(zip(photos, exposures, strict=True)):
        index, _, sharp = shown[view]
        sharp = np.minimum(sharp, 1.0) ** (1 / 3)
        weight[index] += sharp
        seen[index] += 1
        camera, image = photo.camera.to(torch.float64), photo.image()
        by = (pixel[index, None] * _STEPS)[..., None]
        there = (places.points[index, None] + by * places.normals[index, None]).reshape(-1, 3)
        xy = project(torch.from_numpy(there), camera)[0].numpy()
        root = np.sqrt(linear_from_srgb(interpolated(image, xy)) / exposure).reshape(-1, steps, 3)
        first[index] += sharp[:, None, None] * root
        second[index] += sharp[:, None, None] * root**2
        progress(len(photos) + view + 1)
    some = np.maximum(weight, 1e-300)[:, None, None]
    variance = np.maximum(second / some - (first / some) ** 2, 0.0).sum(axis=2)
    return np.where(seen >= _FEWEST, weight, 0.0), variance


def _lowest(costs: np.ndarray) -> np.ndarray:
    """Return [P] the steps at which costs [P, K] are lowest, between steps by a parabola."""
    at = costs.argmin(axis=1)
    inner = np.clip(at, 1, costs.shape[1] - 2)
    rows = np.arange(len(costs))
    left, middle, right = (costs[rows, inner + side] for side in (-1, 0, 1))
    bend = left - 2 * middle + right
    part = np.where(bend > 0, 0.5 * (left - right) / np.where(bend > 0, bend, 1.0), 0.0)
    return _STEPS[at] + np.where(at == inner, np.clip(part, -0.5, 0.5), 0.0) * _STEP
