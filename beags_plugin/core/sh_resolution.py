"""Which bands of the spherical harmonics the views can tell apart, and colours that do with fewer.

A Gaussian's colour is known only in the directions from which cameras see it. Over these directions the functions of
the basis have inner products (means over the views), the Gram matrix G; whatever combination of coefficients G maps
to nothing, no view can see.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.sh import num_sh_bases, sh_basis
from beags_plugin.core.surfels import Surfels

CHUNK = 4096  # Gaussians at a time: 8 MB of Gram matrices at degree 3
TOLERANCE = 1.0 / 255.0  # coefficients of length 1 that change the colour by less than an 8-bit step are not seen


def gram_matrices(means: Tensor, cameras: Sequence[Camera], degree: int) -> Tensor:
    """[N, K, K] float64, G of each Gaussian over the cameras in whose image its centre lies; 0 where there is none.

    means: [N, 3] world. K = (degree + 1)^2. Every view counts the same.
    """
    points = means.detach().double()
    gram = points.new_zeros(len(points), num_sh_bases(degree), num_sh_bases(degree))
    views = points.new_zeros(len(points))
    for camera in cameras:
        seen = inside(points, camera)
        center = camera.to(points.device, torch.float64).center
        basis = sh_basis(torch.nn.functional.normalize(points[seen] - center, dim=1), degree)
        gram[seen] += basis[:, :, None] * basis[:, None, :]
        views[seen] += 1
    return gram / views.clamp(min=1)[:, None, None]


def inside(points: Tensor, camera: Camera) -> Tensor:
    """[N] bool, whether the points [N, 3] float, world, lie before the camera and project into its image."""
    view = camera.to(points.device, points.dtype)
    x, y, z = ((points @ view.rotation.T + view.translation) @ view.K.T).unbind(1)
    return (z > 0) & (x >= 0) & (y >= 0) & (x < view.width * z) & (y < view.height * z)


def residual_gram(gram: Tensor, low: int, high: int) -> Tensor:
    """[N, high - low, high - low], G of the functions low .. high - 1 less what those before them can imitate."""
    inverse = torch.linalg.pinv(gram[:, :low, :low], hermitian=True, rtol=1e-9)
    mixed = gram[:, :low, low:high]
    return gram[:, low:high, low:high] - mixed.transpose(1, 2) @ inverse @ mixed


def seen_coefficients(gram: Tensor, tolerance: float = TOLERANCE) -> Tensor:
    """[N] int64, how many coefficients of each Gaussian its views can tell apart: the numerical rank of G [N, K, K].

    tolerance: coefficients of length 1 are seen if they change the colour by more, as root mean square over the views.
    """
    return (torch.linalg.eigvalsh(gram) > tolerance**2).sum(1)


def seen_degree(gram: Tensor, degree: int, tolerance: float = TOLERANCE) -> Tensor:
    """[N] int64, the highest degree up to which all bands are told apart from those below; -1 for what nobody sees.

    gram: [N, K, K]. tolerance: as in ``seen_coefficients``, of what the lower bands cannot imitate.
    """
    found = torch.full((len(gram),), -1, dtype=torch.int64, device=gram.device)
    whole = torch.ones_like(found, dtype=torch.bool)
    for band in range(degree + 1):
        rest = residual_gram(gram, band * band, num_sh_bases(band))
        whole &= torch.linalg.eigvalsh(rest)[:, 0] > tolerance**2
        found[whole] = band
    return found


def with_degree(surfels: Surfels, cameras: Sequence[Camera], degree: int) -> Surfels:
    """The scene with bands up to ``degree`` only; these imitate the ones left out as well as they can in the views.

    surfels: N surfels of ``degree`` or more. Least squares over the views that see a Gaussian, each counting the same;
    of equally good colours the one that changes least, so that a Gaussian which nobody sees just loses its bands.
    """
    if degree >= surfels.sh_degree:
        return surfels
    low = num_sh_bases(degree)
    sh = torch.cat([surfels.sh_dc[:, None], surfels.sh_rest], dim=1).detach()
    kept = sh[:, :low].clone()
    for part in _parts(len(sh)):
        gram = gram_matrices(surfels.means[part], cameras, surfels.sh_degree)
        inverse = torch.linalg.pinv(gram[:, :low, :low], hermitian=True, rtol=1e-9)
        kept[part] += (inverse @ (gram[:, :low, low:] @ sh[part, low:].double())).to(sh.dtype)
    bare = surfels.detach()
    return Surfels.of(bare.means, bare.quats, bare.log_scales, bare.opacity_logits, kept)


def seen_shares(
    means: Tensor, cameras: Sequence[Camera], degree: int, tolerance: float = TOLERANCE
) -> tuple[float, Tensor]:
    """The share of all coefficients that views tell apart, and [degree + 2] the share of the Gaussians of each
    ``seen_degree``, -1 first.

    means: [N, 3] world, N >= 1.
    """
    told, degrees = 0, torch.zeros(degree + 2, dtype=torch.float64)
    for part in _parts(len(means)):
        gram = gram_matrices(means[part], cameras, degree)
        told += int(seen_coefficients(gram, tolerance).sum())
        degrees += torch.bincount(seen_degree(gram, degree, tolerance) + 1, minlength=degree + 2).cpu()
    return told / (len(means) * num_sh_bases(degree)), degrees / len(means)


def _parts(count: int) -> Iterator[slice]:
    return (slice(first, first + CHUNK) for first in range(0, count, CHUNK))
