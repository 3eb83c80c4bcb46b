"""Meshes of single objects: textured or vertex-coloured as .glb and .usdz, vertex-coloured as .obj."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from beags_plugin.export.base import Exporter, ExportItem, NothingToExport
from beags_plugin.export.closing import Closed, closed
from beags_plugin.export.fusion import Mesh, decimated, fuse, suitable_resolution, without_small_parts
from beags_plugin.export.glb import glb_bytes
from beags_plugin.export.gltf import glb_to_world
from beags_plugin.export.mesh_options import MeshOptions
from beags_plugin.export.placing import Placed, placed
from beags_plugin.export.surface import area_vectors
from beags_plugin.export.texture import Texture, textured
from beags_plugin.extraction.files import whole_file
from beags_plugin.system.open3d_kernels import open3d_kernels
from beags_plugin.system.progress import progress_bar

FEWEST, MOST, PER_GAUSSIAN = 1000, 20_000, 20
"""Triangles where no number of them was asked for."""


def seen_surface(item: ExportItem, options: MeshOptions) -> Mesh:
    """Return the surface that the training views see of an item rendered alone, maybe of no face; made once."""
    if item.views is None:
        raise ValueError("a surface needs the views of the training photos")
    resolution = options.resolution or suitable_resolution(item.surfels, item.views.cameras)
    chosen = resolution, options.truncation, options.memory_mb, options.min_views
    fused = item.shared.get(("fused", chosen))
    if fused is None:
        fused = item.shared["fused", chosen] = fuse(item.surfels, item.views, *chosen, item.on_render)
    return without_small_parts(fused, options.smallest_part)


def placed_surface(item: ExportItem, options: MeshOptions) -> Placed:
    """Return the seen surface where the photos place it, if there are any; raises ``NothingToExport`` without a face.

    It is made once for each set of options.
    """
    mesh = seen_surface(item, options)
    if not len(mesh.faces):
        raise NothingToExport(
            f"no surface of {item.name!r} is seen in {options.min_views} training views: "
            "lower --min-views, or export it as splats."
        )
    if not item.photos:
        return Placed(mesh, 0.0)
    chosen = options.resolution, options.truncation, options.memory_mb, options.min_views, options.smallest_part
    found = item.shared.get(("placed", chosen))
    if found is None:
        with progress_bar("Placing the surface", passing=True) as progress:
            found = item.shared["placed", chosen] = placed(mesh, item.photos, progress)
    return found


def closed_surface(item: ExportItem, mesh: Mesh) -> Closed:
    """Return a surface of an item closed; raises ``NothingToExport`` if it encloses nothing."""
    solid = closed(mesh)
    if solid is None:
        raise NothingToExport(
            f"the surface of {item.name!r} encloses nothing, so it cannot be closed: export it without --close, as "
            "splats or .glb."
        )
    return solid


@dataclass(frozen=True)
class MadeMesh:
    """A mesh; pixels: that photos moved its places outwards, in the mean, 0 without photos.

    invented: [V] bool, vertices where no view showed a surface, None of a mesh that was not closed.
    """

    mesh: Mesh
    pixels: float
    invented: np.ndarray | None = None

    def facts(self) -> dict[str, Any]:
        """Return the manifest's entries about it; closed_share: of its area, where all corners are invented."""
        found = {"vertices": len(self.mesh.vertices), "triangles": len(self.mesh.faces), "voxel": self.mesh.voxel}
        if self.pixels:
            found["moved_pixels"] = round(self.pixels, 3)
        if self.invented is None:
            return found
        areas = np.linalg.norm(area_vectors(self.mesh), axis=1)
        share = areas[self.invented[self.mesh.faces].all(axis=1)].sum() / max(areas.sum(), 1e-300)
        return found | {"closed_share": round(float(share), 4)}


@dataclass(frozen=True)
class MeshExporter(MeshOptions, Exporter):
    """The surface that the training views see of an item rendered alone, placed by the photos, if there are any.

    All file types hold the same mesh.
    """

    needs_views: ClassVar[bool] = True
    holds_gaussians: ClassVar[bool] = False
    closes: ClassVar[bool] = False

    @property
    def needs_photos(self) -> bool:
        return True

    @classmethod
    def unavailable(cls) -> str | None:
        return open3d_missing()

    def mesh(self, item: ExportItem) -> Mesh:
        """Return the mesh of ``item``, made once for each set of options; raise ``NothingToExport`` without a face."""
        return self.made(item).mesh

    def made(self, item: ExportItem) -> MadeMesh:
        """Return the mesh of ``item`` and what of it is invented; as ``mesh``."""
        closing = item.close or self.closes
        key = ("mesh", closing, *astuple(self))
        if key not in item.shared:
            item.shared[key] = self._made(item, closing)
        return item.shared[key]

    def _made(self, item: ExportItem, closing: bool) -> MadeMesh:
        most = self.triangles or min(MOST, max(FEWEST, PER_GAUSSIAN * len(item.surfels)))
        surface = placed_surface(item, self)
        if closing:
            solid = closed_surface(item, surface.mesh)
            mesh = decimated(without_small_parts(solid.mesh, self.smallest_part), most)
            return MadeMesh(mesh, surface.pixels, solid.invented_at(mesh.vertices))
        return MadeMesh(decimated(surface.mesh, most), surface.pixels)


def open3d_missing() -> str | None:
    """Return None if Open3D can be loaded, else one sentence: why not and what to install."""
    try:
        open3d_kernels()
    except (ImportError, OSError) as error:  # a system library that it needs may be missing
        return f"Open3D cannot be loaded ({error}); pip install open3d, which needs libX11 and libGL."
    return None


@dataclass(frozen=True)
class TexturedExporter(MeshExporter):
    """File types that have a texture; those of one item share it."""

    def texture_of(self, mesh: Mesh, item: ExportItem) -> tuple[Texture | None, dict[str, Any] | str]:
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
class GlbExporter(TexturedExporter):
    """Binary glTF 2.0: Blender, three.js, game engines."""

    suffix: ClassVar[str] = "glb"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        texture, facts = self.texture_of(made.mesh, item)
        with whole_file(path) as part:
            part.write_bytes(glb_bytes(made.mesh, item.name, texture, made.invented))
        return made.facts() | {"texture": facts}

    def to_world(self, path: Path, origin: Tensor) -> bool:
        return glb_to_world(path, origin)


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
