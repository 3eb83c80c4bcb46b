"""Unit quaternions and rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor

LONGEST_QUAT = 1e12
"""Quaternions longer than this, or shorter than its reciprocal, count as broken wherever Gaussians are used.

The gradient of a quaternion is that of its rotation divided by its length, which would overflow in float32.
"""


def usable_quats(quats: Tensor) -> Tensor:
    """Return [...] bool: whether the lengths of quats [..., 4] can be divided by; that of NaN cannot. No gradient."""
    length = quats.detach().double().norm(dim=-1)
    return (length >= 1.0 / LONGEST_QUAT) & (length <= LONGEST_QUAT)


def rotation_from_quat(quats: Tensor) -> Tensor:
    """Return rotation matrices of quaternions, which are normalised here (so the gradient includes it, once).

    quats: [..., 4] wxyz, not zero. Returns [..., 3, 3].
    """
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quat_product(first: Tensor, second: Tensor) -> Tensor:
    """Return the quaternion [..., 4] of "second, then first": first and second [..., 4], wxyz; broadcast."""
    w1, x1, y1, z1 = first.unbind(-1)
    w2, x2, y2, z2 = second.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )
