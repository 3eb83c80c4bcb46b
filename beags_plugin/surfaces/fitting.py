"""Fit a texture to photos: renders of the mesh shall equal the photos' pixels in the least squares.

The mean of photos is blurred: each of its texels lies between the pixels of each photo, and renderers interpolate
between texels once more. Pixels are linear in texels, so the texels that reproduce the photos solve a sparse least
squares problem, which starts from the mean and is regularised towards it (after Goldluecke and Cremers,
"Superresolution texture maps for multiview reconstruction", 2009).

Determinism: the solver runs on one thread of BLAS, whose sums depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from beags_plugin.core.lifting import hides
from beags_plugin.surfaces.atlas import Atlas
from beags_plugin.surfaces.baking import FLATTEST, well_inside
from beags_plugin.surfaces.color import linear_from_srgb, srgb_from_linear
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import Photo
from beags_plugin.surfaces.surface import corner_weights, rays_through, surface_of

_RAYS = 0.25 * np.array([[1.0, 1.0], [3.0, 1.0], [1.0, 3.0], [3.0, 3.0]])  # positions of rays in a pixel
_MOST = 1_000_000  # pixels of all photos, about 200 bytes each; with more, the mean is sharp enough
_HOLD = 0.2  # weight of the mean, in photos' pixels (chosen on tabletop 0 and room 0: notes/export.md)
_STEPS = 20  # iterations of the solver; more sharpen more, and amplify noise


def fitted(
    image: np.ndarray,
    atlas: Atlas,
    mesh: Mesh,
    photos: Sequence[Photo],
    exposures: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> np.ndarray:
    """Return a mesh's texture [S, S, 3] uint8 sRGB, fitted to photos; image: the mean of the photos, as a texture.

    exposures: [V, 3] of the photos, which are divided by them. The image does not change where no photo shows a texel,
    nor at all if more than a million pixels of photos show it. progress: receives (done, total) photos.
    """
    from scipy.sparse.linalg import LinearOperator, lsmr
    from threadpoolctl import threadpool_limits

    if not photos:
        return image
    inside = 0
    for photo in photos:
        inside += int(well_inside(photo).sum())
        if inside > _MOST:  # A selection of pixels would sharpen the texture unevenly.
            return image
    matrix, target, used = _system(atlas, mesh, photos, exposures, progress)
    if not len(target):
        return image
    # SciPy would copy the matrix for each product with it, to convert it, and for its transpose.
    products: dict[str, Any] = {"matvec": matrix.dot, "rmatvec": matrix.T.dot}
    operator = LinearOperator(dtype=np.float64, shape=matrix.shape, **products)
    texels = image.reshape(-1, 3)[used] / 255.0
    with threadpool_limits(1, "blas"):
        for channel in range(3):
            missing = target[:, channel] - matrix @ texels[:, channel]
            texels[:, channel] += lsmr(operator, missing, damp=math.sqrt(_HOLD), atol=0, btol=0, maxiter=_STEPS)[0]
    new = image.reshape(-1, 3).copy()
    new[used] = np.round(255.0 * np.clip(texels, 0.0, 1.0))
    return new.reshape(image.shape)


def _system(
    atlas: Atlas,
    mesh: Mesh,
    photos: Sequence[Photo],
    exposures: np.ndarray,
    progress: Callable[[int, int], None],
) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return the sparse matrix [M, U] float64 that makes pixels of texels, the pixels [M, 3], and the texels [U] used.

    Pixels have the mean exposure, texels are numbered row by row.
    """
    from scipy.sparse import csr_array

    caster, blocks, pixels = surface_of(mesh), [], []
    for done, (photo, exposure) in enumerate(zip(photos, exposures, strict=True), start=1):
        columns, shares, colors = _pixels(photo, atlas, mesh, caster)
        starts = np.arange(0, columns.size + 1, columns.shape[1], dtype=np.int32)
        block: Any = csr_array((shares.reshape(-1), columns.reshape(-1), starts), shape=(len(columns), atlas.size**2))
        block.sum_duplicates()  # A pixel's rays mostly share texels.
        blocks.append((block.data.copy(), block.indices.copy(), np.diff(block.indptr)))
        pixels.append(srgb_from_linear(linear_from_srgb(colors) / exposure))
        progress(done, len(photos))
    data, columns, counts = (np.concatenate(each) for each in zip(*blocks, strict=True))
    del blocks
    target = np.concatenate(pixels)
    visible = np.zeros(atlas.size**2, bool)
    visible[columns] = True
    columns = (np.cumsum(visible, dtype=np.int32) - 1)[columns]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    used = np.flatnonzero(visible)
    return csr_array((data.astype(np.float64), columns, starts), shape=(len(target), len(used))), target, used


def _pixels(photo: Photo, atlas: Atlas, mesh: Mesh, caster: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the texels that the pixels of a photo show, [M, 16] int32, their shares [M, 16] and the pixels [M, 3].

    Only pixels well inside the item's mask count, whose rays all meet the outside of the mesh at no flat angle, with
    nothing of the scene in front of it. Texels are numbered row by row.
    """
    rows, cols = np.nonzero(well_inside(photo))
    xy = (np.stack([cols, rows], axis=1)[:, None] + _RAYS).reshape(-1, 2)
    rays, directions = rays_through(mesh, photo.camera, xy)
    hit = caster.cast_rays(rays)
    depth, normals = hit["t_hit"].numpy(), hit["primitive_normals"].numpy()
    cosine = -np.einsum("pd,pd->p", normals, directions) / np.linalg.norm(directions, axis=1)
    scene = np.repeat(photo.depth().numpy()[rows, cols], len(_RAYS))
    good = np.isfinite(depth) & (cosine > FLATTEST) & ~hides(scene, depth)
    whole = good.reshape(-1, len(_RAYS)).all(axis=1)
    rays_of = np.repeat(whole, len(_RAYS))
    face = hit["primitive_ids"].numpy()[rays_of].astype(np.int64)
    uv = np.einsum("pc,pcd->pd", corner_weights(hit["primitive_uvs"].numpy()[rays_of]), atlas.uv[atlas.faces[face]])
    columns, shares = _between(uv, atlas.size)
    pixels = photo.image().numpy()[rows[whole], cols[whole]].astype(np.float64)
    shape = (len(pixels), 4 * len(_RAYS))
    return columns.reshape(shape), (shares / len(_RAYS)).astype(np.float32).reshape(shape), pixels


def _between(uv: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the four texels [P, 4] int32 nearest to coordinates uv [P, 2], and their shares [P, 4]."""
    at = np.clip(uv * size - 0.5, 0.0, size - 1.0)
    first = np.minimum(np.floor(at).astype(np.int32), size - 2)
    x, y = (at - first).T
    column, row = first.T
    columns = np.stack([row * size + column + step for step in (0, 1, size, size + 1)], axis=1)
    return columns, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
