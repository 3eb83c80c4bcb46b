"""The compiled rasterizer: the reference's values and gradients, the same bits on any number of threads."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import (
    CLASSES,
    OUTPUTS,
    SCENES,
    awkward,
    error,
    gradients,
    gradients_by_output,
    make_scene,
    poisoned,
)

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.ops import extension
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError

needs_native = pytest.mark.skipif(
    NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable())
)


def slivers():
    """Surfels up to a thousand times as long as wide, at all angles."""
    scene = make_scene(count=150, width=71, height=51, seed=13)
    g = torch.Generator().manual_seed(14)
    log_scales = -2.5 + 2.0 * torch.randn(150, 2, generator=g, dtype=torch.float64)
    return replace(scene, inputs=replace(scene.inputs, log_scales=log_scales))


ALL_SCENES = SCENES | {
    # five tiles by four, the last ones cut
    "wide": lambda: make_scene(count=120, width=71, height=51, seed=3, size=-1.8),
    # layers upon layers, clamped and stopped early
    "dense": lambda: make_scene(count=300, seed=11, opacity=2.0, size=-1.0),
    # thousands of layers that let light through
    "layers": lambda: make_scene(count=3000, width=21, height=18, seed=12, opacity=-5.0, size=-0.5),
    "slivers": slivers,
}


@pytest.fixture
def threads():
    """Restores the number of threads."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@needs_native
@pytest.mark.parametrize("name", ALL_SCENES)
def test_float64_values_are_the_references(name):
    scene = ALL_SCENES[name]()
    found, expected = scene.draw(NativeRasterizer()), scene.draw(TorchRasterizer())
    for output in OUTPUTS:
        assert error(getattr(found, output), getattr(expected, output)) < 1e-9, output
    assert torch.equal(found.visible, expected.visible)
    assert found.num_nonfinite == expected.num_nonfinite


@needs_native
@pytest.mark.parametrize("name", ALL_SCENES)
def test_float64_gradients_are_the_references(name):
    scene = ALL_SCENES[name]()
    found, expected = (gradients_by_output(backend(), scene) for backend in (NativeRasterizer, TorchRasterizer))
    together = gradients(NativeRasterizer(), scene)
    for leaf in together:
        for output in OUTPUTS:
            assert error(found[output][leaf], expected[output][leaf]) < 1e-9, (output, leaf)
        assert error(together[leaf], sum(expected[output][leaf] for output in OUTPUTS)) < 1e-9, leaf


@needs_native
@pytest.mark.parametrize("name", ALL_SCENES)
def test_float32_stays_within_its_band(name):
    """All but a few pixels to 1e-4: rounding may carry a hit over a threshold (1/255, 0.5, the branch of rho)."""
    scene = ALL_SCENES[name]()
    found, expected = scene.to(torch.float32).draw(NativeRasterizer()), scene.draw(NativeRasterizer())
    for output in OUTPUTS:
        a, b = getattr(found, output), getattr(expected, output)
        assert a.dtype == torch.float32
        assert ((a - b).abs() > 1e-4 * b.abs().clamp_min(1.0)).float().mean() < 2e-3, output
    # of two pixels that differ by a skipped hit, a weight of 1/255 is the most that can be missing in A
    assert (found.alpha - expected.alpha).abs().max() < 1.1 / 255


@needs_native
def test_float32_gradients_stay_within_their_band():
    scene = make_scene()
    found = gradients(
        NativeRasterizer(), scene.to(torch.float32), only=("color", "alpha", "depth", "normal", "boundary")
    )
    expected = gradients(NativeRasterizer(), scene, only=("color", "alpha", "depth", "normal", "boundary"))
    for leaf in expected:
        assert error(found[leaf], expected[leaf]) < 2e-4, leaf


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
        products = (scene.inputs, scene.camera, scene.settings)
        results += [backend.class_contributions(*products, scene.target, CLASSES), backend.dominant_gaussian(*products)]
        results += list(backend.class_map(*products, CLASSES))
        runs.append(results)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


