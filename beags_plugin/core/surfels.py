"""A scene of 2D Gaussian splatting: N flat Gaussians, which the code calls surfels (method, section 1)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass(frozen=True)
class Surfels:
    """Parameters of N Gaussians, as they are optimised (method, section 0); all floats, float32 in training.

    means: [N, 3] positions, world units.
    quats: [N, 4] rotations, wxyz, of any length but zero; normalised where they are used.
    log_scales: [N, 2] natural logs of the two scales, world units.
    opacity_logits: [N] logits of the opacity.
    sh_dc: [N, 3] spherical-harmonic coefficients of the colour, degree 0. They have a learning rate of their own.
    sh_rest: [N, (degree + 1)^2 - 1, 3] coefficients of the higher degrees; in a tensor of their own, because joining
        two learning rates in one would copy it in every step.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor

    @classmethod
    def of(cls, means: Tensor, quats: Tensor, log_scales: Tensor, opacity_logits: Tensor, sh: Tensor) -> Surfels:
        """Make Gaussians that hold views of one tensor of all coefficients, sh [N, (degree + 1)^2, 3]."""
        return cls(means, quats, log_scales, opacity_logits, sh[:, 0], sh[:, 1:])

    @property
    def sh(self) -> Tensor:
        """Return a copy of all coefficients, [N, (degree + 1)^2, 3], degree 0 first; differentiable."""
        return torch.cat([self.sh_dc[:, None], self.sh_rest], dim=1)

    @property
    def sh_degree(self) -> int:
        """Return the highest degree of the spherical harmonics, 0..3."""
        return round((1 + self.sh_rest.shape[1]) ** 0.5) - 1

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, selection) -> Surfels:
        """Return the Gaussians that a mask [N] bool, an index [M] int64 or a slice selects."""
        return Surfels(**{field.name: getattr(self, field.name)[selection] for field in fields(self)})

    def detach(self) -> Surfels:
        """Return the same values, without gradients."""
        return Surfels(**{field.name: getattr(self, field.name).detach() for field in fields(self)})

    def to(self, target: torch.device | torch.dtype | str) -> Surfels:
        """Return the same values on another device or of another dtype."""
        return Surfels(**{field.name: getattr(self, field.name).to(target) for field in fields(self)})

    def clone(self) -> Surfels:
        """Return a copy in memory of its own, without gradients."""
        return Surfels(**{field.name: getattr(self, field.name).detach().clone() for field in fields(self)})


def opacities(logits: Tensor) -> Tensor:
    """Return opacities in 0..1, of the shape of ``logits``; differentiable, with a gradient of 0 below logits of -80.

    Below -80, where the opacity is 1e-35, 1 / (1 + exp) would have no finite gradient. Determinism: torch.sigmoid
    rounds differently at the ends of each thread's range, exp does not.
    """
    return 1.0 / (1.0 + torch.exp(-logits.clamp_min(-80.0)))
