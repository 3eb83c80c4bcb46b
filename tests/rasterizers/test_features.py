"""Channels beside the colours: values and gradients against hand-worked layers, class sums and the torch reference."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import CLASSES, FLOATS, SCENES, error, facing, make_scene

from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import draw_features
from beags_plugin.rasterizers.torch_reference import TorchRasterizer

GEOMETRY = [name for name in FLOATS if name != "colors"]


def test_two_layers_over_a_pixel(rasterizer):
    """E = (0.6, 0.4 0.9, 0, ..); by the alphas, E1 + E2 = 1 - (1 - a)(1 - b) has the slopes 1 - b and 1 - a."""
    inputs, camera = facing(1, 1, [(0.5, 0.5, 1e6, 0.6), (0.5, 0.5, 1e6, 0.9)])
    logits = inputs.opacity_logits.requires_grad_()
    features = torch.eye(2, 5, dtype=torch.float64, requires_grad=True)
    drawn = draw_features(rasterizer, inputs, features, camera, RasterSettings(near=0.1, far=100.0))
    assert drawn.flatten().tolist() == pytest.approx([0.6, 0.36, 0, 0, 0], abs=1e-9)
    drawn[..., :2].sum().backward()
    slopes = logits.grad / (torch.sigmoid(logits) * (1 - torch.sigmoid(logits)))
    assert slopes.tolist() == pytest.approx([0.1, 0.4], abs=1e-9)
    by_features = torch.tensor([[0.6] * 2 + [0.0] * 3, [0.36] * 2 + [0.0] * 3], dtype=torch.float64)
    torch.testing.assert_close(features.grad, by_features)


def test_class_ids_as_features_give_the_sums_by_class(rasterizer):
    scene = make_scene()
    what = (scene.camera, scene.settings)
    one_hot = torch.nn.functional.one_hot(scene.inputs.class_ids.long(), CLASSES).double()
    drawn = draw_features(rasterizer, scene.inputs, one_hot, *what)
    by_surfel = rasterizer.class_contributions(scene.inputs, *what, scene.target, CLASSES)
    seen_as = torch.stack([drawn[scene.target == c].sum(0) for c in range(CLASSES)], dim=1)
    torch.testing.assert_close(seen_as, one_hot.T @ by_surfel)
    classes, share = rasterizer.class_map(scene.inputs, *what, CLASSES)
    alpha = drawn.sum(-1)
    assert torch.equal(drawn.argmax(-1).int()[alpha > 0], classes[alpha > 0])
    torch.testing.assert_close(drawn.amax(-1), share * alpha)


def leaves_of(scene):
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in GEOMETRY}
    leaves["screen_shift"] = torch.zeros_like(scene.inputs.means[:, :2]).requires_grad_()
    return leaves


@pytest.mark.parametrize("channels", [1, 2, 16, 17])
@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_the_references(name, channels, compiled):
    scene, g = SCENES[name](), torch.Generator().manual_seed(5)
    features = torch.randn(len(scene.inputs.means), channels, generator=g, dtype=torch.float64)
    factors = torch.randn(scene.camera.height, scene.camera.width, channels, generator=g, dtype=torch.float64)
    found = []
    for backend in (compiled, TorchRasterizer()):
        leaves = leaves_of(scene)
        inputs, those = replace(scene.inputs, **leaves), features.clone().requires_grad_()
        drawn = draw_features(backend, inputs, those, scene.camera, scene.settings)
        assert drawn.shape == factors.shape
        found.append([drawn, *torch.autograd.grad((drawn * factors).sum(), [*leaves.values(), those])])
    assert all(error(a.detach(), b.detach()) < 1e-9 for a, b in zip(*found, strict=True))
    alone = features.clone().requires_grad_()
    drawn = draw_features(compiled, scene.inputs, alone, scene.camera, scene.settings)
    assert error(torch.autograd.grad((drawn * factors).sum(), alone)[0], found[1][-1]) < 1e-9


@pytest.mark.parametrize("spoilt", ["means", "colors", "features"])
@pytest.mark.parametrize("channels", [4, 5])
def test_broken_surfels_have_no_part_in_the_channels(channels, spoilt, rasterizer):
    scene, g = make_scene(), torch.Generator().manual_seed(5)
    features = torch.randn(len(scene.inputs.means), channels, generator=g, dtype=torch.float64)
    whole, leaves = torch.arange(len(features)) != 3, leaves_of(scene)
    with torch.no_grad():
        {**leaves, "colors": scene.inputs.colors, "features": features}[spoilt][3, 1] = float("inf")
    others = {name: value.detach()[whole].requires_grad_() for name, value in leaves.items()}
    rest = replace(scene.inputs, colors=scene.inputs.colors[whole], class_ids=scene.inputs.class_ids[whole], **others)
    found = []
    for inputs, those, of in (
        (replace(scene.inputs, **leaves), features.requires_grad_(), leaves),
        (rest, features.detach()[whole].requires_grad_(), others),
    ):
        drawn = draw_features(rasterizer, inputs, those, scene.camera, scene.settings)
        found.append([drawn, *torch.autograd.grad(drawn.square().sum(), [*of.values(), those])])
    (drawn, *gradients), (expected, *true) = found
    torch.testing.assert_close(drawn, expected)
    assert all((a[3] == 0).all() and error(a[whole], b) < 1e-9 for a, b in zip(gradients, true, strict=True))


def test_features_of_another_dtype_or_number_are_refused(rasterizer):
    scene = make_scene()
    for wrong in (torch.zeros(len(scene.inputs.means), 5), torch.zeros(3, 5, dtype=torch.float64)):
        with pytest.raises(ValueError, match="features must be"):
            draw_features(rasterizer, scene.inputs, wrong, scene.camera, scene.settings)


@pytest.mark.parametrize(("name", "step"), [*((name, 1) for name in SCENES), ("wide", 7)])
def test_class_channels_are_the_features_of_class_ids(name, step, rasterizer):
    """With ids 0, 7, 14, 21 most classes have no surfel."""
    scene = make_scene(count=120, width=71, height=51, seed=3) if name == "wide" else SCENES[name]()
    num_classes, ids = step * (CLASSES - 1) + 1, scene.inputs.class_ids
    one_hot = torch.nn.functional.one_hot(ids.long(), CLASSES).double()
    g, what = torch.Generator().manual_seed(6), (scene.camera, scene.settings)
    factors = torch.randn(scene.camera.height, scene.camera.width, num_classes, generator=g, dtype=torch.float64)
    leaves, others = leaves_of(scene), leaves_of(scene)
    inputs = replace(scene.inputs, class_ids=ids * step, **leaves)
    drawn = rasterizer.class_channels(inputs, *what, num_classes)
    assert drawn.shape == factors.shape
    assert torch.equal(rasterizer.class_channels(inputs.detached(), *what, num_classes), drawn.detach())
    expected = draw_features(TorchRasterizer(), replace(scene.inputs, **others), one_hot, *what)
    assert error(drawn[..., ::step].detach(), expected.detach()) < 1e-9
    assert drawn.sum().item() == pytest.approx(expected.sum().item())
    found = torch.autograd.grad((drawn * factors).sum(), list(leaves.values()))
    true = torch.autograd.grad((expected * factors[..., ::step]).sum(), list(others.values()))
    assert all(error(a, b) < 1e-9 for a, b in zip(found, true, strict=True))


def test_float32_stays_within_its_band(rasterizer):
    found = []
    for backend, scene in ((rasterizer, make_scene().to(torch.float32)), (TorchRasterizer(), make_scene())):
        leaves = leaves_of(scene)
        inputs = replace(scene.inputs, **leaves)
        found.append([])
        features = torch.randn(len(inputs.means), 17, generator=torch.Generator().manual_seed(5)).to(inputs.means)
        for drawn in (
            backend.class_channels(inputs, scene.camera, scene.settings, CLASSES),
            draw_features(backend, inputs, features, scene.camera, scene.settings),
        ):
            found[-1] += [drawn.detach(), *torch.autograd.grad(drawn.square().sum(), list(leaves.values()))]
    assert all(a.dtype == torch.float32 for a in found[0])
    assert all(error(a, b) < 2e-4 for a, b in zip(*found, strict=True))


TARGETS = {  # the target class: the loss, and its slopes by the two alphas
    1: (0.920828, (-0.890048, 0.180148)),
    0: (1.420828, None),
}


@pytest.mark.parametrize("target", TARGETS)
def test_cross_entropy_of_class_channels_over_a_pixel(target, rasterizer):
    """Front of class 1 and alpha 0.5, back of class 2 and alpha 0.8: p = (0, 0.5, 0.4)."""
    inputs, camera = facing(1, 1, [(0.5, 0.5, 1e6, 0.5), (0.5, 0.5, 1e6, 0.8)])
    inputs = replace(inputs, class_ids=torch.tensor([1, 2], dtype=torch.int32))
    logits = inputs.opacity_logits.requires_grad_()
    p = rasterizer.class_channels(inputs, camera, RasterSettings(near=0.1, far=100.0), 3)
    assert p.flatten().tolist() == pytest.approx([0.0, 0.5, 0.4], abs=1e-9)
    loss = torch.nn.functional.cross_entropy(p.view(1, 3), torch.tensor([target]))
    loss.backward()
    expected, slopes = TARGETS[target]
    assert loss.item() == pytest.approx(expected, abs=1e-6)
    if slopes is not None:
        found = logits.grad / (torch.sigmoid(logits) * (1 - torch.sigmoid(logits)))
        assert found.tolist() == pytest.approx(slopes, abs=1e-6)


def test_ids_of_no_class_are_refused(rasterizer):
    scene = make_scene()
    with pytest.raises(ValueError, match=r"class_ids must lie in 0\.\.1"):
        rasterizer.class_channels(scene.inputs, scene.camera, scene.settings, 2)
