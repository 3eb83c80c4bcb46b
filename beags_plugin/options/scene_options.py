"""Options of the scene and of its two training phases, as commands on finished runs read them too."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Suppress

from beags_plugin.options.loss_spec import LossSpec


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


@dataclass
class SceneOptions:
    """Options of the scene and of its two training phases."""

    rasterizer: str = "auto"
    """Backend: auto, native, torch, cuda (docs/cuda.md), or one that another package registers."""
    sh_degree: int = 3
    """Highest degree of the colour's spherical harmonics (0..3)."""
    sh_degree_interval: Suppress[int] = 1000
    """Steps between two degrees."""
    background_color: Literal["black", "white", "random"] = "black"
    """Background behind the scene, and behind images with alpha; "random" draws one per training step, and is black
    elsewhere."""
    exposure: Literal["auto", "on", "off"] = "auto"
    """Whether each training photo gets an affine colour transform of its own, learned with the scene, which then has
    the mean photo's exposure; auto: only if points that several photos show differ in brightness between them."""
    start_from: Path | None = None
    """A trained scene to start from instead of seed points: a splat file (docs/export.md), or a run of splatfacto or
    beags. 3D Gaussians are flattened. base_steps then polish it, without growth."""
    start_frame: Literal["auto", "world", "normalised"] = "auto"
    """Frame of start_from: world, that of the input poses; normalised, that of this run; auto: world for a file, and
    for a run what its dataparser_transforms.json says."""
    start_values: Literal["auto", "logs", "activated"] = "auto"
    """Scales and opacities of a .ply to start from: logs and logits, or activated; auto: what their ranges say."""
    base_steps: int = 30_000
    """Steps of base training; 0 for a refinement that starts from a loaded base."""
    refine_steps: int = 3_000
    """Steps of refinement; 0 trains a base only."""
    schedule_steps: Suppress[int] = 30_000
    """Length of base training for which all other steps and intervals of the base are stated; with another base_steps
    they are scaled in proportion. 0: they are never scaled."""
    refiner: str = "bea"
    """What happens after class assignment: bea (this method), none (assignment alone), or one that another
    package registers, such as another paper's method (baselines/README.md)."""
    refiner_options: dict[str, bool | int | float | str] = field(default_factory=dict)
    """Options of the refiner: name, value, name, value, and so on."""
    losses: dict[str, LossSpec] = field(default_factory=dict)
    """The terms of the training loss by name."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """When and how the base grows and prunes its Gaussians."""
    prepare: PreparationConfig = field(default_factory=PreparationConfig)
    """Options of mask reprojection and of the voxel grids."""
    position_lr: Suppress[tuple[float, float]] = (1.6e-4, 1.6e-6)
    """First and last learning rate of the positions, log-linear, times the scene's extent."""
    base_lr_factor: float = 1.0
    """Factor of all learning rates of the base but that of opacities, for a base that is shorter than the official one;
    a base that polishes ignores it."""
    close_contacts: bool = False
    """After the last step of a refinement by losses: close objects, such as the lid of a box, where other objects hid
    them from every photo. It takes a second or more for each object."""
    near: Suppress[float] = 0.01
    """Near plane in units of the scene's extent."""
    far: Suppress[float] = 100.0
    """Far plane in units of the scene's extent."""
