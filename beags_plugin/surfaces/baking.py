"""Colours of a surface from the photos that see it, weighted by angle and distance, with exposures evened out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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
    total = _PRIOR * linear_from_srgb(prior)
    weights = np.full(len(places.points), _PRIOR)
    for done, (photo, exposure) in enumerate(zip(photos, exposures, strict=True), start=1):
        index, light, weight = places_seen(places, mesh, caster, photo)
        total[index] += weight[:, None] * light / exposure
        weights[index] += weight
        progress(len(photos) + done, 2 * len(photos))
    return Baked(srgb_from_linear(total / weights[:, None]), weights > _PRIOR, exposures)


def places_seen(places: Places, mesh: Mesh, caster: Any, photo: Photo) -> Observations:
    """Return the places that a photo shows, [M] int64, their light [M, 3] and its weights [M]."""
    camera = photo.camera
    xy, z = (values.numpy() for values in project(torch.from_numpy(places.points), camera.to(torch.float64)))
    towards = camera.center.double().numpy() - places.points
    distance = np.sqrt(np.einsum("pd,pd->p", towards, towards))
    cosine = np.einsum("pd,pd->p", towards, places.normals) / np.maximum(distance, 1e-300)
    with np.errstate(invalid="ignore"):
        framed = ((xy >= 0.5) & (xy <= [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    index = np.flatnonzero(framed & (z > 0) & (cosine > FLATTEST))
    column, row = np.floor(xy[index]).astype(np.int64).T
    column, row = np.minimum(column, camera.width - 1), np.minimum(row, camera.height - 1)
    depth = photo.depth().numpy()[row, column]
    index = index[well_inside(photo)[row, column] & ~hides(depth, z[index])]
    index = index[~_hidden(caster, mesh, places[index], camera.center.double().numpy())]
    light = linear_from_srgb(interpolated(photo.image(), xy[index]))
    pixels = cosine[index] * (camera.focal * places.spacing / z[index]) ** 2  # pixels per place
    return index, light, np.minimum(pixels, 4.0) ** _SHARPEN


def well_inside(photo: Photo) -> np.ndarray:
    """Return [H, W] bool, the pixels of a photo's mask without its edge, where colours mix with those behind."""
    edge = photo.edge
    around = torch.nn.functional.pad((~photo.own()).float()[None, None], (edge, edge, edge, edge))
    return (torch.nn.functional.max_pool2d(around, 2 * edge + 1, stride=1)[0, 0] == 0).numpy()


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
    pixels = image.double().numpy()
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
