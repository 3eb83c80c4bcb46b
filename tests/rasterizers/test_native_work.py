"""The compiled rasterizer computes what is asked for, and no more: variants, needed gradients, counts of work."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch
from raster_scenes import FLOATS, OUTPUTS, gradients, make_scene

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers import native
from beags_plugin.rasterizers.autograd import InputGradients
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer

needs_native = pytest.mark.skipif(
    NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable())
)


@needs_native
def test_what_is_not_asked_for_is_none_and_changes_nothing():
    scene = make_scene()
    bare = replace(scene, settings=replace(scene.settings, geometry=False, distortion=False))
    found = NativeRasterizer().rasterize(bare.inputs, bare.camera, bare.settings, bare.background)
    full = scene.draw(NativeRasterizer())
    for name in ("depth", "median_depth", "normal", "distortion", "boundary"):
        assert getattr(found, name) is None
    assert torch.equal(found.color, full.color)
    assert torch.equal(found.alpha, full.alpha)


@needs_native
@pytest.mark.parametrize(("geometry", "distortion", "boundary"), list(product((False, True), repeat=3)))
def test_what_is_asked_for_does_not_depend_on_what_else_is(geometry, distortion, boundary):
    """Each set of outputs has kernels of its own; values and gradients come out the same, bit by bit."""
    scene = make_scene(count=120, width=71, height=51, seed=3, size=-1.8).to(torch.float32)
    settings = replace(scene.settings, geometry=geometry, distortion=distortion)
    target = scene.target if boundary else None
    images = {"color", "alpha"}
    images |= {"depth", "median_depth", "normal"} if geometry else set()
    images |= {"distortion"} if distortion else set()
    images |= {"boundary"} if boundary else set()
    runs = []
    for some in (False, True):
        leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
        inputs = replace(scene.inputs, **leaves)
        how = (settings, scene.background, target) if some else (scene.settings, scene.background, scene.target)
        render = NativeRasterizer().rasterize(inputs, scene.camera, *how)
        loss = sum(getattr(render, name).square().sum() for name in sorted(images))
        if not some:  # the kernels with everything, towards which the rest has no gradient
            loss = loss + sum(0 * getattr(render, name).sum() for name in OUTPUTS)
        grads = torch.autograd.grad(loss, list(leaves.values()))
        runs.append([getattr(render, name).detach() for name in sorted(images)] + list(grads))
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


class Watched(NativeRasterizer):
    """Remembers what its kernels were asked for, and what the backward returned."""

    def __init__(self):
        super().__init__()
        self.differentiable, self.backwards = [], []

    def forward_kernel(self, call):
        self.differentiable.append(call.differentiable)
        return super().forward_kernel(call)

    def backward_kernel(self, call, state, gradients, needed):
        found = super().backward_kernel(call, state, gradients, needed)
        self.backwards.append((needed, found))
        return found


WANTED = [
    ("colors",),
    ("background",),
    ("opacity_logits",),
    ("quats",),
    ("colors", "opacity_logits"),
    ("means", "quats", "log_scales"),
]


@needs_native
@pytest.mark.parametrize("only", [("color",), OUTPUTS])
@pytest.mark.parametrize("wanted", WANTED)
def test_needed_gradients_alone_are_made_and_have_the_same_bits(wanted, only):
    scene = make_scene().to(torch.float32)
    everything = gradients(NativeRasterizer(), scene, only)
    rasterizer = Watched()
    found = gradients(rasterizer, scene, only, wanted)
    assert all(found[name].any() and torch.equal(found[name], everything[name]) for name in wanted)
    [(needed, made)] = rasterizer.backwards
    assert {name for name, asked in zip(InputGradients._fields, needed, strict=True) if asked} == set(wanted)
    assert {name for name, value in made._asdict().items() if value is not None} == set(wanted)


@needs_native
def test_without_gradients_nothing_is_kept_for_a_backward():
    scene, rasterizer = make_scene(), Watched()
    assert not scene.draw(rasterizer).color.requires_grad
    means = scene.inputs.means.clone().requires_grad_()
    with torch.no_grad():
        assert not scene.draw(rasterizer, means=means).color.requires_grad
    assert scene.draw(rasterizer, means=means).color.requires_grad
    assert rasterizer.differentiable == [False, False, True]


def across_many_tiles():
    """Surfels wider than the 64 groups of pixels that binning takes at a time."""
    scene = make_scene(count=60, width=1300, height=37, seed=3, size=-0.5)
    K = torch.tensor([[1200.0, 0, 600.3], [0, 43.0, 16.2], [0, 0, 1.0]], dtype=torch.float64)
    return replace(scene, camera=replace(scene.camera, K=K))


@needs_native
@pytest.mark.parametrize(
    "scene", [make_scene(count=120, width=71, height=51, seed=3, size=-1.8), across_many_tiles()], ids=["small", "wide"]
)
def test_work_is_counted(scene):
    counts = native.work_counts(scene.inputs, scene.camera, scene.settings)
    reference = TorchRasterizer()
    blocks = reference._blocks(scene.inputs, scene.camera, scene.settings)
    assert counts.contributing == sum(int((block.weights > 0).sum()) for block in blocks)
    assert counts.lanes >= counts.contributing
    assert 0 < counts.tile_pairs < counts.box_pairs


@needs_native
def test_bounds_are_tight():
    """Few pixels are looked at in vain in scenes like captures, with surfels some 17 pixels wide."""
    scene = make_scene(count=1000, width=128, height=96, seed=2, opacity=-1.0, size=-1.8)
    camera = replace(scene.camera, K=torch.tensor([[100.0, 0, 60.0], [0, 100.0, 50.0], [0, 0, 1.0]]).double())
    counts = native.work_counts(scene.to(torch.float32).inputs, camera.to(torch.float32), scene.settings)
    assert counts.lanes <= 1.5 * counts.contributing
    assert counts.tile_pairs <= 0.85 * counts.box_pairs


@needs_native
def test_usual_boxes_are_those_of_a_surfel_that_faces_the_camera():
    one = make_scene(count=1)
    means = torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    inputs = replace(one.inputs, means=means, quats=quats, log_scales=torch.tensor([[-1.0, -2.0]], dtype=torch.float64))
    K = torch.tensor([[200.0, 0, 100.0], [0, 200.0, 60.0], [0, 0, 1.0]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 300, 200)
    # 3.33 e^-1 200 / 4 = 61.25 and 3.33 e^-2 200 / 4 = 22.5: columns 38.7 .. 161.3, rows 37.5 .. 82.5
    assert native.work_counts(inputs, camera, one.settings).box_pairs == (11 - 2) * (6 - 2)
