"""The compiled colours against the torch version."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.core import sh as reference
from beags_plugin.ops import extension
from beags_plugin.ops.sh_colors import sh_colors

pytestmark = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
CENTER = (0.3, -0.2, -4.0)


def scene(count: int, bases: int, dtype=torch.float64):
    """Coefficients that leave some channels below 0, and means on all sides of the camera."""
    g = torch.Generator().manual_seed(bases)
    sh = torch.randn(count, bases, 3, generator=g, dtype=torch.float64) * 2
    means = 4 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    weight = torch.randn(count, 3, generator=g, dtype=torch.float64)
    leaves = [value.to(dtype).requires_grad_() for value in (sh, means)]
    return *leaves, torch.tensor(CENTER, dtype=dtype), weight.to(dtype)


def parts(sh):
    """Return leaves: degree 0 and the others."""
    return [value.detach().clone().requires_grad_() for value in (sh[:, 0], sh[:, 1:])]


def evaluate(sh, means, center, weight, degree):
    colors = reference.sh_colors(sh[:, 0], sh[:, 1:], means, center, degree)
    found = torch.autograd.grad(colors, [sh, means], weight, allow_unused=True)
    return [
        colors.detach(),
        *(torch.zeros_like(v) if g is None else g for g, v in zip(found, (sh, means), strict=True)),
    ]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("degree", "bases"), [(0, 1), (0, 4), (1, 4), (1, 16), (2, 9), (3, 16)])
def test_it_is_the_torch_version(degree, bases, dtype, without_extension):
    arguments = scene(333, bases, dtype)
    found = evaluate(*arguments, degree)
    expected = without_extension(lambda: evaluate(*arguments, degree))
    assert (expected[0] == 0).double().mean() > 0.05
    assert degree == 0 or expected[2].abs().max() > 0.1
    tolerance = 1e-11 if dtype == torch.float64 else 2e-5
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == dtype
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("degree", range(4))
def test_gradients_are_finite_differences(degree):
    sh, means, center, _ = scene(7, 16)
    assert torch.autograd.gradcheck(lambda *leaves: sh_colors(*leaves, center, degree), (*parts(sh), means))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_threads_gives_the_same_bits(dtype, for_threads):
    arguments = scene(9001, 16, dtype)
    runs = for_threads(lambda: evaluate(*arguments, 3))
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_awkward_numbers(without_extension):
    """Gaussians at the camera, not finite, or just at the clamp get what the torch version gives them."""
    sh, means, center, weight = scene(6, 16)
    with torch.no_grad():
        means[0] = center
        means[1, 0] = torch.nan
        sh[2, 5] = torch.inf
        sh[3] = 0.0
        sh[3, 0] = -0.5 / 0.28209479177387814
    weight[0] = 0.0
    found = evaluate(sh, means, center, weight, 3)
    expected = without_extension(lambda: evaluate(sh, means, center, weight, 3))
    assert torch.equal(found[0].isfinite(), expected[0].isfinite())
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a[[0, 4, 5]], b[[0, 4, 5]], rtol=1e-11, atol=1e-11)
        assert a[3].isfinite().all()


def test_no_surfels_and_unneeded_gradients():
    sh, means, center, _ = scene(0, 4)
    dc, rest = parts(sh)
    colors = sh_colors(dc, rest, means, center, 1)
    colors.sum().backward()
    assert colors.shape == (0, 3) and dc.grad.shape == (0, 3) and rest.grad.shape == (0, 3, 3)
    sh, means, center, weight = scene(5, 4)
    dc, rest = parts(sh)
    (sh_colors(dc, rest, means.detach(), center, 1) * weight).sum().backward()
    assert dc.grad is not None and rest.grad is not None and means.grad is None
    both = (dc.grad.clone(), rest.grad.clone())
    dc.grad = rest.grad = None
    (sh_colors(dc, rest.detach(), means, center, 1) * weight).sum().backward()
    assert torch.equal(dc.grad, both[0]) and rest.grad is None and means.grad is not None
    assert not sh_colors(dc.detach(), rest.detach(), means.detach(), center, 1).requires_grad


def test_degrees_that_are_not_shown_have_no_gradient():
    sh, means, center, weight = scene(9, 16)
    dc, rest = parts(sh)
    (sh_colors(dc, rest, means, center, 1) * weight).sum().backward()
    assert bool((rest.grad[:, :3] != 0).any())
    assert (rest.grad[:, 3:] == 0).all()


def test_a_strided_view_is_taken(without_extension):
    sh, means, center, weight = scene(50, 16)
    part = sh[:, :4]
    found = evaluate(part, means, center, weight, 1)
    expected = without_extension(lambda: evaluate(part, means, center, weight, 1))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)


def test_wrong_arguments_are_named():
    sh, means, center, _ = scene(5, 4)
    dc, rest = parts(sh)
    with pytest.raises(ValueError, match="sh_rest must be"):
        sh_colors(dc, rest, means, center, 2)
    with pytest.raises(ValueError, match="sh_rest must be"):
        sh_colors(dc, rest.float(), means, center, 1)
    with pytest.raises(ValueError, match="sh_dc"):
        sh_colors(sh, rest, means, center, 1)
    with pytest.raises(ValueError, match="means"):
        sh_colors(dc, rest, means[:4], center, 1)
    with pytest.raises(ValueError, match="camera_center"):
        sh_colors(dc, rest, means, center[:2], 1)
    with pytest.raises(ValueError, match="0..3"):
        sh_colors(dc, rest, means, center, 4)


def test_a_camera_that_learns_gets_its_gradient():
    """The op has none towards the camera: the torch version steps in."""
    sh, means, center, weight = scene(9, 4)
    center.requires_grad_()
    (reference.sh_colors(*parts(sh), means, center, 1) * weight).sum().backward()
    assert center.grad is not None and center.grad.abs().max() > 0
