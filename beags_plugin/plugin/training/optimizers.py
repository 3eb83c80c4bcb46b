"""One Adam for the whole scene, with a group for each kind of parameter, as in the official 2DGS code."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch.cuda.amp.grad_scaler import GradScaler
from torch.nn import Parameter

SCENE = "scene"  # Name of the one optimizer in nerfstudio and in checkpoints.


class SceneOptimizer(Optimizers):
    """One Adam for all parameters of the scene; its ``param_groups`` carry the names and rates of the config.

    ``weight_decay`` is AdamW's, which never enters the moments.
    """

    def __init__(self, config: dict[str, Any], param_groups: dict[str, list[Parameter]]) -> None:
        groups = []
        for name, parameters in param_groups.items():
            options = config[name]["optimizer"]
            groups.append({"params": parameters, "name": name, "lr": options.lr, "eps": options.eps})
            groups[-1] |= {"weight_decay": options.weight_decay, "fused": options.fused}
        self.config = config
        self.adam = torch.optim.AdamW(groups)
        self.optimizers = {SCENE: self.adam}
        self.schedulers = {}
        self.parameters = {SCENE: [value for parameters in param_groups.values() for value in parameters]}

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Clip the gradients of groups whose config says so, and step."""
        groups = self.adam.param_groups  # self.parameters holds only the first step's.
        norms = {group["name"]: self.config[group["name"]]["optimizer"].max_norm for group in groups}
        if any(norm is not None for norm in norms.values()):
            grad_scaler.unscale_(self.adam)
            for group in groups:
                if (norm := norms[group["name"]]) is not None:
                    torch.nn.utils.clip_grad_norm_(group["params"], norm)
        if any(value.grad is not None for group in groups for value in group["params"]):
            grad_scaler.step(self.adam)
