"""The compiled rasterizer: the reference's values and gradients, the same bits on any number of threads."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from raster_scenes import CLASSES, FLOATS, OUTPUTS, SCENES, awkward, make_scene

from beags_plugin.errors import UserError
from beags_plugin.rasterizers import make_rasterizer, native
from beags_plugin.rasterizers.interface import IGNORE, SurfelInputs
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer

needs_native = pytest.mark.skipif(
    NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable())
)
ALL_SCENES = SCENES | {
    # five tiles by four, the last ones cut
    "wide": lambda: make_scene(count=120, width=71, height=51, seed=3, size=-1.8),
    # layers upon layers, clamped and stopped early
    "dense": lambda: make_scene(count=300, seed=11, opacity=2.0, size=-1.0),
}


def gradients(rasterizer, scene, only=OUTPUTS):
    """Gradients of a fixed random combination of the outputs towards every float input and the background."""
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
    leaves["background"] = scene.background.clone().requires_grad_()
    render = scene.draw(rasterizer, **leaves)
    g = torch.Generator().manual_seed(1)
    loss = leaves["background"].sum() * 0
    for name in OUTPUTS:
        image = getattr(render, name)
        weight = torch.randn(image.shape, generator=g, dtype=torch.float64).to(image)
        if name in only:
            loss = loss + (image * weight).sum()
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    return {
        name: torch.zeros_like(leaf) if value is None else value
        for (name, leaf), value in zip(leaves.items(), found, strict=True)
    }


def error(found, expected):
    """Largest difference, in units of the largest expected number (or of 1, if that is more)."""
    if expected.numel() == 0:
        return 0.0
    return ((found.double() - expected.double()).abs().max() / expected.double().abs().max().clamp_min(1.0)).item()


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
@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("name", ALL_SCENES)
def test_float64_gradients_are_the_references(name, output):
    scene = ALL_SCENES[name]()
    found = gradients(NativeRasterizer(), scene, only=(output,))
    expected = gradients(TorchRasterizer(), scene, only=(output,))
    for leaf in expected:
        assert error(found[leaf], expected[leaf]) < 1e-9, leaf


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
        results += [backend.class_contributions(*products, scene.target, CLASSES), backend.heaviest(*products)]
        results += list(backend.class_map(*products, CLASSES))
        runs.append(results)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


@needs_native
@pytest.mark.parametrize("name", ALL_SCENES)
def test_products_are_the_references(name):
    scene = ALL_SCENES[name]()
    what = (scene.inputs, scene.camera, scene.settings)
    found, expected = NativeRasterizer(), TorchRasterizer()
    contributions = found.class_contributions(*what, scene.target, CLASSES)
    assert error(contributions, expected.class_contributions(*what, scene.target, CLASSES)) < 1e-9
    assert torch.equal(found.heaviest(*what), expected.heaviest(*what))
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
def test_only_needed_gradients_are_made():
    scene = make_scene()
    opacity_logits = scene.inputs.opacity_logits.clone().requires_grad_()
    scene.draw(NativeRasterizer(), opacity_logits=opacity_logits).color.sum().backward()
    assert opacity_logits.grad is not None
    assert scene.inputs.means.grad is None
    assert not scene.draw(NativeRasterizer()).color.requires_grad


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
    bad = {name: torch.cat([getattr(scene.inputs, name)] * 2) for name in FLOATS}
    bad["opacity_logits"][n:] = -1e30  # the copies are too faint to be seen, and some of them broken
    for i, (name, poison) in enumerate(
        zip(FLOATS, (torch.nan, torch.inf, -torch.inf, torch.nan, torch.inf), strict=True)
    ):
        bad[name][n + i] = poison
    bad["quats"][n + 5] = 0
    bad["log_scales"][n + 6] = 1e4
    bad["opacity_logits"][n : n + 7] += 1e30
    inputs = SurfelInputs(**bad, class_ids=torch.cat([scene.inputs.class_ids] * 2))
    render = replace(scene, inputs=inputs).draw(NativeRasterizer())
    assert render.num_nonfinite == 7
    assert torch.equal(render.visible[:n], clean.visible)
    assert not render.visible[n:].any()
    for name in OUTPUTS:
        assert torch.equal(getattr(render, name), getattr(clean, name))
    assert all(torch.isfinite(g).all() for g in gradients(NativeRasterizer(), replace(scene, inputs=inputs)).values())


@needs_native
def test_plain_kernels_agree_with_the_fast_ones():
    """The instruction set is chosen once a process, so the plain one runs in a process of its own."""
    program = (
        "import sys, os; os.environ['BEAGS_ISA'] = 'baseline'; sys.path.insert(0, sys.argv[1])\n"
        "import torch; from raster_scenes import *; from beags_plugin.rasterizers.native import NativeRasterizer\n"
        "from beags_plugin import _native; assert _native.instruction_set() == 'baseline'\n"
        "r = make_scene().to(torch.float32).draw(NativeRasterizer())\n"
        "print(*(getattr(r, name).double().sum().item() for name in OUTPUTS))\n"
    )
    folder = str(Path(__file__).parent)
    done = subprocess.run([sys.executable, "-c", program, folder], capture_output=True, text=True, check=True)
    render = make_scene().to(torch.float32).draw(NativeRasterizer())
    for name, found in zip(OUTPUTS, map(float, done.stdout.split()), strict=True):
        assert found == pytest.approx(getattr(render, name).double().sum().item(), rel=1e-4), name


def test_a_missing_module_is_told_in_a_sentence(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}")

    native._load.cache_clear()
    monkeypatch.setattr(native, "import_module", missing)
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
        native._load.cache_clear()
