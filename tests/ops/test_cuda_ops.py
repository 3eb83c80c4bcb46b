"""The CUDA ops, on a GPU or in the emulation, against their torch versions on the CPU."""

from __future__ import annotations

import pytest
import test_occupancy_loss
import test_sh_colors
import test_voxel_lookup
import torch
from cuda_backends import cuda_device

from beags_plugin.core import sh
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.ops import cuda_extension, extension
from beags_plugin.ops.sh_colors import sh_colors

pytestmark = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
device = pytest.fixture(params=["cuda", "cuda emulated"])(cuda_device)


@pytest.fixture
def torch_version(monkeypatch):
    """A function that computes something without any compiled op."""

    def compute(call):
        with monkeypatch.context() as patch:
            patch.setattr(extension, "load", lambda: None)
            patch.setattr(cuda_extension, "module_for", lambda *tensors: None)
            return call()

    return compute


def moved(grid: VisibilityGrid, device: torch.device) -> VisibilityGrid:
    return VisibilityGrid.from_state_dict({name: value.to(device) for name, value in grid.state_dict().items()})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("degree", "bases"), [(0, 1), (0, 4), (1, 4), (1, 16), (2, 9), (3, 16)])
def test_colors_are_the_torch_versions(degree, bases, dtype, device, torch_version):
    coefficients, means, center, weight = test_sh_colors.scene(333, bases, dtype)
    expected = torch_version(lambda: test_sh_colors.evaluate(coefficients, means, center, weight, degree))
    there = [value.detach().to(device).requires_grad_() for value in (coefficients, means)]
    found = test_sh_colors.evaluate(*there, center.to(device), weight.to(device), degree)
    assert (expected[0] == 0).double().mean() > 0.05
    tolerance = 1e-11 if dtype == torch.float64 else 2e-5
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("degree", "bases"), [(0, 4), (2, 16), (3, 16)])
@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2)])
def test_gradients_of_some_inputs_are_those_of_all(wanted, degree, bases, device):
    coefficients, means, center, weight = (value.detach().to(device) for value in test_sh_colors.scene(333, bases))

    def gradients(*chosen: int) -> list[torch.Tensor | None]:
        leaves = [coefficients[:, 0].clone(), coefficients[:, 1:].clone(), means.clone()]
        for each in chosen:
            leaves[each].requires_grad_()
        sh_colors(*leaves, center, degree).backward(weight)
        return [leaf.grad for leaf in leaves]

    for each, (found, expected) in enumerate(zip(gradients(*wanted), gradients(0, 1, 2), strict=True)):
        if each in wanted and expected is not None:
            assert found is not None and torch.equal(found, expected)
        else:  # colours of degree 0 do not depend on means
            assert found is None


def test_a_surfel_at_the_camera_has_finite_gradients(device, torch_version):
    coefficients, _, center, weight = test_sh_colors.scene(5, 16)
    means = center.repeat(5, 1).to(device).requires_grad_()
    coefficients = coefficients.detach().to(device).requires_grad_()
    found = test_sh_colors.evaluate(coefficients, means, center.to(device), weight.to(device), 3)
    assert all(torch.isfinite(value).all() for value in found)
    assert sh.sh_colors(coefficients[:, 0], coefficients[:, 1:], means, center, 0).shape == (5, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [4.0, 5000.0, 200_000.0])
def test_counts_and_members_are_the_torch_versions(spread, dtype, device, torch_version):
    grid = test_voxel_lookup.make_grid(spread)
    points, ids = test_voxel_lookup.queries(grid, dtype)
    points[:3] = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [1e30, 0, 0]])
    expected = torch_version(lambda: (grid.count(points, ids), grid.valid(points, ids)))
    there = moved(grid, device)
    assert torch.equal(there.count(points.to(device), ids.to(device)).cpu(), expected[0])
    assert torch.equal(there.valid(points.to(device), ids.to(device)).cpu(), expected[1])
    assert 0.1 < expected[1].double().mean() < 0.95


