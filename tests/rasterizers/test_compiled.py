"""The compiled rasterizers, on the CPU, on a GPU and in the emulation of one, have the reference's results."""

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
from beags_plugin.rasterizers.torch_reference import TorchRasterizer


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


@pytest.mark.parametrize("name", ALL_SCENES)
def test_float64_values_are_the_references(compiled, name):
    scene = ALL_SCENES[name]()
    found, expected = scene.draw(compiled), scene.draw(TorchRasterizer())
    for output in OUTPUTS:
        assert error(getattr(found, output), getattr(expected, output)) < 1e-9, output
    assert torch.equal(found.visible, expected.visible)
    assert found.num_nonfinite == expected.num_nonfinite


@pytest.mark.parametrize("name", [name for name in ALL_SCENES if name != "layers"])
def test_float64_gradients_are_the_references(compiled, name):
    scene = ALL_SCENES[name]()
    found, expected = (gradients_by_output(backend, scene) for backend in (compiled, TorchRasterizer()))
    together = gradients(compiled, scene)
    for leaf in together:
        for output in OUTPUTS:
            assert error(found[output][leaf], expected[output][leaf]) < 1e-9, (output, leaf)
        assert error(together[leaf], sum(expected[output][leaf] for output in OUTPUTS)) < 1e-9, leaf


def test_thousands_of_layers_have_the_references_gradients(compiled):
    scene = ALL_SCENES["layers"]()
    found, expected = gradients(compiled, scene), gradients(TorchRasterizer(), scene)
    for leaf in expected:
        assert error(found[leaf], expected[leaf]) < 1e-8, leaf


@pytest.mark.parametrize("name", ALL_SCENES)
def test_float32_stays_within_its_band(compiled, name):
    """All but a few pixels to 1e-4: rounding may carry a hit over a threshold (1/255, 0.5, the branch of rho)."""
    scene = ALL_SCENES[name]()
    found, expected = scene.to(torch.float32).draw(compiled), scene.draw(TorchRasterizer())
    for output in OUTPUTS:
        a, b = getattr(found, output), getattr(expected, output)
        assert a.dtype == torch.float32
        assert ((a - b).abs() > 1e-4 * b.abs().clamp_min(1.0)).float().mean() < 2e-3, output
    # Two pixels that differ by a skipped hit differ in A by a weight of 1/255 at most.
    assert (found.alpha - expected.alpha).abs().max() < 1.1 / 255


@pytest.mark.parametrize("name", ALL_SCENES)
@pytest.mark.parametrize("least", [0.0, 0.1])
def test_float32_counts_are_the_references_but_for_a_pixel_in_a_thousand(compiled, name, least):
    """Rounding may carry a weight over ``least``, and a hit over its thresholds."""
    scene, tables = ALL_SCENES[name](), []
    for backend, each in ((compiled, scene.to(torch.float32)), (TorchRasterizer(), scene)):
        what = (each.inputs, each.camera, each.settings, each.target, CLASSES, least)
        keys, counts = backend.sparse_class_pixel_counts(*what)
        tables.append(torch.zeros(len(scene.inputs.means) * CLASSES, dtype=torch.int32))
        tables[-1][keys] = counts
    found, expected = tables
    assert (found - expected).abs().sum() <= 1e-3 * expected.sum()


@pytest.mark.parametrize(
    "only",
    [
        ("color",),
        ("color", "alpha", "boundary"),
        ("color", "depth", "normal"),
        ("color", "alpha", "depth", "normal", "boundary"),
    ],
)
def test_float32_gradients_of_every_variant_stay_within_their_band(compiled, only):
    scene = make_scene()
    if "depth" not in only:
        scene = replace(scene, settings=replace(scene.settings, geometry=False, distortion=False))
    found, expected = gradients(compiled, scene.to(torch.float32), only), gradients(TorchRasterizer(), scene, only)
    for leaf in expected:
        assert error(found[leaf], expected[leaf]) < 2e-4, leaf


@pytest.mark.parametrize("name", ALL_SCENES)
def test_products_are_the_references(compiled, name):
    scene = ALL_SCENES[name]()
    what = (scene.inputs, scene.camera, scene.settings)
    expected = TorchRasterizer()
    contributions = compiled.class_contributions(*what, scene.target, CLASSES)
    assert error(contributions, expected.class_contributions(*what, scene.target, CLASSES)) < 1e-9
    for least in (0.0, 0.1):
        found, true = (
            each.sparse_class_pixel_counts(*what, scene.target, CLASSES, least) for each in (compiled, expected)
        )
        assert all(torch.equal(*pair) for pair in zip(found, true, strict=True))
    for most in (2, 45):
        found, true = (
            each.sparse_top_contributions(*what, scene.target, CLASSES, most, 9) for each in (compiled, expected)
        )
        assert torch.equal(found[0], true[0]) and error(found[1], true[1]) < 1e-9
    assert torch.equal(compiled.dominant_gaussian(*what), expected.dominant_gaussian(*what))
    (classes, share), (true_classes, true_share) = (each.class_map(*what, CLASSES) for each in (compiled, expected))
    assert torch.equal(classes, true_classes)
    assert error(share, true_share) < 1e-9


def test_more_classes_than_one_walk_takes(compiled):
    scene = make_scene(count=60)
    scene = replace(scene, inputs=replace(scene.inputs, class_ids=torch.arange(60, dtype=torch.int32) * 4 + 3))
    what = (scene.inputs, scene.camera, scene.settings)
    classes, share = compiled.class_map(*what, 256)
    expected = TorchRasterizer().class_map(*what, 256)
    assert torch.equal(classes, expected[0])
    assert error(share, expected[1]) < 1e-9
    labels = (torch.arange(37 * 29, dtype=torch.int32) % 256).reshape(29, 37)
    labels[3] = IGNORE
    expected = TorchRasterizer().class_contributions(*what, labels, 256)
    assert error(compiled.class_contributions(*what, labels, 256), expected) < 1e-9
    keys, values = compiled.sparse_class_contributions(*what, labels, 256)
    found = torch.zeros(60 * 256, dtype=torch.float64)
    found[keys] = values
    assert error(found.view(60, 256), expected) < 1e-9
    found, expected = (each.sparse_class_pixel_counts(*what, labels, 256) for each in (compiled, TorchRasterizer()))
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    with pytest.raises(ValueError, match=r"class_ids must lie in 0\.\.1"):
        compiled.class_map(*what, 2)


def test_poison_is_dropped_and_counted_without_spreading(compiled):
    scene = awkward()
    clean = scene.draw(compiled)
    n = len(scene.inputs.means)
    broken = poisoned(scene)
    render = broken.draw(compiled)
    assert render.num_nonfinite == 7
    assert torch.equal(render.visible[:n], clean.visible)
    assert not render.visible[n:].any()
    assert all(torch.equal(getattr(render, name), getattr(clean, name)) for name in OUTPUTS)
    assert all(torch.isfinite(g).all() for g in gradients(compiled, broken).values())
