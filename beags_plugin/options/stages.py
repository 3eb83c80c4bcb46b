"""Options of densification and of the stages between base training and refinement."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DensifyConfig:
    """Options of densification; steps are stated for a base of schedule_steps."""

    every: int = 100
    """Steps between two rounds of growth and pruning."""
    start: int = 500
    """Step after which growth and pruning begin."""
    stop: int = 15_000
    """Step before which growth and pruning end."""
    prune_scale_after: int = 3_000
    """Step after which Gaussians larger than a tenth of the scene's extent are pruned; 0 keeps them."""
    reset_every: int = 3_000
    """Steps between resets of all opacities to at most 0.01; 0 never."""
    far_limits: bool = False
    """Scale the size limits of splitting and pruning by the distance of the nearest camera where that exceeds the
    scene's extent, for far backgrounds. False, the official rule, scales them by the extent alone."""
    max_surfels: int = 0
    """Largest number of Gaussians, which bounds time and memory; 0 sets no bound."""
    pixels_per_surfel: float = 0.0
    """Least number of training pixels per Gaussian, against overfitting to few images; 0, the official rule, sets no
    bound."""
    free_share: float = 0.0
    """Gaussians that reach nearer to a camera than this share of the depth of its nearest seed points are removed,
    because they cover held-out photos. 0 keeps them, and so does a scene whose seed points were generated."""


@dataclass(frozen=True)
class PreparationConfig:
    """Options of the stages between base training and refinement."""

    reprojection: str = "auto"
    """How the views' masks are made to agree: pairwise (exact), voxel (quick), auto (the one that fits the number of
    views), none (the masks stay as they are), or a registered one."""
    tau: float = 0.02
    """Tolerance of pairwise: a vote counts if its point is visible, |z - depth| <= tau z; inf counts every vote
    (E5)."""
    depth: str = "median"
    """Which depth is lifted: median or expected."""
    agree: bool = False
    """Weigh the views' masks by how far each agrees with the others, and redraw them where one decision per Gaussian
    contradicts them: for masks that a network made, because many views share its errors."""
    k: int = 2000
    """Neighbours that set the voxel size (E8); more make larger voxels."""
    k_pixels: int = 0
    """Training pixels for which k is stated; with fewer, k shrinks in proportion, so that voxels keep their size. 0, as
    in the paper, takes k as it is."""
