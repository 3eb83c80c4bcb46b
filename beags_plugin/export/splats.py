"""Gaussians as .ply files: for viewers of 3D Gaussians, and for programs of 2D Gaussian splatting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from beags_plugin.export.base import Exporter, ExportItem
from beags_plugin.extraction.ply import write_ply


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
