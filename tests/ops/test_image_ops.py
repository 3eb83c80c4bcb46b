"""The compiled image losses, on CPUs and GPUs: the values and gradients of the same losses in torch, the same bits."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from cuda_backends import cuda_device

from beags_plugin.core.cameras import Camera
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.normal import NormalConsistencyLoss
from beags_plugin.losses.photometric import PhotometricLoss, ssim
from beags_plugin.ops import cuda_extension, extension

if extension.load() is None:
    pytest.skip("the compiled module is not there", allow_module_level=True)

CPU = torch.device("cpu")
SIZES = [(1, 1), (2, 3), (5, 4), (11, 11), (9, 37), (40, 33), (130, 150)]


@pytest.fixture(params=["cpu", "cuda", "cuda emulated"])
def device(request, monkeypatch) -> torch.device:
    return torch.device("cpu") if request.param == "cpu" else cuda_device(request, monkeypatch)


def _loss_inputs(camera=None, image=None, **render) -> LossInputs:
    outputs = {"color": None, "depth": None, "normal": None, "distortion": None, "boundary": None}
    drawn = SimpleNamespace(**{**outputs, **render})
    return LossInputs(step=0, seed=0, surfels=None, camera=camera, render=drawn, image=image)


def _random(*shape, seed: int = 0, dtype=torch.float64) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.fixture
def in_torch(monkeypatch):
    """Calls a function with the compiled ops out of sight."""

    def call(function):
        with monkeypatch.context() as patch:
            patch.setattr(cuda_extension, "supports", lambda *tensors: False)
            return function()

    return call


def _as_it_is(function):
    return function()


def _value_and_gradients(loss, inputs_of, *leaves):
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    value = loss.value(inputs_of(*leaves))
    return [value.detach(), *torch.autograd.grad(3.0 * value, leaves)]


def _check(found, expected, dtype):
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == dtype and a.shape == b.shape
        tolerance = 1e-11 if dtype == torch.float64 else 2e-4
        assert (a.double() - b.double()).abs().max() <= tolerance * b.double().abs().max().clamp_min(1e-3)


def _pictures(size, dtype, device):
    photo, drawn = _random(*size, 3, dtype=dtype), _random(*size, 3, seed=1, dtype=dtype)
    drawn[0, 0] = photo[0, 0]  # |x - y| has slope 0 there
    return photo.to(device), drawn.to(device)


def photometric_results(size, dtype, device=CPU):
    """The loss (L1 and SSIM) and its gradient."""
    photo, drawn = _pictures(size, dtype, device)
    return _value_and_gradients(PhotometricLoss(), lambda x: _loss_inputs(image=photo, color=x), drawn)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("size", SIZES)
def test_photometric_is_torchs(size, dtype, device, in_torch):
    found, expected = (call(lambda: photometric_results(size, dtype, device)) for call in (_as_it_is, in_torch))
    _check(found, expected, dtype)
    photo, drawn = _pictures(size, dtype, device)
    assert torch.allclose(ssim(drawn, photo), in_torch(lambda: ssim(drawn, photo)), atol=1e-5)


def _view(size, dtype, device=CPU):
    height, width = size
    K = torch.tensor([[22.0, 0.3, 0.4 * width], [0.0, 25.0, 0.6 * height], [0.0, 0.0, 1.0]])
    depth = 3.0 + 0.3 * _random(*size, dtype=dtype)
    if min(size) > 4:
        depth[2, 3] = 0.0
        depth[-2, 1] = 0.0
    normal = _random(*size, 3, seed=2, dtype=dtype) - torch.tensor([0.5, 0.5, 1.5], dtype=dtype)
    images = (depth, normal, _random(*size, seed=3, dtype=dtype))
    return Camera(torch.eye(4), K, width, height).to(device), *(image.to(device) for image in images)


def normal_results(size, dtype, device=CPU):
    """The loss and its gradients by depth and normal."""
    camera, depth, normal, alpha = _view(size, dtype, device)
    return _value_and_gradients(
        NormalConsistencyLoss(), lambda d, n: _loss_inputs(camera, depth=d, normal=n, alpha=alpha), depth, normal
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("size", SIZES)
def test_normal_consistency_is_torchs(size, dtype, device, in_torch):
    found, expected = (call(lambda: normal_results(size, dtype, device)) for call in (_as_it_is, in_torch))
    _check(found, expected, dtype)


def test_every_run_gives_the_same_bits(device):
    size, dtype = (50, 70), torch.float32
    runs = [photometric_results(size, dtype, device) + normal_results(size, dtype, device) for _ in range(2)]
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_without_a_gradient_the_values_are_the_same(device):
    """Without a gradient there are no slopes and no shares to keep."""
    size, dtype = (20, 30), torch.float64
    photo, drawn = _pictures(size, dtype, device)
    camera, depth, normal, alpha = _view(size, dtype, device)
    plain = [
        PhotometricLoss().value(_loss_inputs(image=photo, color=drawn)),
        NormalConsistencyLoss().value(_loss_inputs(camera, depth=depth, normal=normal, alpha=alpha)),
    ]
    assert plain == [photometric_results(size, dtype, device)[0], normal_results(size, dtype, device)[0]]


def test_normal_consistency_of_a_scaled_scene_is_the_same():
    camera, depth, normal, alpha = _view((30, 40), torch.float32)
    loss = NormalConsistencyLoss()
    values = [
        loss.value(_loss_inputs(camera, depth=depth * factor, normal=normal, alpha=alpha)).item()
        for factor in (1.0, 2.0**-13, 2.0**20)
    ]
    assert values[0] == values[1] == values[2]


def test_any_number_of_threads_gives_the_same_bits():
    size, dtype = (180, 200), torch.float32
    before, runs = torch.get_num_threads(), []
    try:
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            runs.append(photometric_results(size, dtype) + normal_results(size, dtype))
    finally:
        torch.set_num_threads(before)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))
