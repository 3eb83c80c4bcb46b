"""A texture of a mesh: charts, and the photos' colours in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from beags_plugin.core.lifting import project
from beags_plugin.surfaces.atlas import SMALLEST, Atlas, picture, texels, unwrapped
from beags_plugin.surfaces.baking import Places, baked
from beags_plugin.surfaces.fitting import fitted
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import area_vectors, vertex_normals
from beags_plugin.system.progress import progress_bar

LARGEST = 2048  # largest side of a texture whose size is chosen here
_FINE = 1.5  # texels per pixel of the photos, along a side
_NEAREST = 0.75  # share of the photos that may be farther away than the photo that decides


@dataclass(frozen=True)
class Texture:
    """A mesh's charts and their image.

    image: [S, S, 3] uint8, sRGB. from_photos: share of its texels that a photo shows. exposures: [V, 3], by which the
    photos were divided.
    """

    atlas: Atlas
    image: np.ndarray
    from_photos: float
    exposures: np.ndarray


def textured(mesh: Mesh, photos: Sequence[Photo], size: int) -> Texture:
    """Return the texture of a mesh of at least one face; size: its side in texels, 0 for one that suits the photos."""
    photos = [photo.sharper or photo for photo in photos]
    density = 0.0 if size else suitable_density(mesh, photos)
    atlas = unwrapped(mesh, LARGEST, density) if density else unwrapped(mesh, size or SMALLEST)
    with threadpool_limits(1, "openmp"):  # Waking other threads takes longer than torch's many small operations.
        image, seen, exposures = _mean(mesh, photos, atlas)
        with progress_bar("Texture fitted to photos", passing=True) as progress:
            image = fitted(image, atlas, mesh, photos, exposures, progress)
    return Texture(atlas, image, seen, exposures)


def _mean(mesh: Mesh, photos: Sequence[Photo], atlas: Atlas) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the mean of photos as a texture's image, the share of texels that they show, and their exposures."""
    at = texels(atlas)
    normals = at.of(vertex_normals(mesh))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    area = np.linalg.norm(area_vectors(mesh), axis=1).sum()
    places = Places(at.of(mesh.vertices), normals, math.sqrt(area / max(len(at.rows), 1)))
    with progress_bar("Colours from photos", passing=True) as progress:
        mean = baked(places, mesh, photos, at.of(mesh.colors), progress)
    return picture(atlas, at, mean.colors), float(mean.seen.mean()) if len(mean.seen) else 0.0, mean.exposures


def suitable_density(mesh: Mesh, photos: Sequence[Photo]) -> float:
    """Return the texels per unit of the mesh that are slightly finer than pixels of the nearer photos.

    Only photos with the mesh in front of the camera count; without any, it is 0.
    """
    middle = torch.from_numpy((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)
    finest = []
    for photo in photos:
        _, z = project(middle[None], photo.camera.to(torch.float64))
        if float(z[0]) > 0:
            finest.append(photo.camera.focal / float(z[0]))
    return _FINE * float(np.quantile(finest, _NEAREST)) if finest else 0.0
