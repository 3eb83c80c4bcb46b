"""Splat .ply files: of 3DGS and of 2DGS, of ns-export, and our own."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from beags_plugin.extraction.splat_file import read_splat_file
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.compressed_ply import is_compressed


class PlyImporter(Importer):
    """The official layouts, in the world of the input poses, where the official programs and ``beags export`` write."""

    marks: ClassVar[str] = "a splat .ply"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() == ".ply" and not is_compressed(path)

    def read(self, path: Path) -> ImportedScene:
        read = read_splat_file(path)
        kind = "2DGS .ply" if read.gaussians.log_scales.shape[1] == 2 else "3DGS .ply"
        return ImportedScene(kind, read.gaussians, remarks=read.remarks, free_values=True)
