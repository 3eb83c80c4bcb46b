"""Edits of the scene while it trains: parameters change in number, and Adam's moments follow them."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.densification import Densified
from beags_plugin.plugin.training.scene_model import SceneModel


def edit_scene(model: SceneModel, optimizers: dict[str, torch.optim.Optimizer], edited: Densified) -> None:
    """Let the model and its optimizers go on with the edited surfels; their classes are reset."""
    former = dict(model.gauss_params.items())
    model.replace_surfels(edited.surfels)
    for name, optimizer in optimizers.items():
        move_adam_state(optimizer, former[name], model.gauss_params[name], edited.source, edited.fresh)


def move_adam_state(
    optimizer: torch.optim.Optimizer, former: Tensor, parameter: Tensor, source: Tensor, fresh: Tensor
) -> None:
    """Let an optimizer go on with ``parameter`` in place of ``former``; Adam's moments follow their surfels and bands.

    source: [M] int64, the former index of each surfel; fresh: [M] bool, new ones, whose moments start at 0.
    """
    state = optimizer.state.pop(former, {})
    for name in ("exp_avg", "exp_avg_sq"):
        if name in state:
            moved = state[name][source.to(state[name].device)]
            if moved.dim() > 1:
                moved = moved[:, : parameter.shape[1]].contiguous()  # of the bands that are left
            moved[fresh.to(moved.device)] = 0.0
            state[name] = moved
    optimizer.state[parameter] = state
    for group in optimizer.param_groups:
        group["params"] = [parameter if held is former else held for held in group["params"]]
