"""The affine map of colours that brings a rendering nearest to its photo."""

from __future__ import annotations

import torch
from torch import Tensor

STILL = 1e-5
"""Standard deviation of colours, values in 0..1, below which a direction of colour space tells nothing about its slope.

A step of 8 bits is 4e-3. The bound keeps the rounding errors of an image of one colour from being amplified."""


def affine_color_fit(rendered: Tensor, photo: Tensor, where: Tensor | None = None) -> Tensor:
    """Return the affine colour map that minimises the squared error of the mapped rendering against the photo.

    rendered, photo: [..., 3] float, values as scored or trained on. where: [...] bool, the pixels to fit, or None for
    all; pixels with a value that is not finite never count. Returns [3, 4] float64, the matrix followed by the
    offset. Where several maps fit alike, as for a rendering of one colour, it is the one whose matrix is nearest to the
    identity; without any pixel it is the identity.

    Source: linear least squares in closed form, on centred colours.
    """
    x, y = rendered.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    counted = (torch.isfinite(x) & torch.isfinite(y)).all(dim=-1)
    if where is not None:
        counted = counted & where.reshape(-1)
    x, y = x[counted], y[counted]
    matrix = torch.eye(3, dtype=torch.float64, device=x.device)
    if len(x) == 0:
        return torch.cat([matrix, matrix.new_zeros(3, 1)], dim=1)
    mean_x, mean_y = x.mean(dim=0), y.mean(dim=0)
    x, change = x - mean_x, (y - mean_y) - (x - mean_x)
    # The pseudo-inverse gives the smallest change of the identity that fits best.
    inverse = torch.linalg.pinv(x.T @ x / len(x), atol=STILL**2, rtol=1e-12, hermitian=True)
    matrix = matrix + (inverse @ (x.T @ change / len(x))).T
    return torch.cat([matrix, (mean_y - matrix @ mean_x)[:, None]], dim=1)


def apply_affine(colors: Tensor, affine: Tensor) -> Tensor:
    """Return the colours [..., 3] under an affine map [3, 4], in the colours' dtype, not clamped."""
    affine = affine.to(colors)
    return colors @ affine[:, :3].T + affine[:, 3]
