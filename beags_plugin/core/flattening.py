"""3D Gaussians turned into surfels: each is flattened along its thinnest axis."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from beags_plugin.core.rotations import quat_product
from beags_plugin.core.surfels import Surfels

_ROUND = 0.5  # ratio of the thinnest scale to the second above which flattening visibly changes a Gaussian
# Quaternions wxyz that turn the x, y and z axis to the axes (k + 1, k + 2, k), for k = 0, 1, 2: the axis k becomes the
# normal, and the three stay right-handed.
_AXES_TO = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as files hold them, flat or not; float32, otherwise as in ``core.surfels.Surfels``.

    means: [N, 3]. quats: [N, 4] wxyz. log_scales: [N, 2] of flat Gaussians, normal along the third axis; or [N, 3].
    opacity_logits: [N]. sh_dc: [N, 3]. sh_rest: [N, K, 3].
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, selection) -> Gaussians:
        """Return the Gaussians that a mask [N] bool or an index [M] int64 selects."""
        return Gaussians(**{field.name: getattr(self, field.name)[selection] for field in fields(self)})

    def usable(self) -> Tensor:
        """Return [N] bool: every value is finite and the quaternion not zero. An infinite opacity logit is usable."""
        usable = self.quats.norm(dim=-1) > 0
        for field in fields(self):
            values = getattr(self, field.name)
            bad = values.isnan() if field.name == "opacity_logits" else ~values.isfinite()
            usable &= ~bad.flatten(1).any(dim=1) if bad.dim() > 1 else ~bad
        return usable


@dataclass(frozen=True)
class Flattening:
    """How thick N > 0 Gaussians were before they were flattened.

    median_ratio: median ratio of the thinnest scale to the second; 0: flat already, 1: as thick as wide.
    round_share: share of the Gaussians whose ratio is above 0.5.
    """

    median_ratio: float
    round_share: float


def flatten(gaussians: Gaussians) -> tuple[Surfels, Flattening | None]:
    """Return flat Gaussians in the plane of each Gaussian's two larger axes, with its opacity and colour.

    Those whose thinnest axis is the third keep their quaternion. Returns N flat Gaussians, and how thick they were
    (None if they are flat already, or if N is 0). Infinite opacity logits become 30, which is opaque.
    """
    logits = gaussians.opacity_logits.nan_to_num(posinf=30.0, neginf=-30.0)
    quats, scales, thickness = gaussians.quats, gaussians.log_scales, None
    if scales.shape[1] == 3:
        thickness = flattening(scales)
        # The last of equal scales counts as the thinnest, so that a sphere keeps its axes.
        thinnest = 2 - scales.flip(1).argmin(dim=1)
        turned = quat_product(quats, quats.new_tensor(_AXES_TO)[thinnest])
        quats = torch.where((thinnest == 2)[:, None], quats, turned)
        scales = scales.gather(1, torch.stack([(thinnest + 1) % 3, (thinnest + 2) % 3], dim=1))
    return Surfels(gaussians.means, quats, scales, logits, gaussians.sh_dc, gaussians.sh_rest), thickness


def without_empty_bands(surfels: Surfels) -> Surfels:
    """Lower the SH degree while the coefficients of its highest band are all 0: some formats pad with zeros."""
    degree = surfels.sh_degree
    while degree > 0 and not bool(surfels.sh_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1].any()):
        degree -= 1
    return replace(surfels, sh_rest=surfels.sh_rest[:, : (degree + 1) ** 2 - 1])


def flattening(log_scales: Tensor) -> Flattening | None:
    """Measure how thick Gaussians of these log scales [N, 3] are; None if N is 0."""
    if len(log_scales) == 0:
        return None
    ordered = log_scales.double().sort(dim=1).values
    ratios = torch.exp(ordered[:, 0] - ordered[:, 1])
    return Flattening(float(ratios.median()), float((ratios > _ROUND).double().mean()))
