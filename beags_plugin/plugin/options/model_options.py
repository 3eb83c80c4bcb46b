"""Options of the scene and of its two training phases, for nerfstudio."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from nerfstudio.models.base_model import ModelConfig
from tyro.conf import Suppress

from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.core.sh import MAX_DEGREE
from beags_plugin.options.scene_options import SceneOptions
from beags_plugin.refiners import make_refiner
from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import load


@dataclass
class BeagsModelConfig(SceneOptions, ModelConfig):
    """Options of the scene and of its two training phases."""

    _target: type = field(default_factory=lambda: load("beags_plugin.plugin.model:BeagsModel"))
    enable_collider: Suppress[bool] = False  # This and the next four are for radiance fields.
    collider_params: Suppress[dict[str, float] | None] = None
    loss_coefficients: Suppress[dict[str, float]] = field(default_factory=dict)
    eval_num_rays_per_chunk: Suppress[int] = 4096
    prompt: Suppress[str | None] = None

    def check(self) -> None:
        """Raise ``UserError`` for a value with which training cannot work."""
        for name in ("base_steps", "refine_steps", "schedule_steps"):
            if (steps := getattr(self, name)) < 0:
                raise UserError(f"{name} is {steps}: give a number of steps, 0 or more.")
        if not 0 <= self.sh_degree <= MAX_DEGREE:
            raise UserError(f"sh_degree is {self.sh_degree}: choose 0 to {MAX_DEGREE}.")
        for name, value in (("sh_degree_interval", self.sh_degree_interval), ("densify.every", self.densify.every)):
            if value < 1:
                raise UserError(f"{name} is {value}: give a number of steps, 1 or more.")
        if not 0 < self.near < self.far < math.inf:
            raise UserError(f"near is {self.near} and far {self.far}: near must lie above 0 and below far.")
        if not all(0 < rate < math.inf for rate in self.position_lr):
            raise UserError(f"position_lr is {self.position_lr}: give two learning rates above 0.")
        if not 0 < self.base_lr_factor < math.inf:
            raise UserError(f"base_lr_factor is {self.base_lr_factor}: give a factor above 0.")
        make_refiner(self.refiner, self.refiner_options)

    def schedule(self) -> PhaseSchedule:
        """Return the steps of both phases."""
        return PhaseSchedule(self.base_steps, self.refine_steps, self.schedule_steps, self.start_from is not None)
