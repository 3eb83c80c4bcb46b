"""Meshes of single objects: textured or vertex-coloured as .glb, vertex-coloured as .obj."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.export.base import Exporter, ExportItem, NothingToExport
from beags_plugin.export.closing import closed
from beags_plugin.export.fusion import Mesh, decimated, fuse, without_small_parts
from beags_plugin.export.glb import glb_bytes
from beags_plugin.export.mesh_options import MeshOptions
from beags_plugin.export.texture import Texture, textured
from beags_plugin.extraction.files import whole_file

FEWEST, MOST, PER_GAUSSIAN = 1000, 20_000, 20
"""Triangles where no number of them was asked for."""


@dataclass(frozen=True)
class MadeMesh:
    """A mesh; closed_share: of its area that no view showed, None of one that was not closed."""

    mesh: Mesh
    closed_share: float | None = None

    def facts(self) -> dict[str, Any]:
        """Return the manifest's entries about it."""
        found = {"vertices": len(self.mesh.vertices), "triangles": len(self.mesh.faces), "voxel": self.mesh.voxel}
        return found if self.closed_share is None else found | {"closed_share": round(self.closed_share, 4)}


@dataclass(frozen=True)
class MeshExporter(MeshOptions, Exporter):
    """The surface that the training views see of an item rendered alone; all file types hold the same mesh."""

    needs_views: ClassVar[bool] = True
    closes: ClassVar[bool] = False

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:  # a system library that it needs may be missing
            return f"Open3D cannot be loaded ({error}); pip install open3d, which needs libX11 and libGL."
        return None

    def mesh(self, item: ExportItem) -> Mesh:
        """Return the mesh of ``item``, made once for each set of options; raise ``NothingToExport`` without a face."""
        return self.made(item).mesh

    def made(self, item: ExportItem) -> MadeMesh:
        """Return the mesh of ``item`` and how much of it was closed; as ``mesh``."""
        closing = self.watertight or self.closes
        key = ("mesh", closing, *astuple(self))
        if key not in item.shared:
            item.shared[key] = self._made(item, closing)
        made = item.shared[key]
        if not len(made.mesh.faces):
            raise NothingToExport(
                f"no surface of {item.name!r} is seen in {self.min_views} training views: "
                "lower --min-views, or export it as splats."
            )
        return made

    def _made(self, item: ExportItem, closing: bool) -> MadeMesh:
        if item.views is None:
            raise ValueError("a mesh needs the views of the training photos")
        options = self.resolution, self.truncation, self.memory_mb, self.min_views
        fused = item.shared.get(("fused", options))
        if fused is None:
            fused = item.shared["fused", options] = fuse(item.surfels, item.views, *options, item.on_render)
        mesh, share = without_small_parts(fused, self.smallest_part), None
        if closing and len(mesh.faces):
            solid = closed(mesh)
            mesh, share = without_small_parts(solid.mesh, self.smallest_part), solid.invented_share
        most = self.triangles or min(MOST, max(FEWEST, PER_GAUSSIAN * len(item.surfels)))
        return MadeMesh(decimated(mesh, most), share)


@dataclass(frozen=True)
class GlbExporter(MeshExporter):
    """Binary glTF 2.0: Blender, three.js, game engines."""

    suffix: ClassVar[str] = "glb"

    @property
    def needs_photos(self) -> bool:
        return self.texture == "photos"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        texture, facts = self._texture(made.mesh, item)
        with whole_file(path) as part:
            part.write_bytes(glb_bytes(made.mesh, item.name, texture))
        return made.facts() | {"texture": facts}

    def _texture(self, mesh: Mesh, item: ExportItem) -> tuple[Texture | None, dict[str, Any] | str]:
        """Return the texture and the manifest's entry about it, or None and why there is none."""
        if self.texture == "none":
            return None, "none"
        if item.photos is None:
            return None, f"none, as {item.no_photos}"
        key = ("texture", id(mesh), self.texture_size)
        if key not in item.shared:
            item.shared[key] = textured(mesh, item.photos, self.texture_size)
        texture = item.shared[key]
        spread = texture.exposures.mean(axis=1)
        return texture, {
            "size": texture.atlas.size,
            "from_photos": round(texture.from_photos, 4),
            "exposures": [round(float(spread.min()), 4), round(float(spread.max()), 4)],
        }


@dataclass(frozen=True)
class ObjExporter(MeshExporter):
    """Wavefront .obj, a colour after each vertex's place, as MeshLab and Blender read it."""

    suffix: ClassVar[str] = "obj"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        mesh = made.mesh
        with whole_file(path) as part, open(part, "w", encoding="ascii") as file:
            np.savetxt(file, np.concatenate([mesh.vertices, mesh.colors], axis=1), "v %.9g %.9g %.9g %.4f %.4f %.4f")
            np.savetxt(file, mesh.faces + 1, "f %d %d %d")
        return made.facts()
