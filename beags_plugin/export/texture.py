"""A texture of a mesh: charts, and the photos' colours in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from beags_plugin.core.lifting import project
from beags_plugin.export.atlas import Atlas, picture, texels, unwrapped
from beags_plugin.export.baking import Places, baked
from beags_plugin.export.base import Photo
from beags_plugin.export.fusion import Mesh
from beags_plugin.export.surface import area_vectors, vertex_normals
from beags_plugin.system.progress import progress_bar

SMALLEST, LARGEST = 128, 4096  # sides of textures that are chosen here
_FILLED = 0.6  # share of an atlas that its charts take, about
_FINE = 1.5  # texels for a pixel of the photos along a side
_NEAREST = 0.75  # share of the photos that may be farther away than the one that decides


@dataclass(frozen=True)
class Texture:
    """A mesh's charts and their picture.

    image: [S, S, 3] uint8, sRGB. from_photos: share of its texels that a photo shows. exposures: [V, 3] of the photos,
    as they were evened out.
    """

    atlas: Atlas
    image: np.ndarray
    from_photos: float
    exposures: np.ndarray


def textured(mesh: Mesh, photos: Sequence[Photo], size: int) -> Texture:
    """Return the texture of a mesh of at least one face; size: its side in texels, 0 for one that suits the photos."""
    atlas = unwrapped(mesh, size or suitable_size(mesh, photos))
    at = texels(atlas)
    normals = at.of(vertex_normals(mesh))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    area = np.linalg.norm(area_vectors(mesh), axis=1).sum()
    places = Places(at.of(mesh.vertices), normals, math.sqrt(area / max(len(at.rows), 1)))
    with progress_bar("Colours from photos", passing=True) as progress:
        found = baked(places, mesh, photos, at.of(mesh.colors), progress)
    image = picture(atlas, at, found.colors)
    return Texture(atlas, image, float(found.seen.mean()) if len(found.seen) else 0.0, found.exposures)


def suitable_size(mesh: Mesh, photos: Sequence[Photo]) -> int:
    """Return the power of two at which a texel is a bit finer than a pixel of the nearer photos."""
    middle = torch.from_numpy((mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2)
    finest = []
    for photo in photos:
        _, z = project(middle[None], photo.camera.to(torch.float64))
        finest.append(photo.camera.focal / float(z[0]) if float(z[0]) > 0 else 0.0)
    density = _FINE * float(np.quantile(finest, _NEAREST)) if finest else 0.0
    area = np.linalg.norm(area_vectors(mesh), axis=1).sum()
    side = density * math.sqrt(area / _FILLED)
    return int(np.clip(2 ** math.ceil(math.log2(max(side, 1.0))), SMALLEST, LARGEST))