@needs_native
def test_nothing_is_left_over_from_the_drawing_before():
    """Drawings take over each other's memory."""
    large, small = (make_scene(count=n, width=w, height=51, seed=4, size=-2.0) for n, w in ((2500, 91), (2400, 83)))
    first = gradients(NativeRasterizer(), large)
    for scene in (small, large.to(torch.float32), small):
        gradients(NativeRasterizer(), scene)
    again = gradients(NativeRasterizer(), large)
    assert all(torch.equal(first[name], again[name]) for name in first)


@needs_native
@pytest.mark.parametrize("name", ALL_SCENES)
def test_products_are_the_references(name):
    scene = ALL_SCENES[name]()
    what = (scene.inputs, scene.camera, scene.settings)
    found, expected = NativeRasterizer(), TorchRasterizer()
    contributions = found.class_contributions(*what, scene.target, CLASSES)
    assert error(contributions, expected.class_contributions(*what, scene.target, CLASSES)) < 1e-9
    assert torch.equal(found.dominant_gaussian(*what), expected.dominant_gaussian(*what))
    (classes, share), (true_classes, true_share) = found.class_map(*what, CLASSES), expected.class_map(*what, CLASSES)
    assert torch.equal(classes, true_classes)
    assert error(share, true_share) < 1e-9


@needs_native
def test_many_classes():
    scene = make_scene(count=60)
    scene = replace(scene, inputs=replace(scene.inputs, class_ids=torch.arange(60, dtype=torch.int32) * 4 + 3))
    what = (scene.inputs, scene.camera, scene.settings)
    classes, share = NativeRasterizer().class_map(*what, 256)
    expected = TorchRasterizer().class_map(*what, 256)
    assert torch.equal(classes, expected[0])
    assert error(share, expected[1]) < 1e-9
    labels = (torch.arange(37 * 29, dtype=torch.int32) % 256).reshape(29, 37)
    labels[3] = IGNORE
    found = NativeRasterizer().class_contributions(*what, labels, 256)
    assert error(found, TorchRasterizer().class_contributions(*what, labels, 256)) < 1e-9


@needs_native
def test_class_ids_beyond_the_classes_are_refused():
    scene = make_scene()
    with pytest.raises(ValueError, match=r"class_ids must lie in 0\.\.1"):
        NativeRasterizer().class_map(scene.inputs, scene.camera, scene.settings, 2)


@needs_native
def test_inputs_changed_before_the_backward_are_noticed():
    scene = make_scene()
    means = scene.inputs.means.clone().requires_grad_()
    render = scene.draw(NativeRasterizer(), means=means)
    with torch.no_grad():
        means += 1
    with pytest.raises(RuntimeError, match="inplace"):
        render.color.sum().backward()


@needs_native
def test_poison_is_dropped_and_counted_without_spreading():
    scene = awkward()
    clean = scene.draw(NativeRasterizer())
    n = len(scene.inputs.means)
    broken = poisoned(scene)
    render = broken.draw(NativeRasterizer())
    assert render.num_nonfinite == 7
    assert torch.equal(render.visible[:n], clean.visible)
    assert not render.visible[n:].any()
    for name in OUTPUTS:
        assert torch.equal(getattr(render, name), getattr(clean, name))
    assert all(torch.isfinite(g).all() for g in gradients(NativeRasterizer(), broken).values())


def test_a_missing_module_is_told_in_a_sentence(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}")

    extension.status.cache_clear()
    monkeypatch.setattr(extension, "import_module", missing)
    try:
        reason = NativeRasterizer.unavailable()
        assert reason is not None
        assert "was not built" in reason
        with pytest.raises(UserError, match="'native' cannot run here"):
            make_rasterizer("native")
        assert isinstance(make_rasterizer("auto"), TorchRasterizer)
        scene = make_scene()
        with pytest.raises(UserError, match="was not built"):
            scene.draw(NativeRasterizer())
    finally:
        extension.status.cache_clear()


def test_the_compiled_module_can_be_turned_off(monkeypatch):
    monkeypatch.setenv("BEAGS_NATIVE", "0")
    extension.status.cache_clear()
    try:
        assert "turns the compiled module off" in str(NativeRasterizer.unavailable())
        assert extension.load() is None
        assert isinstance(make_rasterizer("auto"), TorchRasterizer)
    finally:
        monkeypatch.undo()
        extension.status.cache_clear()
