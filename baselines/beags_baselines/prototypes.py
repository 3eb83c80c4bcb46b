"""InstaScene's contrast of features with the means of their classes, and its choice of members by them.

With features E_a of samples a, g = E / (|E| + 1e-9), whose norm has no gradient, and u_c the mean of g over the n_c
samples of class c, not of unit length,

    phi_c = clip(10 sum |g - u_c| / (n_c ln(n_c + 1000)), 1/2, 1)    without gradient,
    P     = - sum_a ln( exp(g_a . u_c(a) / phi_c(a)) / (sum_c exp(g_a . u_c / phi_c) + 1e-9) ).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding

from beags_plugin.losses.reduction import grouped_sums, ordered_linear, ordered_sum

CHANNELS = 16
COSINE = 0.9


def prototype_loss(features: Tensor, classes: Tensor, prototypes: Tensor | None = None) -> Tensor:
    """Return P of samples; 0 of none.

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
    """Return phi [K] of classes without gradient; g: [S, C]. u: [K, C]. places: [S], of each the class. counts: [K]."""
    with torch.no_grad():
        residuals = (g - u[places]).square().sum(dim=1, keepdim=True).sqrt()
        sums = grouped_sums(residuals, places, len(u))[:, 0]
        return (10.0 * sums / (counts * (counts + 1000.0).log())).clamp(0.5, 1.0)


def unit(features: Tensor) -> Tensor:
    """Return f / (|f| + 1e-6), [N, C]."""
    return features / (features.square().sum(dim=1, keepdim=True).clamp_min(1e-24).sqrt() + 1e-6)


def rows_of(features: Tensor, rows: Tensor) -> Tensor:
    """Return features[rows]; its gradient is that of any number of threads."""
    return embedding(rows, features)


def orthonormal(count: int, generator: torch.Generator) -> Tensor:
    """Return [count, 16], count at most 16, by Gram-Schmidt of random vectors."""
    random = torch.randn(CHANNELS, count, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(random)[0].T.float().contiguous()


def members(features: Tensor, seeds: Tensor, cosine: float = COSINE) -> tuple[Tensor, bool]:
    """Return which of N Gaussians belong to an object, [N] bool, and whether anybody is like it.

    A member's unit feature has a product of at least ``cosine`` with the mean of the seeds', which is shorter the
    looser these are; if there is none, the seeds are the members. features: [N, C]. seeds: [S] int64.
    """
    found = torch.zeros(len(features), dtype=torch.bool, device=features.device)
    if not len(seeds):
        return found, False
    units = unit(features)
    mean = grouped_sums(units[seeds], torch.zeros_like(seeds), 1)[0] / len(seeds)
    found = (units * mean).sum(dim=1) >= cosine
    if bool(found.any()):
        return found, True
    found[seeds] = True
    return found, False
