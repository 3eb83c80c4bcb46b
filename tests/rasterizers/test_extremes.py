"""Extremes: ten thousand layers on a pixel, a million Gaussians, every class id that there is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import CLASSES, FLOATS, OUTPUTS, make_scene

from beags_plugin.assignment.assignment import by_largest
from beags_plugin.assignment.contributions import contributions
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs

MOST_CLASSES = 65_535  # ids 0 to 65,534; 65,535 is IGNORE


def layers(count: int, alpha: float) -> tuple[SurfelInputs, Camera, RasterSettings]:
    """Large discs that face the camera, one behind the other, of equal opacity; float64."""
    double = {"dtype": torch.float64}
    means = torch.zeros(count, 3, **double)
    means[:, 2] = torch.linspace(2.0, 4.0, count, **double)
    inputs = SurfelInputs(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], **double).repeat(count, 1),
        log_scales=torch.full((count, 2), 10.0, **double),
        opacity_logits=torch.full((count,), alpha, **double).logit(),
        colors=torch.rand(count, 3, generator=torch.Generator().manual_seed(0), **double),
        class_ids=torch.arange(count, dtype=torch.int32) % 3,
    )
    K = torch.tensor([[10.0, 0.0, 2.5], [0.0, 10.0, 1.5], [0.0, 0.0, 1.0]], **double)
    return inputs, Camera(torch.eye(4, **double), K, 5, 3), RasterSettings(0.1, 10.0, distortion=True)


@pytest.mark.parametrize("alpha", [0.0045, 0.8])
def test_ten_thousand_layers_on_a_pixel(rasterizer, alpha):
    """Light goes through two thousand thin layers until the least transmittance is reached, through five thick ones."""
    count = 10_000
    inputs, camera, settings = layers(count, alpha)
    leaves = {name: getattr(inputs, name).clone().requires_grad_() for name in FLOATS}
    target = torch.ones(3, 5, dtype=torch.int32)
    drawn = rasterizer.rasterize(
        replace(inputs, **leaves), camera, settings, torch.zeros(3, dtype=torch.float64), target
    )
    through = (1.0 - alpha) ** torch.arange(count + 1, dtype=torch.float64)
    used = int((through[1:] >= 1e-4).sum())  # E3: the one that would let less through is left out
    weights = alpha * through[:used]
    wrong = inputs.class_ids[:used] != 1
    for image, expected in (
        (drawn.color[1, 2], weights @ inputs.colors[:used]),
        (drawn.alpha[1, 2], weights.sum()),
        (drawn.depth[1, 2], weights @ inputs.means[:used, 2] / weights.sum()),
        (drawn.boundary[1, 2], weights[wrong].sum()),
    ):
        torch.testing.assert_close(image, expected, rtol=1e-9, atol=1e-12)
    sum(getattr(drawn, name).sum() for name in OUTPUTS).backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())
    reached = leaves["colors"].grad.abs().sum(dim=1) > 0
    assert reached[:used].all() and not reached[used:].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_million_gaussians(dtype):
    rasterizer = make_rasterizer("native")
    scene = make_scene(count=1_000_000, width=65, height=47, size=-6.0, opacity=-3.0).to(dtype)
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
    drawn = scene.draw(rasterizer, **leaves)
    sum(getattr(drawn, name).sum() for name in OUTPUTS).backward()
    assert all(getattr(drawn, name).isfinite().all() for name in OUTPUTS)
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())
    assert drawn.num_nonfinite == 0 and int(drawn.visible.sum()) > 300_000
    keys, sums = rasterizer.sparse_class_contributions(scene.inputs, scene.camera, scene.settings, scene.target, 4)
    assert (keys // 4).max() < 1_000_000 and len(keys) > 300_000
    labelled = drawn.alpha.detach()[scene.target != IGNORE].double().sum()
    torch.testing.assert_close(sums.double().sum(), labelled, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("num_classes", [1, MOST_CLASSES])
def test_one_class_and_as_many_as_there_are_ids(rasterizer, num_classes):
    scene = make_scene(count=60)
    step = max(num_classes // CLASSES, 1)
    last = num_classes - 1

    def renamed(ids):
        return (ids * step).clamp(max=last).int() if num_classes > 1 else torch.zeros_like(ids)

    known = scene.target != IGNORE
    target = torch.where(known, renamed(torch.where(known, scene.target, 0)), scene.target)
    target[0, 1] = last
    inputs = replace(scene.inputs, class_ids=renamed(scene.inputs.class_ids))
    inputs.class_ids[0] = last
    arguments = (inputs, scene.camera, scene.settings)
    parameters = (getattr(scene.inputs, name) for name in FLOATS[:4])
    surfels = Surfels.of(*parameters, scene.inputs.colors[:, None])
    assigned = by_largest(contributions(surfels, [scene.camera], [target], rasterizer, scene.settings, num_classes))
    assert int(assigned.class_ids.max()) <= last and int(assigned.class_ids.min()) >= 0
    ids, share = rasterizer.class_map(*arguments, num_classes)
    assert int(ids[ids != IGNORE].max()) <= last and share.isfinite().all()
    boundary = replace(scene, inputs=inputs, target=ids).draw(rasterizer).boundary
    alpha = scene.draw(rasterizer).alpha
    torch.testing.assert_close(share * alpha, alpha - boundary, rtol=1e-9, atol=1e-10)
    if num_classes == 1:
        assert not boundary.any()


def test_unlabelled_masks_give_no_boundary(rasterizer):
    scene = make_scene()
    target = torch.full_like(scene.target, IGNORE)
    opacity = scene.inputs.opacity_logits.clone().requires_grad_()
    drawn = replace(scene, target=target).draw(rasterizer, opacity_logits=opacity)
    assert not drawn.boundary.any()
    drawn.boundary.sum().backward()
    assert not opacity.grad.any()
