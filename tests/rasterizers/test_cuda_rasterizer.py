"""The CUDA rasterizer, on a GPU or in the emulation: its memory for pairs, its limits, the same bits in every run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cuda_backends import BACKENDS, EmulatedCudaRasterizer
from raster_scenes import CLASSES, gradients, make_scene

from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.cuda import CudaRasterizer
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


def test_every_run_gives_the_same_bits(cuda):
    scene = make_scene(count=300, seed=4, size=-2.0).to(torch.float32)
    first, again = gradients(cuda, scene), gradients(cuda, scene)
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_a_render_larger_than_the_guess_is_rendered_again(emulated, monkeypatch):
    """The memory for pairs is guessed from earlier renders: here from one with hardly any."""
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


def test_the_backward_of_a_render_larger_than_its_memory_stays_in_its_memory(emulated, monkeypatch):
    """Such a render has no gradients; here the host does not draw it again, as it otherwise does."""
    monkeypatch.setattr("beags_plugin.rasterizers.pair_counts._STEP", 16)
    small, large = make_scene(count=2, size=-5.0), make_scene(count=200)
    small.draw(emulated)
    received = []

    def start_copy(totals):
        return lambda: received.append(int(totals[0])) or [0, 0]

    monkeypatch.setattr("beags_plugin.rasterizers.cuda.start_copy", start_copy)
    forward = emulated.forward_kernel

    def guarded(call):
        done = forward(call)
        done.state.native = Guarded(done.state.native)
        assert received[-1] > 2 * len(done.state.pairs[0])  # pairs that there is no memory for
        return done

    monkeypatch.setattr(emulated, "forward_kernel", guarded)
    found = gradients(emulated, large)
    assert received and all(float(gradient.abs().max()) == 0.0 for gradient in found.values())


def test_images_of_more_tiles_than_a_key_holds_are_refused(emulated):
    scene = make_scene(count=1)
    camera = replace(scene.camera, width=20_000, height=2_000)
    with pytest.raises(UserError, match="16 million pixels"):
        emulated.dominant_gaussian(scene.inputs, camera, scene.settings)


def test_without_cuda_the_reason_is_given():
    if CudaRasterizer.unavailable() is None:
        pytest.skip("there is a GPU here")
    with pytest.raises(UserError, match="'cuda' cannot run here"):
        make_rasterizer("cuda")


def test_memory_for_pairs_comes_in_few_sizes():
    from beags_plugin.rasterizers.pair_counts import capacity_for

    for pairs in (0, 1, 5_000, 100_000, 3_000_000, 60_000_000):
        assert 1.25 * pairs < capacity_for(pairs) <= 1.25 * 1.125 * pairs + (1 << 14)
    assert len({capacity_for(pairs) for pairs in range(1_000_000, 2_000_000, 1_000)}) <= 9
