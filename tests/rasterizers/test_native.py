"""The compiled CPU rasterizer: the same bits on any number of threads, and sentences where it is missing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import (
    CLASSES,
    OUTPUTS,
    gradients,
    make_scene,
)

from beags_plugin.ops import cuda_extension, extension
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.rendering import draw_features
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError

needs_native = pytest.mark.skipif(
    NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable())
)


@pytest.fixture
def threads():
    """Restores the number of threads."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@needs_native
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_threads_gives_the_same_bits(dtype, threads):
    scene = make_scene(count=2500, width=71, height=51, seed=4, size=-2.5).to(dtype)  # enough surfels for a team
    backend = NativeRasterizer()
    runs = []
    for count in (1, 2, 4):
        threads(count)
        render = scene.draw(backend)
        results = [getattr(render, name) for name in OUTPUTS] + [render.visible]
        results += list(gradients(backend, scene).values())
        means = scene.inputs.means.clone().requires_grad_()
        inputs = replace(scene.inputs, means=means)
        products, features = (scene.inputs, scene.camera, scene.settings), inputs.colors.repeat(1, 6).requires_grad_()
        channels = backend.class_channels(inputs, scene.camera, scene.settings, CLASSES)
        results += [channels.detach(), torch.autograd.grad(channels.square().sum(), means)[0]]
        for these in (inputs, inputs.detached()):
            channels = draw_features(backend, these, features, scene.camera, scene.settings)
            leaves = [features, *([means] if these is inputs else [])]
            results += [channels.detach(), *torch.autograd.grad(channels.square().sum(), leaves)]
        results += [backend.class_contributions(*products, scene.target, CLASSES), backend.dominant_gaussian(*products)]
        results += list(backend.class_map(*products, CLASSES))
        results += backend.sparse_class_pixel_counts(*products, scene.target, CLASSES, 0.1)
        results += backend.sparse_top_contributions(*products, scene.target, CLASSES, 3, 100)
        runs.append(results)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


@needs_native
def test_nothing_is_left_over_from_the_render_before():
    """Renders take over each other's memory."""
    large, small = (make_scene(count=n, width=w, height=51, seed=4, size=-2.0) for n, w in ((2500, 91), (2400, 83)))
    first = gradients(NativeRasterizer(), large)
    for scene in (small, large.to(torch.float32), small):
        gradients(NativeRasterizer(), scene)
    again = gradients(NativeRasterizer(), large)
    assert all(torch.equal(first[name], again[name]) for name in first)


@needs_native
def test_inputs_changed_before_the_backward_are_noticed():
    scene = make_scene()
    means = scene.inputs.means.clone().requires_grad_()
    render = scene.draw(NativeRasterizer(), means=means)
    with torch.no_grad():
        means += 1
    with pytest.raises(RuntimeError, match="inplace"):
        render.color.sum().backward()


@pytest.fixture
def asked_anew():
    """Forget what is known of the compiled modules, before and after."""
    statuses = (extension.status, cuda_extension.present)
    for status in statuses:
        status.cache_clear()
    yield
    for status in statuses:
        status.cache_clear()


@pytest.mark.usefixtures("asked_anew")
def test_a_missing_module_is_reported_in_a_sentence(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(extension, "import_module", missing)
    reason = NativeRasterizer.unavailable()
    assert reason is not None
    assert "was not built" in reason
    with pytest.raises(UserError, match="'native' cannot run here"):
        make_rasterizer("native")
    assert isinstance(make_rasterizer("auto"), TorchRasterizer)
    with pytest.raises(UserError, match="was not built"):
        make_scene().draw(NativeRasterizer())


@pytest.mark.usefixtures("asked_anew")
def test_the_compiled_module_can_be_turned_off(monkeypatch):
    monkeypatch.setenv("BEAGS_NATIVE", "0")
    assert "turns the compiled module off" in str(NativeRasterizer.unavailable())
    assert extension.load() is None
    assert isinstance(make_rasterizer("auto"), TorchRasterizer)
