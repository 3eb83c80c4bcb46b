"""GaussianCut: one minimum cut of a graph of the Gaussians separates each object from the rest; nothing is trained.

Jain, Mirzaei, Gilitschenski, "GaussianCut: Interactive Segmentation via Graph Cut for 3D Gaussian Splatting",
NeurIPS 2024. For Gaussian i, mu_i is the centre, d_i the spherical-harmonic coefficient of degree 0 (not the colour),
and w_i the share of its blending weight on the object's pixels, 0 if never seen. The object minimises

    E = sum_{i in object} (1 - w_i + l(i, R)) + sum_{i not in it} (w_i + l(i, F)) + sum_{links between both} b_ij,
    b_ij = 0.5 exp(-|mu_i - mu_j|) + 0.5 exp(-|d_i - d_j|), twice if both are among each other's nearest,
    l(i, S) = 0.5 exp(-0.1 min_m |mu_i - m|) + 0.5 exp(-|d_i - mean d of S|),

where F are the Gaussians with w >= ``foreground_threshold``, R all others, and m the five k-means centres of S.
Distances are in the units of the centres. The result depends on them, so that they should be those of the input.
Small, thin or embedded objects lose to the rest, as in the source: their links cost more than their shares are worth.

Differences from the source: the solver is scipy's, whose capacities are int32, here multiples of 2^-16, and only the
difference of a node's two terminals enters, which changes no cut; ties go to the object; a set of fewer than five
Gaussians has as many clusters as Gaussians, where the source fails; an object without F is empty; Gaussians that are
not finite are put at the origin.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.minimum_cut import cut

NUM_EDGES = 10
"""Nearest centres to which a Gaussian is linked, including its own."""
FOREGROUND_THRESHOLD = 0.9
"""Share from which a Gaussian belongs to F; the source uses 0.3 for captures all around."""

CLUSTERS = 5
TERMINAL_DECAY = 0.1  # decay per unit of distance to a cluster; that of links and colours is 1


def members(
    means: Tensor,
    sh_dc: Tensor,
    shares: Tensor,
    links: tuple[Tensor, Tensor],
    foreground_threshold: float = FOREGROUND_THRESHOLD,
) -> Tensor:
    """Return the Gaussians of one object, [N] bool; none if no share reaches the threshold.

    means, sh_dc: [N, 3]. shares: [N], w. links: result of ``n_links``, the same for all objects.
    """
    if not bool((shares.double() >= foreground_threshold).any()):
        return torch.zeros_like(shares, dtype=torch.bool)
    return cut(*links, terminals(means, sh_dc, shares, foreground_threshold)).to(shares.device)


def n_links(means: Tensor, sh_dc: Tensor, num_edges: int = NUM_EDGES) -> tuple[Tensor, Tensor]:
    """Return the linked pairs [P, 2] int64, first < second, each once, and their capacities [P] float64, on the CPU.

    means, sh_dc: [N, 3]. P <= (num_edges - 1) N, or a little more if centres coincide.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    centres, dc = _finite(means), _finite(sh_dc)
    count = len(centres)
    near = cKDTree(centres).query(centres, k=np.arange(1, min(num_edges, count) + 1))[1]
    own = np.arange(count)[:, None]
    first, second = np.minimum(near, own), np.maximum(near, own)
    keys, times = np.unique((first * count + second)[near != own], return_counts=True)
    first, second = keys // count, keys % count
    likeness = np.exp(-_distance(centres[first], centres[second])) + np.exp(-_distance(dc[first], dc[second]))
    return torch.from_numpy(np.stack([first, second], 1)), torch.from_numpy(0.5 * times * likeness)


def terminals(
    means: Tensor, sh_dc: Tensor, shares: Tensor, foreground_threshold: float = FOREGROUND_THRESHOLD
) -> Tensor:
    """Return the capacities [N, 2] float64 from the source (object) and to the sink (rest), on the CPU.

    means, sh_dc: [N, 3]. shares: [N], w. l(i, S) of an empty set is 0.
    """
    centres, dc, w = _finite(means), _finite(sh_dc), _finite(shares)
    foreground = w >= foreground_threshold
    to_object, to_rest = (_likeness(centres, dc, chosen) for chosen in (foreground, ~foreground))
    return torch.from_numpy(np.stack([w + to_object, 1.0 - w + to_rest], 1))


def _likeness(centres: np.ndarray, dc: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return l(i, S) [N] for the set S of ``chosen`` [N] bool."""
    if not chosen.any():
        return np.zeros(len(centres))
    from sklearn.cluster import KMeans

    few = min(CLUSTERS, int(chosen.sum()))
    clusters = KMeans(few, n_init=1, random_state=0)  # pyright: ignore[reportArgumentType]  (or "auto")
    nearest = np.min([_distance(centres, mean) for mean in clusters.fit(centres[chosen]).cluster_centers_], axis=0)
    return 0.5 * np.exp(-TERMINAL_DECAY * nearest) + 0.5 * np.exp(-_distance(dc, dc[chosen].mean(axis=0)))


def _finite(values: Tensor) -> np.ndarray:
    """Return float64 values; those that are not finite, of Gaussians that no view shows, are 0."""
    return torch.nan_to_num(values.detach().double().cpu(), nan=0.0, posinf=0.0, neginf=0.0).numpy()


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)
