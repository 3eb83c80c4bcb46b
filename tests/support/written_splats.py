"""Splat files of random discs, and how much two readings of one differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from beags_plugin.core.flattening import Gaussians, flatten
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import make_exporter
from beags_plugin.importers.base import read_scene
from beags_plugin.splat_io.splat_file import read_splat_file
from beags_plugin.surfaces.item import ExportItem


def write(path: Path, kind: str, surfels: Surfels, **options) -> Path:
    """``surfels`` as an exporter writes them to ``path``."""
    item = ExportItem("cup", surfels, torch.zeros(len(surfels), dtype=torch.int32))
    make_exporter(kind, **options).write(path, item)
    return path


def read_back(path: Path) -> Surfels:
    """The discs of a file."""
    return flatten(read_scene(path).gaussians)[0]


def read_ply(path: Path) -> tuple[Surfels, torch.Tensor | None]:
    """The surfels of a .ply, whatever its third scale, and its class ids."""
    read = read_splat_file(path)
    flat = replace(read.gaussians, log_scales=read.gaussians.log_scales[:, :2].contiguous())
    return Surfels(**vars(flat)), read.class_ids


def angles(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """The angle in degrees [N] between rotations [N, 4] wxyz, to 1e-6 where it is small."""
    one, other = (torch.nn.functional.normalize(quats.double(), dim=1) for quats in (one, other))
    other = other * (one * other).sum(dim=1, keepdim=True).sign()
    return torch.rad2deg(4 * torch.asin((one - other).norm(dim=1).clamp(max=2.0) / 2))


def differences(one: Surfels | Gaussians, other: Surfels | Gaussians) -> dict[str, float]:
    """The greatest difference by parameter: of rotations in degrees, of opacities in shares."""
    found = {name: (getattr(one, name) - getattr(other, name)).abs() for name in ("means", "sh_dc", "sh_rest")}
    width = min(one.log_scales.shape[1], other.log_scales.shape[1])  # a third one of discs tells nothing
    found["log_scales"] = (one.log_scales[:, :width] - other.log_scales[:, :width]).abs()
    found["alphas"] = (opacities(one.opacity_logits) - opacities(other.opacity_logits)).abs()
    found["angles"] = angles(one.quats, other.quats)
    return {name: float(values.max()) if values.numel() else 0.0 for name, values in found.items()}
