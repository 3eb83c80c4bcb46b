"""Colours of a surface from the photos that see it, weighted by angle and distance, with exposures evened out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.exposure import BRIGHT, DARK, even_exposures
from beags_plugin.core.lifting import hides, project
from beags_plugin.surfaces.color import linear_from_srgb, srgb_from_linear
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import in_voxels, surface_of
from beags_plugin.system.open3d_kernels import open3d_kernels

_OFF = 1.0  # distance from the surface at which rays to the camera start, voxels
FLATTEST = 0.2  # least cosine between normal and ray: flatter views smear
_SHARPEN = 3  # power of a view's weight: a higher one follows the best view, a lower one blurs where views disagree
_PRIOR = 1e-6  # weight of the splats' colour; a photo that faces a place with one pixel per texel has 1
_SAMPLES = 8000  # places at which exposures are compared
_ALIKE = 0.05  # standard deviation of log exposures below which they may be errors of the surface
_PART = 1 << 16  # places that are looked up at a time, so that memory hardly grows with their number


@dataclass(frozen=True)
class Places:
    """P places on a surface: points [P, 3] float64, unit normals [P, 3]; spacing: their distance, in the same unit."""

    points: np.ndarray
    normals: np.ndarray
    spacing: float

    def __getitem__(self, chosen: Any) -> Places:
        return replace(self, points=self.points[chosen], normals=self.normals[chosen])


Observations = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Places that a photo shows, their light, and their weights."""


@dataclass(frozen=True)
class Baked:
    """Colours [P, 3] float64, sRGB 0..1; seen: [P] bool, whether a photo shows a place; exposures: [V, 3], mean 1."""

    colors: np.ndarray
    seen: np.ndarray
    exposures: np.ndarray


