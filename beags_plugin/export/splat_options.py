"""Options of the splat formats, for command lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from beags_plugin.surfaces.mesh_options import MeshOptions


@dataclass(frozen=True)
class SplatOptions:
    """Options of splat files."""

    spz_version: Literal[3, 4] = 3
    """Version of .spz: 3, which most readers support, or 4, which is slightly smaller."""
    surflets: bool = False
    """USD: write discs as surflets, which are invisible from the side, instead of thin 3D Gaussians, which all programs
    with splats can render."""
    usd_up: Literal["y", "z"] = "y"
    """USD of splats: the axis that is up."""

    def of_formats(self, mesh: MeshOptions) -> dict[str, dict[str, Any]]:
        """Return the options of exporters by their names; mesh: options of colliders."""
        usd = {"kernel": "surflet" if self.surflets else "ellipsoid", "up_axis": self.usd_up, "mesh": mesh}
        return {"spz": {"version": self.spz_version}, "usdz-splats": usd, "usda-splats": usd}
