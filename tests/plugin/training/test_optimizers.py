"""The scene's one Adam against one of torch's for each group."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")
from torch.cuda.amp.grad_scaler import GradScaler

from beags_plugin.plugin.options.config import base_config
from beags_plugin.plugin.training.optimizers import SCENE, SceneOptimizer

SHAPES = {"means": (37, 3), "features_dc": (37, 3), "features_rest": (37, 15, 3), "opacities": (37, 1)}
SHAPES |= {"scales": (37, 2), "quats": (37, 4)}


@pytest.fixture
def configs():
    return base_config().optimizers


def parameters() -> dict[str, list[torch.nn.Parameter]]:
    generator = torch.Generator().manual_seed(0)
    return {name: [torch.nn.Parameter(torch.randn(shape, generator=generator))] for name, shape in SHAPES.items()}


def give_gradients(groups, step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    for name, (value,) in groups.items():
        gradient = torch.randn(value.shape, generator=generator)
        value.grad = None if name == "features_rest" and step == 1 else gradient  # unused at degree 0


def test_every_group_moves_as_under_an_optimizer_of_its_own(configs):
    ours, theirs = parameters(), parameters()
    joint = SceneOptimizer(configs, ours)
    single = {
        name: torch.optim.Adam(values, lr=configs[name]["optimizer"].lr, eps=1e-15, fused=True)
        for name, values in theirs.items()
    }
    for step in range(4):
        joint.zero_grad_some([SCENE])
        assert all(value.grad is None for (value,) in ours.values())
        give_gradients(ours, step)
        give_gradients(theirs, step)
        joint.optimizer_scaler_step_some(GradScaler(enabled=False), [SCENE])
        for optimizer in single.values():
            optimizer.step()
        assert all(torch.equal(ours[name][0], theirs[name][0]) for name in SHAPES)


def test_a_group_is_clipped_where_its_config_asks_for_it(configs):
    configs["means"]["optimizer"].max_norm = 1e-3
    groups = parameters()
    joint = SceneOptimizer(configs, groups)
    give_gradients(groups, 0)
    before = groups["scales"][0].grad.clone()
    joint.optimizer_scaler_step_some(GradScaler(enabled=False), [SCENE])
    assert groups["means"][0].grad.norm() == pytest.approx(1e-3, rel=1e-3)
    assert torch.equal(groups["scales"][0].grad, before)


def test_its_state_goes_through_a_file(configs, tmp_path):
    first, second = parameters(), parameters()
    one, other = SceneOptimizer(configs, first), SceneOptimizer(configs, second)
    give_gradients(first, 0)
    one.optimizer_scaler_step_some(GradScaler(enabled=False), [SCENE])
    torch.save({SCENE: one.adam.state_dict()}, tmp_path / "state.pt")
    other.load_optimizers(torch.load(tmp_path / "state.pt", weights_only=True))
    for name in SHAPES:
        second[name][0].data.copy_(first[name][0])
    for groups, optimizer in ((first, one), (second, other)):
        give_gradients(groups, 2)
        optimizer.optimizer_scaler_step_some(GradScaler(enabled=False), [SCENE])
    assert all(torch.equal(first[name][0], second[name][0]) for name in SHAPES)


def test_decay_takes_a_share_of_values_away_whatever_their_gradients_were(configs):
    decay = 1.2
    groups, plain = parameters(), parameters()
    decaying, other = SceneOptimizer(configs, groups), SceneOptimizer(configs, plain)
    (group,) = (each for each in decaying.adam.param_groups if each["name"] == "features_rest")
    group["weight_decay"] = decay
    for step in (0, 2):
        for values, optimizer in ((groups, decaying), (plain, other)):
            give_gradients(values, step)
            before = {name: value.detach().clone() for name, (value,) in values.items()}
            optimizer.optimizer_scaler_step_some(GradScaler(enabled=False), [SCENE])
            moved = {name: value.detach() - before[name] for name, (value,) in values.items()}
            if optimizer is decaying:
                with_decay, start = moved, before["features_rest"]
        assert all(torch.equal(with_decay[name], moved[name]) for name in SHAPES if name != "features_rest")
        taken = moved["features_rest"] - with_decay["features_rest"]
        torch.testing.assert_close(taken, group["lr"] * decay * start, atol=2e-7, rtol=1e-3)
