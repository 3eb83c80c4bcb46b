"""Connected parts of an object: Gaussians whose footprints meet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.rasterizers.interface import MIN_ALPHA

GAP = 0.02  # side of a cell over the object's longest side; footprints in neighbouring cells are connected
_REACH = 2.0  # radius of a disc's footprint, standard deviations
_MOST = 17  # largest number of points along each axis of a disc
_BULK = 0.01  # share of the Gaussians at each side that the object's size leaves out, because some are strays
_FURTHEST = 1000.0  # distance from the object's middle, in its sides, to which points are clamped: keys are bounded


def connected_parts(surfels: Surfels, gap_share: float = GAP) -> np.ndarray:
    """Return [N] int64, the part of each of an object's Gaussians, from 0; -1 for those that no image can show.

    Points on each disc, up to two standard deviations from its centre, are put into cubic cells; Gaussians in one cell
    or in neighbouring ones are connected. Memory is linear in the Gaussians.

    surfels: N Gaussians of one object, world. Those that are not finite or fainter than 1/255 are in no part.
    gap_share: side of a cell over the object's longest side, at least ``GAP``.
    """
    bare = surfels.detach()
    means = bare.means.double().cpu().numpy()
    scales = bare.log_scales.double().exp().cpu().numpy()
    axes = rotation_from_quat(bare.quats.double()).cpu().numpy()
    visible = (opacities(bare.opacity_logits.double()) >= MIN_ALPHA).cpu().numpy()
    visible &= np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(axes).all((1, 2))
    parts = np.full(len(surfels), -1, np.int64)
    if not visible.any():
        return parts
    low, high = np.quantile(means[visible], [_BULK, 1.0 - _BULK], axis=0)
    side = float((high - low).max()) or float(scales[visible].max())
    if not side > 0:
        parts[visible] = 0
        return parts
    gap, middle = gap_share * side, (low + high) / 2
    half_axes = axes[:, :, :2] * scales[:, None, :]
    cells, owners = [], []
    for owner, points in _footprints(means, half_axes, scales / gap, np.flatnonzero(visible)):
        away = np.clip((points - middle) / gap, -_FURTHEST / gap_share, _FURTHEST / gap_share)
        pairs = np.unique(np.stack([_key(np.floor(away).astype(np.int64)), owner]), axis=1)
        cells.append(pairs[0])
        owners.append(pairs[1])
    parts[visible] = _joined(np.concatenate(cells), np.concatenate(owners), len(surfels))[visible]
    return parts


_SIDE = int(4 * _FURTHEST / GAP)  # cells along each axis, with room for neighbours


def _key(cell: np.ndarray) -> np.ndarray:
    """Return [...] int64 keys of cells [..., 3] int64."""
    x, y, z = np.moveaxis(cell + _SIDE // 2, -1, 0)
    return (x * _SIDE + y) * _SIDE + z


def _footprints(
    means: np.ndarray, half_axes: np.ndarray, cells: np.ndarray, chosen: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (owner [P] int64, points [P, 3]) on the discs ``chosen``, grouped by their numbers of points.

    means: [N, 3]. half_axes: [N, 3, 2], the axes as long as the standard deviations. cells: [N, 2] standard deviations
    in cells.
    """
    counts = np.minimum(np.ceil(_REACH * cells[chosen]), _MOST // 2).astype(np.int64)  # points on each side of a centre
    for along_u, along_v in np.unique(counts, axis=0).tolist():
        own = chosen[(counts == (along_u, along_v)).all(1)]
        u, v = (_REACH * np.arange(-n, n + 1) / max(n, 1) for n in (along_u, along_v))
        uv = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        uv = uv[(uv**2).sum(1) <= _REACH**2 * (1 + 1e-9)]
        # Determinism: a library's matrix product may round otherwise than these sums of two products.
        offsets = half_axes[own, None, :, 0] * uv[:, :1] + half_axes[own, None, :, 1] * uv[:, 1:]
        yield np.repeat(own, len(uv)), (means[own, None] + offsets).reshape(-1, 3)


def _joined(cells: np.ndarray, owners: np.ndarray, count: int) -> np.ndarray:
    """Return the component of each Gaussian, [count]; cells: [P], keys of the cells that ``owners`` [P] reach."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    keys, place = np.unique(cells, return_inverse=True)
    near = torch.cartesian_prod(*3 * [torch.arange(-1, 2)]).numpy()
    steps = [
        step for step in (_key(near) - _key(np.zeros(3, np.int64))).tolist() if step > 0
    ]  # Half of the steps meet each pair once.
    ends = [(place, len(keys) + owners)]
    for step in steps:
        neighbour = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        occupied = np.flatnonzero(keys[neighbour] == keys + step)
        ends.append((occupied, neighbour[occupied]))
    rows, columns = (np.concatenate(side) for side in zip(*ends, strict=True))
    size = len(keys) + count
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(size, size))
    _, component = connected_components(graph, directed=False)
    _, parts = np.unique(component[len(keys) :], return_inverse=True)
    return parts
