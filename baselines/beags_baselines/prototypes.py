"""InstaScene's loss between features and the means of their classes, and its choice of members by these means.

With features E_a of samples a, g = E / (|E| + 1e-9), whose norm has no gradient, and u_c the mean of g over the n_c
samples of class c, not of unit length,

    phi_c = clip(10 sum |g - u_c| / (n_c ln(n_c + 1000)), 1/2, 1)    without gradient,
    P     = - sum_a ln( exp(g_a . u_c(a) / phi_c(a)) / (sum_c exp(g_a . u_c / phi_c) + 1e-9) ).
"""

from __future__ import annotations

import torch
from torch import Tensor

from beags_baselines.grouped_sums import grouped_sums
from beags_plugin.losses.reduction import ordered_linear, ordered_sum

CHANNELS = 16
COSINE = 0.9


def prototype_loss(features: Tensor, classes: Tensor, prototypes: Tensor | None = None) -> Tensor:
    """Return P of samples; 0 without samples.

    features: [S, C]. classes: [S] int64, ranks. prototypes: [K, C], fixed u_c in place of the samples' means.
    """
    if not len(features):
        return ordered_sum(features)
    present, places = torch.unique(classes, return_inverse=True)
    lengths = features.detach().square().sum(dim=1, keepdim=True).sqrt()
    g = features / (lengths + 1e-9)
    counts = torch.bincount(places, minlength=len(present)).to(g.dtype)
    u = grouped_sums(g, places, len(present)) / counts[:, None] if prototypes is None else prototypes[present]
    logits = ordered_linear(g, u / temperatures(g, u, places, counts)[:, None], g.new_zeros(len(present)))
    own = logits.gather(1, places[:, None])[:, 0]
    return ordered_sum((logits.exp().sum(dim=1) + 1e-9).log() - own)


def temperatures(g: Tensor, u: Tensor, places: Tensor, counts: Tensor) -> Tensor:
    """Return phi [K] without gradient. g: [S, C]. u: [K, C]. places: [S], the class of each sample. counts: [K]."""
    with torch.no_grad():
        residuals = (g - u[places]).square().sum(dim=1, keepdim=True).sqrt()
        sums = grouped_sums(residuals, places, len(u))[:, 0]
        return (10.0 * sums / (counts * (counts + 1000.0).log())).clamp(0.5, 1.0)


def unit(features: Tensor) -> Tensor:
    """Return f / (|f| + 1e-6), [N, C]."""
    return features / (features.square().sum(dim=1, keepdim=True).clamp_min(1e-24).sqrt() + 1e-6)


def orthonormal(count: int, generator: torch.Generator) -> Tensor:
    """Return [count, 16] orthonormal rows from random vectors; count is at most 16."""
    random = torch.randn(CHANNELS, count, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(random)[0].T.float().contiguous()


def members(features: Tensor, seeds: Tensor, cosine: float = COSINE) -> tuple[Tensor, bool]:
    """Return the members of an object, [N] bool, and whether any Gaussian is similar to it.

    A Gaussian is similar if its unit feature has a product of at least ``cosine`` with the mean of the seeds' unit
    features, which is the shorter the more these differ. If none is, the seeds are the members. features: [N, C].
    seeds: [S] int64.
    """
    inside = torch.zeros(len(features), dtype=torch.bool, device=features.device)
    if not len(seeds):
        return inside, False
    units = unit(features)
    mean = grouped_sums(units[seeds], torch.zeros_like(seeds), 1)[0] / len(seeds)
    inside = (units * mean).sum(dim=1) >= cosine
    if bool(inside.any()):
        return inside, True
    inside[seeds] = True
    return inside, False
