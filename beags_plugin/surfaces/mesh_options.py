"""Options of the mesh exporters, in a module of their own that the command line can import quickly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from beags_plugin.system.errors import UserError, check_choice

MOST_VOXELS = 4096  # voxels along a side; memory_mb also bounds their number
LARGEST_TEXTURE = 8192  # texels along a side
TEXTURES = ("photos", "none")


@dataclass(frozen=True)
class MeshOptions:
    """Options of a mesh from the depth of the training views."""

    resolution: int = 0
    """Meshes: voxels along the object's longest side; 0 chooses up to 128, by the object's size in the photos."""
    truncation: float = 6.0
    """Meshes: voxels on either side of a surface that are averaged. A larger value merges depths that disagree, but
    moves the sides of a wall thinner than twice the value towards each other."""
    memory_mb: float = 500.0
    """Meshes: largest size of the voxel grid in MB; voxels grow to stay below it."""
    min_views: int = 3
    """Meshes: least number of views that show a surface (all, if there are fewer)."""
    smallest_part: float = 0.01
    """Meshes: loose parts with fewer triangles than this share of the largest part's are left out."""
    triangles: int = 0
    """Meshes: largest number of triangles; 0 means 20 per Gaussian, at least 1,000 and at most 20,000."""
    texture: Literal["photos", "none"] = "photos"
    """Colours of a .glb: a texture from the photos, or none, which uses the splats' colours at the vertices."""
    texture_size: int = 0
    """Texels along a side of the texture; 0 chooses a size that suits the photos."""

    def __post_init__(self) -> None:
        if self.resolution != 0 and not 8 <= self.resolution <= MOST_VOXELS:
            raise UserError(
                f"resolution is {self.resolution}: give 8 to {MOST_VOXELS} voxels along the longest side, or 0."
            )
        if not 1.0 <= self.truncation <= 64.0:
            raise UserError(f"truncation is {self.truncation}: it must lie in 1..64 voxels.")
        if not (self.memory_mb >= 50.0 and math.isfinite(self.memory_mb)):
            raise UserError(f"memory_mb is {self.memory_mb}: give the voxel grid at least 50 MB.")
        if self.min_views < 1:
            raise UserError(f"min_views is {self.min_views}: a surface needs at least 1 view.")
        if not 0.0 <= self.smallest_part <= 1.0:
            raise UserError(f"smallest_part is {self.smallest_part}: it must lie in 0..1.")
        if self.triangles != 0 and self.triangles < 100:
            raise UserError(f"triangles is {self.triangles}: give at least 100, or 0 for 20 for each Gaussian.")
        check_choice(self.texture, TEXTURES, "texture")
        if self.texture_size != 0 and not 16 <= self.texture_size <= LARGEST_TEXTURE:
            raise UserError(
                f"texture_size is {self.texture_size}: give 16 to {LARGEST_TEXTURE} texels along a side, or 0."
            )