@pytest.mark.parametrize("spread", [4.0, 200_000.0])
def test_discs_inside_are_the_torch_versions(spread, device, torch_version):
    grid = test_voxel_lookup.make_grid(spread)
    means, ids = test_voxel_lookup.queries(grid, torch.float64, 3000)
    g = torch.Generator().manual_seed(8)
    axes = [0.5 * test_voxel_lookup.SIZE * torch.randn(3000, 3, generator=g, dtype=torch.float64) for _ in range(2)]
    expected = torch_version(lambda: grid.disc_inside(means, *axes, ids))
    found = moved(grid, device).disc_inside(means.to(device), *(axis.to(device) for axis in axes), ids.to(device))
    assert torch.equal(found.cpu(), expected)
    assert 0.02 < expected.double().mean() < 0.98


def loss_and_gradients(surfels, grid, device, **options):
    leaves = [getattr(surfels, name).detach().to(device).requires_grad_() for name in test_occupancy_loss.FLOATS]
    there = type(surfels).of(*leaves, torch.zeros(len(leaves[0]), 1, 3, dtype=leaves[0].dtype, device=device))
    inputs = LossInputs(
        step=11, seed=4, surfels=there, camera=None, render=None, image=None,
        class_ids=test_occupancy_loss.ids_of(len(leaves[0])).to(device), grid=moved(grid, device),
    )  # fmt: skip
    value = OccupancyLoss(**options).weighted(inputs)
    found = torch.autograd.grad(value, leaves)
    return [value.detach().cpu(), *(gradient.cpu() for gradient in found)]


@pytest.mark.parametrize("options", [{"samples": 20}, {"samples": 3, "background": False}])
@pytest.mark.parametrize("stretch", [0.001, 1.0, 100.0])
def test_the_occupancy_loss_is_the_torch_versions(stretch, options, device, torch_version):
    """The tables are dense and hashed, the discs of all sizes, some of them broken."""
    surfels, grid = test_occupancy_loss.make_surfels(700), test_occupancy_loss.make_grid(stretch)
    with torch.no_grad():
        surfels.means[5, 1], surfels.log_scales[6, 0], surfels.opacity_logits[7] = torch.nan, -torch.inf, torch.inf
        surfels.quats[8] = 0
    found = loss_and_gradients(surfels, grid, device, **options)
    expected = torch_version(lambda: loss_and_gradients(surfels, grid, torch.device("cpu"), **options))
    assert expected[0] > 0
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b.nan_to_num(0.0), rtol=1e-9, atol=1e-12)


def test_the_occupancy_loss_in_float32_stays_within_its_band(device, torch_version):
    grid = test_occupancy_loss.make_grid()
    found = loss_and_gradients(test_occupancy_loss.make_surfels(700, torch.float32), grid, device)
    expected = torch_version(
        lambda: loss_and_gradients(test_occupancy_loss.make_surfels(700), grid, torch.device("cpu"))
    )
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float32
        # a sample beside a voxel's face may fall on its other side
        assert ((a.double() - b).abs() > 1e-3 * b.abs().max()).double().mean() < 5e-3


def test_the_occupancy_loss_is_the_same_in_every_run(device):
    surfels, grid = test_occupancy_loss.make_surfels(700, torch.float32), test_occupancy_loss.make_grid()
    first, again = (loss_and_gradients(surfels, grid, device) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_the_smoke_test_launches_every_variant_and_finds_what_is_not_finite(device, monkeypatch):
    from cuda_backends import EmulatedCudaRasterizer

    from beags_benchmarks.kernels import cuda_smoke
    from beags_benchmarks.kernels.scenes import Size
    from beags_plugin.rasterizers.cuda import CudaRasterizer

    rasterizer = CudaRasterizer() if device.type == "cuda" else EmulatedCudaRasterizer()
    called: set[str] = set()
    call = cuda_extension.call
    monkeypatch.setattr(cuda_extension, "call", lambda m, name, *rest: called.add(name) or call(m, name, *rest))
    assert cuda_smoke.smoke(rasterizer, device.type, Size(60, 24, 20)) == []
    ops = {"sh_colors", "sh_colors_backward", "occupancy_loss", "count", "valid", "disc_inside"}
    ops |= {"photometric", "normal_consistency"}
    assert called == ops | {"vote_points", "vote_pixels", "read_votes", "reprojection_votes"}
    monkeypatch.setattr(cuda_smoke, "sh_colors", lambda dc, *_: dc * torch.inf)
    wrong = cuda_smoke.smoke(rasterizer, device.type, Size(60, 24, 20))
    assert len(wrong) == 2 * 4 and all("colours" in name for name in wrong)
