"""Vertex-coloured meshes of single objects, as .glb and .obj."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.export.base import Exporter, ExportItem, NothingToExport
from beags_plugin.export.fusion import Mesh, decimated, fuse, without_small_parts
from beags_plugin.export.glb import glb_bytes
from beags_plugin.export.mesh_options import MeshOptions
from beags_plugin.extraction.files import whole_file


@dataclass(frozen=True)
class MeshExporter(MeshOptions, Exporter):
    """The surface that the training views see of an item rendered alone; both file types hold the same mesh."""

    needs_views: ClassVar[bool] = True

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:  # a system library that it needs may be missing
            return f"Open3D cannot be loaded ({error}); pip install open3d, which needs libX11 and libGL."
        return None

    def mesh(self, item: ExportItem) -> Mesh:
        """Return the mesh of ``item``, made once for each set of options; raise ``NothingToExport`` without a face."""
        key = ("mesh", *astuple(self))
        if key not in item.shared:
            item.shared[key] = self._mesh(item)
        mesh = item.shared[key]
        if not len(mesh.faces):
            raise NothingToExport(
                f"no surface of {item.name!r} is seen in {self.min_views} training views: "
                "lower --min-views, or export it as splats."
            )
        return mesh

    def _mesh(self, item: ExportItem) -> Mesh:
        if item.views is None:
            raise ValueError("a mesh needs the views of the training photos")
        options = self.resolution, self.truncation, self.memory_mb, self.min_views
        fused = fuse(item.surfels, item.views, *options, item.on_render)
        most = self.faces or max(1000, 20 * len(item.surfels))
        return decimated(without_small_parts(fused, self.smallest_part), most)

    @staticmethod
    def facts(mesh: Mesh) -> dict[str, Any]:
        """Return the manifest's entries about a mesh."""
        return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "voxel": mesh.voxel}


@dataclass(frozen=True)
class GlbExporter(MeshExporter):
    """Binary glTF 2.0: Blender, three.js, game engines."""

    suffix: ClassVar[str] = "glb"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        mesh = self.mesh(item)
        with whole_file(path) as part:
            part.write_bytes(glb_bytes(mesh, item.name))
        return self.facts(mesh)


@dataclass(frozen=True)
class ObjExporter(MeshExporter):
    """Wavefront .obj, a colour after each vertex's place, as MeshLab and Blender read it."""

    suffix: ClassVar[str] = "obj"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        mesh = self.mesh(item)
        with whole_file(path) as part, open(part, "w", encoding="ascii") as file:
            np.savetxt(file, np.concatenate([mesh.vertices, mesh.colors], axis=1), "v %.9g %.9g %.9g %.4f %.4f %.4f")
            np.savetxt(file, mesh.faces + 1, "f %d %d %d")
        return self.facts(mesh)
