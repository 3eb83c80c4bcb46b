"""Move a surface along its normals to where the photos agree on its colours.

The depth of trained splats lies up to a pixel behind the true surface: renders are right all the same, because splats
are rendered at least a pixel wide. On the true surface, photos agree on the colour of a place; a pixel in front or
behind they differ, wherever the surface has a texture. Highlights of glossy objects, however, lie behind the surface,
as mirror images do. A surface is therefore only moved if its outline still fits the masks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from beags_plugin.core.lifting import hides, project
from beags_plugin.surfaces.baking import Observations, Places, exposures_of, interpolated, places_seen
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import rays_through, surface_of, vertex_normals

_SAMPLES = 4000  # vertices that are measured
_STEP = 0.25  # pixels
_STEPS = _STEP * np.arange(-6, 7)  # outward moves that are compared, pixels
_ROUNDS = 2  # the second round has better normals and occlusions
_FEWEST = 3  # least number of photos that see a place
_NEIGHBOURS = 24  # places that are moved alike
_REACH = 10.0  # distance in voxels that counts as much as normals 60 degrees apart
_PULL = 0.1  # weight of all places' mean disagreement beside a place's own
_LOST = 0.002  # IoU with the masks that a move may cost
_PIXELS = 50_000  # approximate number of pixels of a photo at which outlines are compared
_NOISE = 1e-5  # disagreement per squared pixel, which keeps places of one colour where they are


def placed(
    mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[Mesh, float]:
    """Return a mesh of at least one face, moved to where photos agree, and the mean move in pixels.

    The mesh is unchanged if too few photos see it. A round that moves its outline away from the photos' masks is
    dropped. progress: receives (done, total) photos, each of which is read once, and then three times in a round.
    """
    count = len(photos)
    if count < _FEWEST:
        return mesh, 0.0
    moved, total = 0.0, (1 + 3 * _ROUNDS) * count

    def passed(before: int) -> Callable[[int], None]:
        return lambda done: progress(before + done, total)

    least = outline_iou(mesh, photos, passed(0)) - _LOST
    for turn in range(_ROUNDS):
        first = (1 + 3 * turn) * count
        result = _moved(mesh, photos, passed(first))
        if result is None or outline_iou(result[0], photos, passed(first + 2 * count)) < least:
            break
        mesh, pixels = result
        moved += pixels
    return mesh, moved


def outline_iou(mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int], None] = lambda done: None) -> float:
    """Return the IoU of a mesh's outline with the masks of all photos, without pixels where something hides the mesh.

    It is 1 if both are empty. progress: receives the number of photos done.
    """
    caster, both, either = surface_of(mesh), 0, 0
    for done, photo in enumerate(photos, start=1):
        camera, own, depth = photo.camera, photo.own().numpy(), photo.depth().numpy()
        step = max(1, round((camera.height * camera.width / _PIXELS) ** 0.5))
        rows, columns = (each.reshape(-1) for each in np.mgrid[: camera.height : step, : camera.width : step])
        rays, _ = rays_through(mesh, camera, np.stack([columns, rows], axis=1) + 0.5)
        hit = caster.cast_rays(rays)["t_hit"].numpy()
        mask, scene = own[rows, columns], depth[rows, columns]
        hidden = ~mask & hides(scene, hit)
        outline = np.isfinite(hit) & ~hidden
        both, either = both + int((outline & mask).sum()), either + int((outline | mask).sum())
        progress(done)
    return both / either if either else 1.0


def _moved(mesh: Mesh, photos: Sequence[Photo], progress: Callable[[int], None]) -> tuple[Mesh, float] | None:
    from scipy.spatial import KDTree

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
    """Return [V, 6], positions and normals: near each other for neighbours on one side of the surface."""
    return np.concatenate([(mesh.vertices - mesh.vertices[0]) / (_REACH * mesh.voxel), normals], axis=1)


def _pixels(points: np.ndarray, photos: Sequence[Photo]) -> np.ndarray:
    """Return the size of a pixel at points [P, 3], [P]: the median over the photos."""
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
    """Return weights [P], 0 where fewer than three photos see a place, and the photos' disagreement [P, K].

    The disagreement is the variance of the square root of light at places moved by each of the K steps.
    """
    caster = surface_of(mesh)
    observations: list[Observations] = []

    def observed() -> Iterator[Observations]:
        for photo in photos:
            observations.append(places_seen(places, mesh, caster, photo))
            yield observations[-1]

    exposures = exposures_of(len(places.points), len(photos), observed(), progress)
    count, steps = len(places.points), len(_STEPS)
    weight, seen = np.zeros(count), np.zeros(count, np.int64)
    first, second = np.zeros((count, steps, 3)), np.zeros((count, steps, 3))
    for view, (photo, exposure) in enumerate(zip(photos, exposures, strict=True)):
        index, _, sharp = observations[view]
        sharp = np.minimum(sharp, 1.0) ** (1 / 3)
        weight[index] += sharp
        seen[index] += 1
        camera, image = photo.camera.to(torch.float64), photo.image()
        by = (pixel[index, None] * _STEPS)[..., None]
        moved = (places.points[index, None] + by * places.normals[index, None]).reshape(-1, 3)
        xy = project(torch.from_numpy(moved), camera)[0].numpy()
        root = np.sqrt(linear_from_srgb(interpolated(image, xy)) / exposure).reshape(-1, steps, 3)
        first[index] += sharp[:, None, None] * root
        second[index] += sharp[:, None, None] * root**2
        progress(len(photos) + view + 1)
    some = np.maximum(weight, 1e-300)[:, None, None]
    variance = np.maximum(second / some - (first / some) ** 2, 0.0).sum(axis=2)
    return np.where(seen >= _FEWEST, weight, 0.0), variance


def _lowest(costs: np.ndarray) -> np.ndarray:
    """Return the moves [P], pixels, at which costs [P, K] are lowest; a parabola interpolates between steps."""
    at = costs.argmin(axis=1)
    inner = np.clip(at, 1, costs.shape[1] - 2)
    rows = np.arange(len(costs))
    left, middle, right = (costs[rows, inner + side] for side in (-1, 0, 1))
    bend = left - 2 * middle + right
    part = np.where(bend > 0, 0.5 * (left - right) / np.where(bend > 0, bend, 1.0), 0.0)
    return _STEPS[at] + np.where(at == inner, np.clip(part, -0.5, 0.5), 0.0) * _STEP
