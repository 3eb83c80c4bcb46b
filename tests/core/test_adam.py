"""Several Adam optimizers stepped together against each stepped by torch."""

from __future__ import annotations

import warnings
from copy import deepcopy

import pytest
import torch

from beags_plugin.core.adam import clear_gradients, step_all

SHAPES = {"means": (37, 3), "opacities": (37, 1), "rest": (37, 15, 3), "unused": (5,)}
RATES = {"means": 1e-4, "opacities": 0.05, "rest": 1.25e-4, "unused": 0.1}
FUSED = torch.__version__ >= "2.4"


def make(fused: bool = FUSED, **options):
    generator = torch.Generator().manual_seed(0)
    parameters = {name: torch.nn.Parameter(torch.randn(shape, generator=generator)) for name, shape in SHAPES.items()}
    optimizers = {
        name: torch.optim.Adam([value], lr=RATES[name], eps=1e-15, fused=fused, **options)
        for name, value in parameters.items()
    }
    return parameters, optimizers


def give_gradients(parameters, step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    for name, value in parameters.items():
        gradient = torch.randn(value.shape, generator=generator)
        value.grad = None if name == "unused" or (name == "rest" and step == 1) else gradient


def assert_same(found, expected) -> None:
    for name in SHAPES:
        assert torch.equal(found[0][name], expected[0][name]), name
        (ours, theirs) = (optimizers[name].state_dict() for _, optimizers in (found, expected))
        assert ours["param_groups"] == theirs["param_groups"]
        assert ours["state"].keys() == theirs["state"].keys()
        for key, state in ours["state"].items():
            assert state.keys() == theirs["state"][key].keys()
            for what, value in state.items():
                assert value.dtype == theirs["state"][key][what].dtype
                assert torch.equal(value, theirs["state"][key][what]), (name, what)


@pytest.mark.parametrize(
    "options",
    [{}, {"fused": False}, {"weight_decay": 0.01}, {"amsgrad": True}, {"maximize": True}, {"betas": (0.8, 0.99)}],
    ids=str,
)
def test_the_same_bits_and_states_as_one_by_one(options):
    found, expected = make(**options), make(**options)
    for step in range(4):
        for parameters, optimizers in (found, expected):
            give_gradients(parameters, step)
            optimizers["means"].param_groups[0]["lr"] = 1e-4 / (step + 1)
        step_all(found[1].values())
        for optimizer in expected[1].values():
            optimizer.step()
        assert_same(found, expected)


def test_a_state_from_a_file_goes_on_either_way():
    found, expected = make(), make()
    for parameters, optimizers in (found, expected):
        give_gradients(parameters, 0)
        for optimizer in optimizers.values():
            optimizer.step()
    for name, optimizer in found[1].items():
        optimizer.load_state_dict(deepcopy(expected[1][name].state_dict()))
    for parameters, _ in (found, expected):
        give_gradients(parameters, 2)
    step_all(found[1].values())
    for optimizer in expected[1].values():
        optimizer.step()
    assert_same(found, expected)


def test_hooks_and_other_optimizers_are_asked_themselves():
    parameters, optimizers = make()
    give_gradients(parameters, 0)
    calls = []
    optimizers["means"].register_step_pre_hook(lambda *_: calls.append("means"))
    plain = torch.optim.SGD([parameters["opacities"]], lr=0.5)
    before = parameters["opacities"].detach().clone()
    step_all([optimizers["means"], plain])
    assert calls == ["means"]
    assert torch.equal(parameters["opacities"].detach(), before - 0.5 * parameters["opacities"].grad)


def test_a_torch_scheduler_sees_the_step():
    parameters, optimizers = make()
    scheduler = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.5)
    give_gradients(parameters, 0)
    step_all(optimizers.values())
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # torch warns of a scheduler that moves before its optimizer
        scheduler.step()
    assert optimizers["means"].param_groups[0]["lr"] == pytest.approx(0.5e-4)


def test_gradients_are_cleared():
    parameters, optimizers = make()
    give_gradients(parameters, 0)
    clear_gradients(optimizers.values())
    assert all(value.grad is None for value in parameters.values())
