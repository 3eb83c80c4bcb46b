"""The graph of a scene's surface: near Gaussians are linked, strongly if nothing between them looks like a border.

Between touching solids a surface has a concave crease (Stein, Schoeler, Papon, Woergoetter, "Object Partitioning using
Local Convexity", CVPR 2014), or a step to another sheet in front of it; within one solid it is flat or convex. For
linked Gaussians i and j, mu is the centre, n the normal towards the cameras, c the colour of degree 0, and
u = (mu_j - mu_i) / |mu_j - mu_i|. The link has the weight

    w_ij = 1e-5 + exp(-(30 [(n_i - n_j) . u]+^2 + 0.5 [(n_j - n_i) . u]+^2 + 30 ((n_i + n_j) . u / 2)^2
                        + 2 |c_i - c_j|^2 + 0.2 |mu_i - mu_j| / s))

The terms are for a concave crease, a convex crease, a step (0 on a round surface, whose mean normal is perpendicular to
each chord), the colours, and the distance in units of s, the median distance.

Gaussians are smaller where there is more detail, as at contacts. At half the distance, twice as many links cross a
border and four times as many Gaussians lie within it; so a cut link counts as sqrt(l_i l_j) of a border's length, and a
Gaussian as l_i^2 of the area, where l_i is the mean length of its links in s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.picking.dots import dots

NEIGHBOURS = 20
LEAST_WEIGHT = 0.3  # least weight over all views, in pixels, of a Gaussian of the visible surface
CONCAVE, CONVEX, STEP, COLOR, DISTANCE = 30.0, 0.5, 30.0, 2.0, 0.2
# Bounds of points on a tangent plane: height in s, height per unit of distance, least cosine between normals.
PLANE_HEIGHT, PLANE_SLOPE, PLANE_COSINE = 0.5, 0.02, 0.95
FLOOR = 1e-5  # least weight of a link, so that a noisy normal stops no walk
SHORTEST, LONGEST = 0.1, 3.0  # bounds of l, so that neither coincident nor isolated Gaussians dominate
SMOOTHING_ROUNDS, SMOOTHING_POWER = 2, 8  # neighbours turned by 30 degrees have a third of the weight


@dataclass(frozen=True)
class SurfaceGraph:
    """The linked Gaussians of a scene of N.

    nodes: [M] int64, the Gaussians that cameras see, ascending. nearest: [N] int64, the node nearest to each Gaussian,
    itself for a node. first, second: [P] int64, linked nodes, each pair once. weights, lengths: [P] float64, w_ij and
    sqrt(l_i l_j). areas: [M] float64, l_i^2. centres: [M, 3] float64, scene units. normals: [M, 3] float64, unit
    vectors. spacing: s, scene units.
    """

    nodes: np.ndarray
    nearest: np.ndarray
    first: np.ndarray
    second: np.ndarray
    weights: np.ndarray
    lengths: np.ndarray
    areas: np.ndarray
    centres: np.ndarray
    normals: np.ndarray
    spacing: float

    def on_plane_of(self, chosen: np.ndarray) -> np.ndarray:
        """Return which nodes lie on the tangent plane of one of the nodes ``chosen`` [M] bool, [M] bool.

        The tolerance grows with the distance, because of the normal's error.
        """
        on_plane = chosen.copy()
        for centre, normal in zip(self.centres[chosen], self.normals[chosen], strict=True):
            between = self.centres - centre
            height = np.abs(dots(between, normal))
            limit = PLANE_HEIGHT * self.spacing + PLANE_SLOPE * np.sqrt(dots(between, between))
            on_plane |= (height < limit) & (dots(self.normals, normal) > PLANE_COSINE)
        return on_plane


def surface_graph(surfels: Surfels, seen: np.ndarray, normals: np.ndarray) -> SurfaceGraph:
    """Return the graph of N Gaussians; ``seen`` [N] and ``normals`` [N, 3] as of ``sight.seen_from``; M may be 0."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    nodes = np.flatnonzero(seen > LEAST_WEIGHT)
    means = torch.nan_to_num(surfels.means.detach().double().cpu(), posinf=0.0, neginf=0.0).numpy()
    centres, count = means[nodes], len(nodes)
    if count == 0:
        nothing, values, vectors = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))
        nearest = np.zeros(len(means), np.int64)
        return SurfaceGraph(nodes, nearest, nothing, nothing, values, values, values, vectors, vectors, 1.0)
    tree = cKDTree(centres)
    threads = torch.get_num_threads()
    near = tree.query(centres, k=np.arange(1, min(NEIGHBOURS + 1, count) + 1), workers=threads)[1]
    own = np.arange(count)[:, None]
    low, high = np.minimum(near, own), np.maximum(near, own)
    keys = np.unique((low * count + high)[near != own])
    first, second = keys // count, keys % count
    smooth = smoothed(normals[nodes], seen[nodes], first, second)
    dc = torch.nan_to_num(surfels.sh_dc.detach().double().cpu())
    colors = sh_colors(dc, dc.new_zeros(len(dc), 0, 3), dc, dc.new_zeros(3), degree=0)
    nearest = np.empty(len(means), np.int64)
    nearest[nodes] = np.arange(count)
    others = np.setdiff1d(np.arange(len(means)), nodes)
    nearest[others] = tree.query(means[others], workers=threads)[1]
    apart = centres[second] - centres[first]
    lengths = np.sqrt(dots(apart, apart))
    spacing = max(float(np.median(lengths)) if len(lengths) else 1.0, 1e-30)
    weights = link_weights(centres / spacing, smooth, colors.clamp(0.0, 1.0).numpy()[nodes], first, second)
    own = mean_lengths(lengths / spacing, first, second, count)
    cut_lengths = np.sqrt(own[first] * own[second])
    return SurfaceGraph(nodes, nearest, first, second, weights, cut_lengths, own**2, centres, smooth, spacing)


