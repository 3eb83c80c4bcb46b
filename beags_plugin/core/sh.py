"""Colour that depends on the viewing direction: real spherical harmonics of degree 0 to 3 (method, section 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension
from beags_plugin.ops import sh_colors as compiled

MAX_DEGREE = 3

# Normalisation of the real basis, band by band: the integral of each squared function over the sphere is 1. Signs and
# order are those that splat files use, so that their colours are right.
SH_C0 = 0.28209479177387814  # 1/2 sqrt(1 / pi)
_C1 = 0.4886025119029199  # 1/2 sqrt(3 / pi)
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)  # 1/2 sqrt(15/pi), 1/4 sqrt(5/pi), 1/4 sqrt(15/pi)
_C3 = (
    0.5900435899266435,  # 1/4 sqrt(35 / (2 pi))
    2.890611442640554,  # 1/2 sqrt(105 / pi)
    0.4570457994644658,  # 1/4 sqrt(21 / (2 pi))
    0.3731763325901154,  # 1/4 sqrt(7 / pi)
    1.445305721320277,  # 1/4 sqrt(105 / pi)
)


def num_sh_bases(degree: int) -> int:
    """Return the number of coefficients per channel up to ``degree``."""
    return (degree + 1) ** 2


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Return the basis functions at unit ``directions`` [N, 3]: [N, (degree + 1)^2]; degree 0..3."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"the degree of spherical harmonics must be 0..{MAX_DEGREE}, not {degree}")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        values += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (3 * z * z - 1),
            -_C2[0] * x * z,
            _C2[2] * (x * x - y * y),
        ]
    if degree >= 3:
        values += [
            -_C3[0] * y * (3 * x * x - y * y),
            _C3[1] * x * y * z,
            -_C3[2] * y * (5 * z * z - 1),
            _C3[3] * z * (5 * z * z - 3),
            -_C3[2] * x * (5 * z * z - 1),
            _C3[4] * z * (x * x - y * y),
            -_C3[0] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)


def sh_colors(sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_center: Tensor, degree: int) -> Tensor:
    """Return the colour of each Gaussian as seen from ``camera_center``: SH + 0.5, clamped at 0.

    sh_dc: [N, 3], degree 0. sh_rest: [N, K, 3], the others, K >= (degree + 1)^2 - 1. means: [N, 3] world.
    camera_center: [3] world, on any device. Returns [N, 3]. Computed by the compiled op where it can be.
    """
    constant = camera_center.dtype == means.dtype and not camera_center.requires_grad
    if constant and cuda_extension.supports(sh_dc, sh_rest, means):
        return compiled.sh_colors(sh_dc, sh_rest, means, camera_center, degree)
    if degree == 0:
        return (SH_C0 * sh_dc + 0.5).clamp_min(0.0)
    # A Gaussian at the camera has direction 0: normalize divides by 1e-12 at least.
    directions = torch.nn.functional.normalize(means - camera_center.to(means), dim=-1)
    basis = sh_basis(directions, degree)
    sh = torch.cat([sh_dc[:, None], sh_rest[:, : basis.shape[1] - 1]], dim=1)
    return (torch.einsum("nk,nkc->nc", basis, sh) + 0.5).clamp_min(0.0)
