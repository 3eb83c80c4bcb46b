"""The CUDA rasterizer, on a GPU or in the emulation, against the reference: the bodies of test_native.py's tests."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cuda_backends import BACKENDS, EmulatedCudaRasterizer
from raster_scenes import CLASSES, FLOATS, OUTPUTS, awkward, error, gradients, gradients_by_output, make_scene, poisoned
from test_native import ALL_SCENES

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError


@pytest.fixture(params=BACKENDS)
def cuda(request):
    """The CUDA backend and its emulation; skipped with the reason where it cannot run."""
    backend = BACKENDS[request.param]
    if reason := backend.unavailable():
        pytest.skip(f"{request.param}: {reason}")
    return backend()


@pytest.fixture
def emulated():
    if reason := EmulatedCudaRasterizer.unavailable():
        pytest.skip(reason)
    return EmulatedCudaRasterizer()


@pytest.mark.parametrize("name", ALL_SCENES)
def test_float64_values_are_the_references(cuda, name):
    scene = ALL_SCENES[name]()
    found, expected = scene.draw(cuda), scene.draw(TorchRasterizer())
    for output in OUTPUTS:
        assert error(getattr(found, output), getattr(expected, output)) < 1e-9, output
    assert torch.equal(found.visible, expected.visible)
    assert found.num_nonfinite == expected.num_nonfinite


@pytest.mark.parametrize("name", [name for name in ALL_SCENES if name != "layers"])
def test_float64_gradients_are_the_references(cuda, name):
    scene = ALL_SCENES[name]()
    found, expected = (gradients_by_output(backend, scene) for backend in (cuda, TorchRasterizer()))
    together = gradients(cuda, scene)
    for leaf in together:
        for output in OUTPUTS:
            assert error(found[output][leaf], expected[output][leaf]) < 1e-9, (output, leaf)
        assert error(together[leaf], sum(expected[output][leaf] for output in OUTPUTS)) < 1e-9, leaf


def test_thousands_of_layers_have_the_references_gradients(cuda):
    scene = ALL_SCENES["layers"]()
    found, expected = gradients(cuda, scene), gradients(TorchRasterizer(), scene)
    for leaf in expected:
        assert error(found[leaf], expected[leaf]) < 1e-8, leaf


@pytest.mark.parametrize("name", ALL_SCENES)
def test_float32_stays_within_its_band(cuda, name):
    """All but a few pixels to 1e-4: rounding may carry a hit over a threshold (1/255, 0.5, the branch of rho)."""
    scene = ALL_SCENES[name]()
    found, expected = scene.to(torch.float32).draw(cuda), scene.draw(TorchRasterizer())
    for output in OUTPUTS:
        a, b = getattr(found, output), getattr(expected, output)
        assert a.dtype == torch.float32
        assert ((a - b).abs() > 1e-4 * b.abs().clamp_min(1.0)).float().mean() < 2e-3, output
    # of two pixels that differ by a skipped hit, a weight of 1/255 is the most that can be missing in A
    assert (found.alpha - expected.alpha).abs().max() < 1.1 / 255


@pytest.mark.parametrize(
    "only",
    [
        ("color",),
        ("color", "alpha", "boundary"),
        ("color", "depth", "normal"),
        ("color", "alpha", "depth", "normal", "boundary"),
    ],
)
def test_float32_gradients_of_every_variant_stay_within_their_band(cuda, only):
    scene = make_scene()
    if "depth" not in only:
        scene = replace(scene, settings=replace(scene.settings, geometry="depth" in only, distortion=False))
    leaves = (*FLOATS, "background")

    def towards(backend, scene):
        values = {name: getattr(scene.inputs, name) for name in FLOATS} | {"background": scene.background}
        values = {name: value.clone().requires_grad_() for name, value in values.items()}
        drawn = scene.draw(backend, **values)
        g = torch.Generator().manual_seed(1)
        images = [getattr(drawn, name) for name in only]
        weights = [torch.randn(image.shape, generator=g, dtype=torch.float64).to(image) for image in images]
        loss = sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))
        return torch.autograd.grad(loss, list(values.values()), allow_unused=True)

    found, expected = towards(cuda, scene.to(torch.float32)), towards(TorchRasterizer(), scene)
    for leaf, a, b in zip(leaves, found, expected, strict=True):
        assert error(a, b) < 2e-4, leaf


@pytest.mark.parametrize("name", ALL_SCENES)
def test_products_are_the_references(cuda, name):
    scene = ALL_SCENES[name]()
    what = (scene.inputs, scene.camera, scene.settings)
    expected = TorchRasterizer()
    contributions = cuda.class_contributions(*what, scene.target, CLASSES)
    assert error(contributions, expected.class_contributions(*what, scene.target, CLASSES)) < 1e-9
    assert torch.equal(cuda.dominant_gaussian(*what), expected.dominant_gaussian(*what))
    (classes, share), (true_classes, true_share) = cuda.class_map(*what, CLASSES), expected.class_map(*what, CLASSES)
    assert torch.equal(classes, true_classes)
    assert error(share, true_share) < 1e-9


def test_more_classes_than_one_walk_takes(cuda):
    scene = make_scene(count=60)
    scene = replace(scene, inputs=replace(scene.inputs, class_ids=torch.arange(60, dtype=torch.int32) * 4 + 3))
    what = (scene.inputs, scene.camera, scene.settings)
    classes, share = cuda.class_map(*what, 256)
    expected = TorchRasterizer().class_map(*what, 256)
    assert torch.equal(classes, expected[0])
    assert error(share, expected[1]) < 1e-9
    labels = (torch.arange(37 * 29, dtype=torch.int32) % 256).reshape(29, 37)
    labels[3] = IGNORE
    keys, values = cuda.sparse_class_contributions(*what, labels, 256)
    found = torch.zeros(60 * 256, dtype=torch.float64)
    found[keys] = values
    assert error(found.view(60, 256), TorchRasterizer().class_contributions(*what, labels, 256)) < 1e-9


def test_every_run_gives_the_same_bits(cuda):
    scene = make_scene(count=300, seed=4, size=-2.0).to(torch.float32)
    first, again = gradients(cuda, scene), gradients(cuda, scene)
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_poison_is_dropped_and_counted_without_spreading(cuda):
    scene = awkward()
    clean = scene.draw(cuda)
    n = len(scene.inputs.means)
    broken = poisoned(scene)
    drawn = broken.draw(cuda)
    assert drawn.num_nonfinite == 7
    assert torch.equal(drawn.visible[:n], clean.visible)
    assert not drawn.visible[n:].any()
    assert all(torch.equal(getattr(drawn, name), getattr(clean, name)) for name in OUTPUTS)
    assert all(torch.isfinite(g).all() for g in gradients(cuda, broken).values())


def test_a_drawing_larger_than_the_guess_is_drawn_again(emulated, monkeypatch):
    """The memory for pairs is guessed from the drawings before: here from one with hardly any."""
    monkeypatch.setattr("beags_plugin.rasterizers.pair_counts._STEP", 16)
    small, large = make_scene(count=2, size=-5.0), make_scene(count=200)
    small.draw(emulated)
    found, fresh = gradients(emulated, large), gradients(EmulatedCudaRasterizer(), large)
    assert all(torch.equal(found[name], fresh[name]) for name in found)
    what = (large.inputs, large.camera, large.settings, large.target, CLASSES)
    small.draw(emulated)
    assert torch.equal(emulated.class_contributions(*what), EmulatedCudaRasterizer().class_contributions(*what))


class Guarded:
    """A frame whose backward is given records with NaN behind them."""

    def __init__(self, native) -> None:
        self._native = native

    def __getattr__(self, name):
        return getattr(self._native, name)

    def backward(self, *arguments) -> None:
        *before, records, sums, parts, stream = arguments
        guarded = torch.full((8 * len(records),), torch.nan, dtype=records.dtype)[: len(records)]
        self._native.backward(*before, guarded, sums, parts, stream)


def test_the_backward_of_a_drawing_larger_than_its_memory_stays_in_its_memory(emulated, monkeypatch):
    """As in a CUDA graph, where nothing is drawn again: it has no gradients."""
    monkeypatch.setattr("beags_plugin.rasterizers.pair_counts._STEP", 16)
    small, large = make_scene(count=2, size=-5.0), make_scene(count=200)
    small.draw(emulated)
    told = []
    monkeypatch.setattr(emulated._counts, "receive", lambda sent: told.append(int(sent.numbers[0])) or (0, 0))
    forward = emulated.forward_kernel

    def guarded(drawing):
        done = forward(drawing)
        done.state.native = Guarded(done.state.native)
        assert told[-1] > 2 * len(done.state.pairs[0])  # pairs that there is no memory for
        return done

    monkeypatch.setattr(emulated, "forward_kernel", guarded)
    found = gradients(emulated, large)
    assert told and all(float(gradient.abs().max()) == 0.0 for gradient in found.values())


def test_images_of_more_tiles_than_a_key_holds_are_refused(emulated):
    scene = make_scene(count=1)
    camera = replace(scene.camera, width=20_000, height=2_000)
    with pytest.raises(UserError, match="16 million pixels"):
        emulated.dominant_gaussian(scene.inputs, camera, scene.settings)


def test_without_cuda_the_reason_is_told():
    if CudaRasterizer.unavailable() is None:
        pytest.skip("there is a GPU here")
    with pytest.raises(UserError, match="'cuda' cannot run here"):
        make_rasterizer("cuda")


def test_memory_for_pairs_comes_in_few_sizes():
    from beags_plugin.rasterizers.pair_counts import capacity_for

    for pairs in (0, 1, 5_000, 100_000, 3_000_000, 60_000_000):
        assert 1.25 * pairs < capacity_for(pairs) <= 1.25 * 1.125 * pairs + (1 << 14)
    assert len({capacity_for(pairs) for pairs in range(1_000_000, 2_000_000, 1_000)}) <= 9
