"""Meshes of items: the surface that the views see, aligned with the photos, and closed on demand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from beags_plugin.surfaces.closing import Closed, closed
from beags_plugin.surfaces.fusion import Mesh, decimated, fuse, suitable_resolution, without_small_parts
from beags_plugin.surfaces.item import ExportItem, NothingToExport
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.surface import area_vectors
from beags_plugin.surfaces.surface_alignment import placed
from beags_plugin.system.open3d_kernels import open3d_kernels
from beags_plugin.system.progress import progress_bar


def seen_surface(item: ExportItem, options: MeshOptions) -> Mesh:
    """Return the surface that the training views see of an item rendered alone, perhaps without faces; made once."""
    if item.views is None:
        raise ValueError("a surface needs the views of the training photos")
    resolution = options.resolution or suitable_resolution(item.surfels, item.views.cameras)
    chosen = resolution, options.truncation, options.memory_mb, options.min_views
    fused = item.shared.get(("fused", chosen))
    if fused is None:
        fused = item.shared["fused", chosen] = fuse(item.surfels, item.views, *chosen, item.on_render)
    return without_small_parts(fused, options.smallest_part)


def placed_surface(item: ExportItem, options: MeshOptions) -> tuple[Mesh, float]:
    """Return the surface that the views see, aligned with the photos, if any, and the mean move in pixels.

    It is made once for each set of options. Raises ``NothingToExport`` for a surface without faces.
    """
    mesh = seen_surface(item, options)
    if not len(mesh.faces):
        raise NothingToExport(
            f"no surface of {item.name!r} is seen in {options.min_views} training views: "
            "lower --min-views, or export it as splats."
        )
    if not item.photos:
        return mesh, 0.0
    chosen = options.resolution, options.truncation, options.memory_mb, options.min_views, options.smallest_part
    aligned = item.shared.get(("placed", chosen))
    if aligned is None:
        with progress_bar("Placing the surface", passing=True) as progress, threadpool_limits(1, "openmp"):
            aligned = item.shared["placed", chosen] = placed(mesh, item.photos, progress)
    return aligned


def closed_surface(item: ExportItem, mesh: Mesh) -> Closed:
    """Return the closed surface of an item; raises ``NothingToExport`` if it encloses nothing."""
    solid = closed(mesh)
    if solid is None:
        raise NothingToExport(
            f"the surface of {item.name!r} encloses nothing, so it cannot be closed: export it without --close, as "
            "splats or .glb."
        )
    return solid


def closed_mesh(item: ExportItem, mesh: Mesh, smallest_part: float, most: int) -> Closed:
    """Return ``closed_surface`` with at most ``most`` triangles, without parts of less than ``smallest_part``."""
    solid = closed_surface(item, mesh)
    few = decimated(without_small_parts(solid.mesh, smallest_part), most)
    return Closed(few, solid.invented_at(few.vertices))


@dataclass(frozen=True)
class MadeMesh:
    """A mesh; pixels: the mean distance that photos moved it outwards, 0 without photos.

    invented: [V] bool, vertices where no view showed a surface; None for a mesh that was not closed.
    """

    mesh: Mesh
    pixels: float
    invented: np.ndarray | None = None

    def facts(self) -> dict[str, Any]:
        """Return the manifest's entries about it; closed_share: share of its area whose vertices are all invented."""
        mesh = self.mesh
        facts: dict[str, Any] = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces), "voxel": mesh.voxel}
        if self.pixels:
            facts["moved_pixels"] = round(self.pixels, 3)
        if self.invented is None:
            return facts
        areas = np.linalg.norm(area_vectors(mesh), axis=1)
        share = areas[self.invented[mesh.faces].all(axis=1)].sum() / max(areas.sum(), 1e-300)
        return facts | {"closed_share": round(float(share), 4)}


def open3d_missing() -> str | None:
    """Return None if Open3D can be loaded, else one sentence: why not and what to install."""
    try:
        open3d_kernels()
    except (ImportError, OSError) as error:  # A system library may be missing.
        return f"Open3D cannot be loaded ({error}); pip install open3d, which needs libX11 and libGL."
    return None
