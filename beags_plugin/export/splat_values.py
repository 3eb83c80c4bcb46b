"""Gaussians prepared for compressed files: finite, as 3D Gaussians, with neighbours side by side."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.splat_io.ply import thin_log_scales
from beags_plugin.surfaces.item import NothingToExport

_LEAST_LOG_SCALE = -20.0  # 2e-9 units; thinner strays would only make the steps of their neighbours coarser
_MORTON_BITS = 21  # bits per axis: three axes fill 63 bits


@dataclass(frozen=True)
class SplatValues:
    """N finite 3D Gaussians, along a Morton curve through their means; float64.

    means: [N, 3]. quats: [N, 4] wxyz, unit length. log_scales: [N, 3], the third ``THICKNESS`` times the smaller of
    the Gaussian's two. opacities: [N] 0..1. sh_dc: [N, 3]. sh_rest: [N, (degree + 1)^2 - 1, 3].
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacities: np.ndarray
    sh_dc: np.ndarray
    sh_rest: np.ndarray

    def __len__(self) -> int:
        return len(self.means)


def finite_mask(surfels: Surfels) -> torch.Tensor:
    """Return [N] bool, the Gaussians whose parameters are all finite."""
    values = (surfels.means, surfels.quats, surfels.log_scales, surfels.sh)
    finite = torch.cat([value.detach().flatten(1) for value in values], dim=1).isfinite().all(dim=1)
    return finite & surfels.opacity_logits.isfinite()


def splat_values(surfels: Surfels, name: str) -> SplatValues:
    """Return the Gaussians of the object called ``name``; raise ``NothingToExport`` if none of them is finite."""
    surfels = surfels[finite_mask(surfels)]
    if len(surfels) == 0:
        raise NothingToExport(f"{name} has no finite Gaussian, so there is nothing to write.")
    values = (
        surfels.means.detach().double(),
        torch.nn.functional.normalize(surfels.quats.detach().double(), dim=1),
        thin_log_scales(surfels.log_scales.detach().double()).clamp_min(_LEAST_LOG_SCALE),
        opacities(surfels.opacity_logits.detach().double()),
        surfels.sh_dc.detach().double(),
        surfels.sh_rest.detach().double(),
    )
    arrays = [value.cpu().numpy() for value in values]
    order = morton_order(arrays[0])
    return SplatValues(*(array[order] for array in arrays))


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the indices [N] that sort points [N, 3] along a Morton curve; equal codes keep their order."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    cells = (points - low) / np.where(extent > 0, extent, 1.0) * (2**_MORTON_BITS - 1)
    codes = np.zeros(len(points), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            of_axis = cells[:, axis].astype(np.uint64) >> np.uint64(bit) & np.uint64(1)
            codes |= of_axis << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop the component of each unit quaternion that is largest in size; its sign is made positive, since q equals -q.

    quats: [N, 4] wxyz. Returns the index of the largest, [N] 0..3, and the others in their order, [N, 3], times sqrt(2)
    and so within -1..1.
    """
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, math.sqrt(2.0) * signed[rows[:, None], others]
