"""Importer of splat .ply files of 3DGS, 2DGS, ns-export and beags."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.compressed_ply import is_compressed
from beags_plugin.splat_io.splat_file import read_splat_file


def newest_of_run(path: Path) -> Path | None:
    """Return the .ply of the last iteration in the folder of a run of 3DGS or 2DGS; None for another path."""
    files = [file for file in path.glob("point_cloud/iteration_*/point_cloud.ply") if _iteration(file).isdigit()]
    return max(files, key=lambda file: int(_iteration(file)), default=None)


def _iteration(file: Path) -> str:
    return file.parent.name.removeprefix("iteration_")


class PlyImporter(Importer):
    """The official layouts, in the world of the input poses, as other programs and ``beags export`` write them."""

    marks: ClassVar[str] = "a splat .ply, or the folder of a run of 3DGS or 2DGS"

    def recognises(self, path: Path) -> bool:
        file = newest_of_run(path) or path
        return file.is_file() and file.suffix.lower() == ".ply" and not is_compressed(file)

    def read(self, path: Path) -> ImportedScene:
        read = read_splat_file(newest_of_run(path) or path)
        kind = "2DGS .ply" if read.gaussians.log_scales.shape[1] == 2 else "3DGS .ply"
        return ImportedScene(kind, read.gaussians, remarks=read.remarks, free_values=True)
