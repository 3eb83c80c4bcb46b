"""Unit quaternions and rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_from_quat(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions, which are normalised here (so the gradient includes it, once).

    quats: [..., 4] wxyz, not zero. Returns [..., 3, 3].
    """
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)
