"""Meshes of single objects: textured or vertex-coloured as .glb and .usdz, vertex-coloured as .obj."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from beags_plugin.export.base import Exporter
from beags_plugin.export.glb import glb_bytes
from beags_plugin.export.gltf import glb_to_world
from beags_plugin.splat_io.files import whole_file, write_bytes
from beags_plugin.surfaces.fusion import Mesh, decimated
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.meshing import MadeMesh, closed_mesh, open3d_missing, placed_surface
from beags_plugin.surfaces.texture import Texture, textured

FEWEST, MOST, PER_GAUSSIAN = 1000, 20_000, 20
"""Triangles by default: the fewest, the most, and the number per Gaussian."""


@dataclass(frozen=True)
class MeshExporter(MeshOptions, Exporter):
    """The surface that the training views see of an item rendered alone, aligned with the photos, if there are any.

    All file types hold the same mesh. closes: whether the format needs a closed mesh.
    """

    needs_views: ClassVar[bool] = True
    needs_photos: ClassVar[bool] = True
    holds_gaussians: ClassVar[bool] = False
    closes: ClassVar[bool] = False

    @classmethod
    def unavailable(cls) -> str | None:
        return open3d_missing()

    def made(self, item: ExportItem) -> MadeMesh:
        """Return the mesh of ``item``, made once for each set of options; raise ``NothingToExport`` without a face."""
        closing = item.close or self.closes
        key = ("mesh", closing, *astuple(self))
        if key not in item.shared:
            item.shared[key] = self._made(item, closing)
        return item.shared[key]

    def _made(self, item: ExportItem, closing: bool) -> MadeMesh:
        most = self.triangles or min(MOST, max(FEWEST, PER_GAUSSIAN * len(item.surfels)))
        surface, pixels = placed_surface(item, self)
        if closing:
            solid = closed_mesh(item, surface, self.smallest_part, most)
            return MadeMesh(solid.mesh, pixels, solid.invented)
        return MadeMesh(decimated(surface, most), pixels)


@dataclass(frozen=True)
class TexturedExporter(MeshExporter):
    """File types with a texture, which those of one item share."""

    def texture_of(self, mesh: Mesh, item: ExportItem) -> tuple[Texture | None, dict[str, Any] | str]:
        """Return the texture and the manifest's entry about it, or None and the reason why there is none."""
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
class GlbExporter(TexturedExporter):
    """Binary glTF 2.0: Blender, three.js, game engines."""

    suffix: ClassVar[str] = "glb"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        texture, facts = self.texture_of(made.mesh, item)
        write_bytes(path, glb_bytes(made.mesh, item.name, texture, made.invented))
        return made.facts() | {"texture": facts}

    def to_world(self, path: Path, origin: Tensor) -> bool:
        return glb_to_world(path, origin)


@dataclass(frozen=True)
class ObjExporter(MeshExporter):
    """Wavefront .obj with a colour after each vertex's position, as MeshLab and Blender read it."""

    suffix: ClassVar[str] = "obj"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        mesh = made.mesh
        with whole_file(path) as part, open(part, "w", encoding="ascii") as file:
            np.savetxt(file, np.concatenate([mesh.vertices, mesh.colors], axis=1), "v %.9g %.9g %.9g %.4f %.4f %.4f")
            np.savetxt(file, mesh.faces + 1, "f %d %d %d")
        return made.facts()
