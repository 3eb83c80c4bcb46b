"""Gaussians as .ply files, for viewers of 3D Gaussians and programs of 2D Gaussian splatting, and as .splat."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.core.sh import SH_C0
from beags_plugin.export.base import Exporter
from beags_plugin.export.splat_values import splat_values
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.surfaces.item import ExportItem

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


@dataclass(frozen=True)
class PlyExporter(Exporter):
    """The layout of 3DGS, with a thin third scale: SuperSplat, PlayCanvas, add-ons for Blender and Unity."""

    suffix: ClassVar[str] = "ply"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        write_ply(path, item.surfels, item.class_ids, invented=item.invented)
        return {}


@dataclass(frozen=True)
class SurfelPlyExporter(Exporter):
    """The layout of the official 2DGS code: two scales, colours up to degree 3."""

    suffix: ClassVar[str] = "2dgs.ply"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        write_ply(path, item.surfels, item.class_ids, layout="2dgs", invented=item.invented)
        return {}


@dataclass(frozen=True)
class SplatExporter(Exporter):
    """The .splat of antimatter15's viewer: 32 bytes a Gaussian, the largest and most opaque first, as it sorts them.

    Colours do not change with the view; rotations have 8 bits, which tilts thin discs by up to a degree; there are no
    class ids.
    """

    suffix: ClassVar[str] = "splat"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        values = splat_values(item.surfels, item.name)
        size = values.opacities * np.exp(values.log_scales[:, :2].sum(axis=1))
        order = np.argsort(-size, kind="stable")
        rows = np.empty(len(values), _ROW)
        rows["mean"], rows["scale"] = values.means[order], np.exp(values.log_scales[order])
        colors = np.column_stack([0.5 + SH_C0 * values.sh_dc, values.opacities])[order]
        rows["color"] = np.rint(255.0 * colors).clip([0, 0, 0, 1], [255, 255, 255, 254])  # 255: an infinite logit
        rows["quat"] = np.rint(128.0 * values.quats[order] + 128.0).clip(0, 255)
        write_bytes(path, rows.tobytes())
        return {}
