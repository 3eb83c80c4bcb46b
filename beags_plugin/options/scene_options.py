"""Options of the scene and of its two training phases, as commands on finished runs read them too."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Suppress

from beags_plugin.options.loss_spec import LossSpec
from beags_plugin.options.stages import DensifyConfig, PreparationConfig


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
