"""Gaussian Grouping: the specification's numbers, what gradients reach, and objects by threshold and hull."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import make_scene
from torch import nn

from beags_baselines import identity_codes
from beags_baselines.identity_codes import members, nearest_in_space, neighbour_loss, pixel_loss
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.torch_reference import TorchRasterizer


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def constant(num_classes: int) -> nn.Linear:
    """A classifier to which all codes are alike."""
    layer = nn.Linear(16, num_classes)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def test_the_start_comes_from_the_generator_alone():
    codes = identity_codes.initial_codes(20_000, generator())
    assert codes.shape == (20_000, 16) and codes.dtype == torch.float32
    bound = 0.5 / 0.28209479
    assert [float(codes.min()), float(codes.max())] == pytest.approx([-bound, bound], abs=1e-3)
    assert float(codes.std()) == pytest.approx(bound / 3**0.5, rel=0.01)

    before = torch.get_rng_state()
    layer, again = (identity_codes.initial_classifier(40, generator(3)) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    for values, same in zip(layer.parameters(), again.parameters(), strict=True):
        assert torch.equal(values, same) and values.requires_grad
        assert 0.2 < float(values.detach().abs().max()) <= 0.25
    assert layer.weight.shape == (40, 16)
    assert [identity_codes.rate_factor(steps) for steps in (30_000, 10_000, 3_000, 300)] == [1.0, 3.0, 10.0, 10.0]


@pytest.mark.parametrize(("num_classes", "loss"), [(256, 1.0), (5, 0.290)])
def test_the_loss_of_uniform_logits(num_classes, loss):
    drawn = torch.rand(4, 6, 16, generator=generator())
    labels = torch.arange(24, dtype=torch.int32).view(4, 6) % num_classes
    found = pixel_loss(constant(num_classes), drawn, labels)
    assert float(found.detach()) == pytest.approx(loss, abs=3e-4)
    assert float(found.detach()) == pytest.approx(math.log(num_classes) / math.log(256), rel=1e-6)
    labels[:, 3:] = IGNORE
    assert float(pixel_loss(constant(num_classes), drawn, labels).detach()) == pytest.approx(loss, abs=3e-4)
    for none in (None, torch.full_like(labels, IGNORE)):
        assert float(pixel_loss(constant(num_classes), drawn, none).detach()) == 0.0


def test_neighbours_differ_by_the_mean_divergence():
    codes = torch.tensor([[0.9, 0.1], [0.1, 0.9]], dtype=torch.float64).log().requires_grad_()
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    groups = nearest_in_space(means, generator(), nearest=2)
    assert sorted(groups.tolist()) == [[0, 0, 1], [1, 1, 0]]
    loss = neighbour_loss(nn.Identity(), codes, groups)
    assert float(loss.detach()) * 256 / 2 == pytest.approx(0.8789, abs=5e-5)
    assert float(loss.detach()) == pytest.approx(0.006866, abs=5e-7)
    assert torch.equal(nearest_in_space(means[:1], generator()), torch.tensor([[0, 0]]))  # fewer than five are no error


def test_the_nearest_are_those_of_the_sample():
    means = torch.randn(300, 3, generator=generator())
    groups = nearest_in_space(means, generator(1), anchors=20, largest_sample=200)
    assert groups.shape == (20, 6) and len(groups[:, 0].unique()) == 20
    assert torch.equal(groups, nearest_in_space(means, generator(1), anchors=20, largest_sample=200))
    sample = torch.randperm(300, generator=generator(1))[:200]
    for anchor, *nearest in groups.tolist():
        order = (means[sample] - means[anchor]).norm(dim=-1).argsort()[:5]
        assert nearest == sample[order].tolist() and nearest[0] == anchor
    means[7] = torch.nan
    assert nearest_in_space(means, generator(), anchors=5).shape == (5, 6)


def test_gradients_of_neighbours_reach_codes_and_classifier():
    codes = identity_codes.initial_codes(50, generator()).requires_grad_()
    means = torch.randn(50, 3, generator=generator()).requires_grad_()
    classifier = identity_codes.initial_classifier(4, generator())
    groups = nearest_in_space(means, generator(), anchors=3)
    neighbour_loss(classifier, codes, groups).backward()
    reached = codes.grad.abs().sum(dim=-1) > 0
    assert reached.nonzero()[:, 0].tolist() == sorted(set(groups.flatten().tolist()))  # anchors and neighbours
    assert means.grad is None
    assert classifier.weight.grad.any() and classifier.bias.grad.any()


@pytest.mark.parametrize("num_classes", [5, 37])
def test_losses_and_gradients_do_not_depend_on_the_number_of_threads(num_classes, for_threads):
    groups = torch.randint(0, 60, (1_000, 6), generator=generator())  # each Gaussian in many places
    drawn = torch.rand(67, 90, 16, generator=generator())
    labels = torch.randint(0, num_classes, (67, 90), generator=generator())

    def run() -> list[torch.Tensor]:
        classifier = identity_codes.initial_classifier(num_classes, generator())
        leaves = [identity_codes.initial_codes(60, generator()), drawn]
        codes, picture = (values.clone().requires_grad_() for values in leaves)
        loss = neighbour_loss(classifier, codes, groups) + pixel_loss(classifier, picture, labels)
        return [loss, *torch.autograd.grad(loss, [codes, picture, *classifier.parameters()])]

    found = [*for_threads(run), *for_threads(run)]
    assert all(torch.equal(first, each) for first, *rest in zip(*found, strict=True) for each in rest)


def test_the_classifier_is_a_linear_layer():
    layer, codes = identity_codes.initial_classifier(5, generator()), torch.rand(3, 7, 16, generator=generator())
    plain = [values.detach().double().requires_grad_() for values in (codes, layer.weight, layer.bias)]
    slope = torch.randn(3, 7, 5, generator=generator())
    expected = torch.nn.functional.linear(*plain)
    codes.requires_grad_()
    found = layer(codes)
    assert torch.allclose(found.double(), expected, atol=1e-6)
    wanted = torch.autograd.grad(expected, plain, slope.double())
    for value, true in zip(torch.autograd.grad(found, [codes, *layer.parameters()], slope), wanted, strict=True):
        assert torch.allclose(value.double(), true, atol=1e-5)


def test_gradients_of_pixels_reach_the_geometry():
    scene = make_scene(count=12, size=-1.0)
    names = ("means", "quats", "log_scales", "opacity_logits", "colors")
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in names}
    classifier = nn.Linear(3, 4, dtype=torch.float64)  # takes three channels, which are rendered as colours
    scene = replace(scene, background=torch.zeros(3, dtype=torch.float64))
    pixel_loss(classifier, scene.draw(TorchRasterizer(), **leaves).color, scene.target).backward()
    assert all(leaf.grad.abs().max() > 1e-6 for leaf in leaves.values())
    assert all(values.grad.any() for values in classifier.parameters())


def test_the_share_of_right_pixels():
    labels = torch.tensor([[0, 1, IGNORE], [2, 2, 0]], dtype=torch.int32)
    logits = torch.nn.functional.one_hot(torch.tensor([[0, 1, 1], [2, 0, 0]]), 3).float()
    assert [int(value) for value in identity_codes.right_pixels(logits, labels)] == [4, 5]


def test_objects_by_threshold():
    table = torch.tensor([[0.35, 0.33, 0.32, 0.0], [0.28, 0.27, 0.25, 0.20]])
    means = torch.zeros(2, 3)
    found = [members(table, class_id, means, hull=False).tolist() for class_id in range(4)]
    assert found == [[True, False]] * 3 + [[False, False]]


CORNERS = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
INSIDE, BETWEEN = [[0.0, 0.0, 0.0], [0.9, 0.9, 0.9]], [[1.5, 0.0, 0.0], [5.0, 0.0, 0.0]]
ON_AXES = [[sign * float(axis == place) for place in range(3)] for axis in range(3) for sign in (1, -1)]


@pytest.mark.parametrize(
    ("chosen", "others", "joining"),
    [
        pytest.param([*CORNERS, [10.0, 0.0, 0.0]], [*INSIDE, *BETWEEN], 2, id="an outlier stretches no hull"),
        pytest.param(ON_AXES, INSIDE[:1], 0, id="all six are outliers"),
        pytest.param([[x, y, 0.0] for x, y, z in CORNERS], INSIDE[:1], 0, id="all in a plane"),
        pytest.param(CORNERS[:4], INSIDE, 0, id="four"),
        pytest.param([], INSIDE, 0, id="nobody"),
        pytest.param(CORNERS, [*INSIDE, [math.nan] * 3, [math.inf] * 3], 2, id="broken centres"),
    ],
)
def test_the_hull_takes_in_what_lies_inside(chosen, others, joining):
    means = torch.tensor([*chosen, *others])
    share = torch.tensor([0.4] * len(chosen) + [0.1] * len(others))
    table = torch.stack([1 - share, share], dim=1)
    found = members(table, 1, means)
    expected = [True] * (len(chosen) + joining) + [False] * (len(others) - joining)
    assert found.tolist() == expected
    assert int(members(table, 1, means, hull=False).sum()) == len(chosen)