def baked(
    places: Places,
    mesh: Mesh,
    photos: Sequence[Photo],
    prior: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Baked:
    """Return the colours of places on a mesh from photos.

    A photo shows a place if its pixel is well inside the item's mask, and neither the scene nor the mesh itself hides
    it. Its weight is the third power of the number of pixels per place. prior: [P, 3] sRGB 0..1, the colours of places
    that no photo shows. progress: receives (done, total) photos, each of which is read twice.
    """
    caster = surface_of(mesh)
    step = max(1, len(places.points) // _SAMPLES)
    some = places[::step]
    observed = (places_seen(some, mesh, caster, photo) for photo in photos)
    exposures = exposures_of(len(some.points), len(photos), observed, lambda done: progress(done, 2 * len(photos)))
    colors, weights = np.empty(places.points.shape), np.full(len(places.points), _PRIOR)
    for part in _parts(len(colors)):  # ``colors`` holds weighted sums of light until the end.
        colors[part] = _PRIOR * linear_from_srgb(prior[part])
    for done, (photo, exposure) in enumerate(zip(photos, exposures, strict=True), start=1):
        for index, light, weight in _observed(places, mesh, caster, photo):
            colors[index] += weight[:, None] * light / exposure
            weights[index] += weight
        progress(len(photos) + done, 2 * len(photos))
    for part in _parts(len(colors)):
        colors[part] = srgb_from_linear(colors[part] / weights[part, None])
    return Baked(colors, weights > _PRIOR, exposures)


def places_seen(places: Places, mesh: Mesh, caster: Any, photo: Photo) -> Observations:
    """Return the places that a photo shows, [M] int64, their light [M, 3] and its weights [M]."""
    nothing = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)
    index, light, weight = zip(nothing, *_observed(places, mesh, caster, photo), strict=True)
    return np.concatenate(index), np.concatenate(light), np.concatenate(weight)


def _observed(places: Places, mesh: Mesh, caster: Any, photo: Photo) -> Iterator[Observations]:
    """Yield ``places_seen`` part by part."""
    camera, inside = photo.camera, well_inside(photo)
    depth, image = photo.depth().numpy(), photo.image()
    center, precise = camera.center.double().numpy(), camera.to(torch.float64)
    for chosen in _parts(len(places.points)):
        part = places[chosen]
        towards = center - part.points
        distance = np.sqrt(np.einsum("pd,pd->p", towards, towards))
        cosine = np.einsum("pd,pd->p", towards, part.normals) / np.maximum(distance, 1e-300)
        index = np.flatnonzero(cosine > FLATTEST)  # This leaves out most places at the least cost.
        xy, z = (values.numpy() for values in project(torch.from_numpy(part.points[index]), precise))
        with np.errstate(invalid="ignore"):
            framed = ((xy >= 0.5) & (xy <= [camera.width - 0.5, camera.height - 0.5])).all(axis=1) & (z > 0)
        index, xy, z = index[framed], xy[framed], z[framed]
        column, row = np.floor(xy).astype(np.int64).T
        column, row = np.minimum(column, camera.width - 1), np.minimum(row, camera.height - 1)
        open_ = inside[row, column]
        open_[open_] = ~hides(depth[row[open_], column[open_]], z[open_])
        index, xy, z = index[open_], xy[open_], z[open_]
        if not len(index):
            continue
        open_ = ~_hidden(caster, mesh, part[index], center)
        index, xy, z = index[open_], xy[open_], z[open_]
        light = linear_from_srgb(interpolated(image, xy))
        pixels = cosine[index] * (camera.focal * places.spacing / z) ** 2  # pixels per place
        yield chosen.start + index, light, np.minimum(pixels, 4.0) ** _SHARPEN


def _parts(count: int) -> Iterator[slice]:
    return (slice(first, first + _PART) for first in range(0, count, _PART))


def well_inside(photo: Photo) -> np.ndarray:
    """Return [H, W] bool, the pixels of a photo's mask without its edge, where colours mix with those behind."""
    return without_edge(photo.own().numpy(), photo.edge)


def without_edge(mask: np.ndarray, edge: int) -> np.ndarray:
    """Return the pixels of a mask [H, W] bool around which a square of 2 ``edge`` + 1 pixels lies in it.

    Beyond the image everything counts as the mask's. The squares are made by doubling: time grows with their logarithm.
    """
    mask, side = np.pad(mask, edge, constant_values=True), 2 * edge + 1
    width = 1
    while width < side:
        step = min(width, side - width)
        mask = mask[step:] & mask[:-step]
        mask = mask[:, step:] & mask[:, :-step]
        width += step
    return mask


def _hidden(caster: Any, mesh: Mesh, places: Places, center: np.ndarray) -> np.ndarray:
    """Return [P] bool, whether the mesh lies between places and the camera at ``center`` [3]."""
    open3d = open3d_kernels()

    starts = in_voxels(mesh, places.points + _OFF * mesh.voxel * places.normals).numpy()
    ends = in_voxels(mesh, center[None]).numpy()
    rays = np.concatenate([starts, ends - starts], axis=1)
    return caster.test_occlusions(open3d.core.Tensor(rays), 0.0, 1.0).numpy()


def interpolated(image: Tensor, xy: np.ndarray) -> np.ndarray:
    """Return an image [H, W, 3] at pixel coordinates [M, 2], bilinearly interpolated; [M, 3] float64."""
    height, width = image.shape[:2]
    pixels = image.numpy()
    at = xy - 0.5
    first = np.clip(np.floor(at).astype(np.int64), 0, [max(width - 2, 0), max(height - 2, 0)])
    (x, y), (u, v) = first.T, np.clip(at - first, 0.0, 1.0).T[..., None]
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    top = (1 - u) * pixels[y, x] + u * pixels[y, right]
    return (1 - v) * top + v * ((1 - u) * pixels[below, x] + u * pixels[below, right])


def exposures_of(
    places: int, count: int, observed: Iterable[Observations], progress: Callable[[int], None]
) -> np.ndarray:
    """Return the brightness of each photo relative to the photos' mean, by colour, [V, 3].

    places, count: the numbers of places, P, and of photos, V. observed: ``places_seen`` of each photo.
    ``core.exposure.even_exposures`` solves for them; rounding removes the solver's last bits, which differ by machine.
    """
    logs, weights = (np.zeros((places, count, 3)) for _ in range(2))
    for view, (index, light, weight) in enumerate(observed):
        usable = (light > DARK) & (light < BRIGHT)
        logs[index, view] = np.log(np.where(usable, light, 1.0))
        weights[index, view] = usable * np.minimum(weight, 1.0)[:, None] ** (1 / _SHARPEN)
        progress(view + 1)
    exposures = np.zeros((count, 3))
    for channel in range(3):
        place, view = np.nonzero(weights[..., channel])
        seen = place, view, channel
        exposures[:, channel] = even_exposures(place, view, logs[seen], weights[seen], count)[0]
    exposures -= exposures.mean(axis=0)
    return np.exp(np.round(np.where(exposures.std(axis=0) < _ALIKE, 0.0, exposures), 5))
