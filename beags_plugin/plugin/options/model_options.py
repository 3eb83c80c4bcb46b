"""Options of the scene and of its two training phases, for nerfstudio."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.models.base_model import ModelConfig
from tyro.conf import Suppress

from beags_plugin.options.scene_options import SceneOptions
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
