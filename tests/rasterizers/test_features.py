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


@pytest.mark.parametrize("channels", [1, 3, 7])
@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_the_references(name, channels, rasterizer):
    scene, g = SCENES[name](), torch.Generator().manual_seed(5)
    count, image = len(scene.inputs.means), (scene.camera.height, scene.camera.width)
    features = torch.randn(count, channels, generator=g, dtype=torch.float64)
    factors = torch.randn(*image, channels, generator=g, dtype=torch.float64)
    found = []
    for backend in (rasterizer, TorchRasterizer()):
        leaves = {n: getattr(scene.inputs, n).clone().requires_grad_() for n in GEOMETRY}
        leaves["features"] = features.clone().requires_grad_()
        inputs = replace(scene.inputs, **{n: leaves[n] for n in GEOMETRY})
        drawn = draw_features(backend, inputs, leaves["features"], scene.camera, scene.settings)
        assert drawn.shape == factors.shape
        found.append([drawn, *torch.autograd.grad((drawn * factors).sum(), list(leaves.values()))])
    assert all(error(a.detach(), b.detach()) < 1e-9 for a, b in zip(*found, strict=True))