def mean_lengths(lengths: np.ndarray, first: np.ndarray, second: np.ndarray, count: int) -> np.ndarray:
    """Return l_i [M] of M nodes, between ``SHORTEST`` and ``LONGEST``; lengths: [P] of the links, in s."""
    sums = np.bincount(first, lengths, count) + np.bincount(second, lengths, count)
    links = np.bincount(first, minlength=count) + np.bincount(second, minlength=count)
    return (sums / links.clip(1)).clip(SHORTEST, LONGEST)


def smoothed(normals: np.ndarray, seen: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return unit normals [M, 3] averaged over linked Gaussians that face alike, weighted by sqrt(``seen``)."""
    from scipy.sparse import csr_array

    count, root = len(normals), np.sqrt(seen)
    rows = np.concatenate([first, second, np.arange(count)])
    columns = np.concatenate([second, first, np.arange(count)])
    for _ in range(SMOOTHING_ROUNDS):
        alike = dots(normals[first], normals[second]).clip(0.0, 1.0) ** SMOOTHING_POWER
        values = np.concatenate([alike * root[second], alike * root[first], root])
        mixed = np.asarray(csr_array((values, (rows, columns)), shape=(count, count)) @ normals)
        normals = mixed / np.sqrt(dots(mixed, mixed))[:, None].clip(1e-12)
    return normals


def link_weights(
    centres: np.ndarray, normals: np.ndarray, colors: np.ndarray, first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Return w_ij [P] of links between M Gaussians. centres (in s), normals (unit), colors (0..1): [M, 3]."""
    between = centres[second] - centres[first]
    lengths = np.sqrt(dots(between, between))
    direction = between / lengths.clip(1e-12)[:, None]
    one, other = (dots(normals[each], direction) for each in (first, second))
    change = colors[first] - colors[second]
    change = dots(change, change)
    cost = (
        CONCAVE * (one - other).clip(0) ** 2 + CONVEX * (other - one).clip(0) ** 2 + STEP * (0.5 * (one + other)) ** 2
    )
    return np.exp(-(cost + COLOR * change + DISTANCE * lengths)) + FLOOR
