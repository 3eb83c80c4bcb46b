"""Edit the scene while it trains: Gaussians change in number, and Adam's moments follow them."""

from __future__ import annotations

from torch import Tensor
from torch.optim import Adam

from beags_plugin.core.densification import Densified
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.preparation.refiner_training import Edit


def edit_scene(model: SceneModel, adam: Adam, edited: Densified) -> None:
    """Put the edited Gaussians into the model and its optimizer, with the classes of their sources."""
    former = dict(model.gauss_params.items())
    class_ids, margin = model.class_ids, model.class_margin
    model.replace_surfels(edited.surfels)
    source = edited.source.to(class_ids.device)
    model.class_ids, model.class_margin = class_ids[source], margin[source]
    for group in adam.param_groups:
        name = group["name"]
        move_adam_state(adam, former[name], model.gauss_params[name], edited.source, edited.fresh)


def apply_edit(model: SceneModel, adam: Adam, edit: Edit | None) -> None:
    """Apply a refiner's edit to the scene and its optimizer."""
    if edit is None:
        return
    if edit.edited is not None:
        edit_scene(model, adam, edit.edited)
        model.last_render = None
    if edit.fresh_adam:
        adam.state.clear()


def move_adam_state(adam: Adam, former: Tensor, parameter: Tensor, source: Tensor, fresh: Tensor) -> None:
    """Put ``parameter`` in place of ``former`` in the optimizer; Adam's moments follow their Gaussians.

    source: [M] int64, the former index of each Gaussian; fresh: [M] bool, new ones, whose moments start at 0.
    """
    state = adam.state.pop(former, {})
    for name in ("exp_avg", "exp_avg_sq"):
        if name in state:
            moved = state[name][source.to(state[name].device)]
            moved[fresh.to(moved.device)] = 0.0
            state[name] = moved
    adam.state[parameter] = state
    for group in adam.param_groups:
        group["params"] = [parameter if held is former else held for held in group["params"]]
