"""Options of the splat formats, as command lines have them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from beags_plugin.surfaces.mesh_options import MeshOptions


@dataclass(frozen=True)
class SplatOptions:
    """What splat files hold."""

    spz_version: Literal[3, 4] = 3
    """Version of .spz: 3, which most readers know, or 4, a little smaller."""
    surflets: bool = False
    """USD: discs as surflets, which nothing off their plane shows, instead of thin 3D Gaussians, which all programs
    that know splats draw."""
    usd_up: Literal["y", "z"] = "y"
    """USD of splats: the axis that the stage says is up."""

    def of_formats(self, mesh: MeshOptions) -> dict[str, dict[str, Any]]:
        """Return the options of exporters by their names; mesh: of colliders."""
        usd = {"kernel": "surflet" if self.surflets else "ellipsoid", "up_axis": self.usd_up, "mesh": mesh}
        return {"spz": {"version": self.spz_version}, "usdz-splats": usd, "usda-splats": usd}
