"""The image-space losses: SSIM by brute force, normals of known planes, gradients, empty cases."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import opacities
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.boundary import BoundaryLoss
from beags_plugin.losses.distortion import DistortionLoss
from beags_plugin.losses.normal import NormalConsistencyLoss, depth_normals
from beags_plugin.losses.photometric import PhotometricLoss, blur, ssim, ssim_map
from beags_plugin.losses.reduction import ordered_linear, ordered_mean, ordered_outer_sum, ordered_sum


def _inputs(camera=None, image=None, labels=None, **render) -> LossInputs:
    outputs = {"color": torch.zeros(2, 2, 3), "depth": None, "normal": None, "distortion": None, "boundary": None}
    return LossInputs(
        step=0,
        seed=0,
        surfels=None,
        camera=camera,
        render=SimpleNamespace(**{**outputs, **render}),
        image=image,
        labels=labels,
    )


def _random(*shape, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ---------------------------------------------------------------- photometric


def _window() -> np.ndarray:
    weights = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    return np.outer(weights, weights) / weights.sum() ** 2


def _ssim_by_loops(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    height, width, channels = a.shape
    a, b = (np.pad(image, ((5, 5), (5, 5), (0, 0))) for image in (a, b))
    window, values = _window(), []
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                p, q = a[y : y + 11, x : x + 11, c], b[y : y + 11, x : x + 11, c]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return np.reshape(values, (height, width, channels))


@pytest.mark.parametrize("shape", [(7, 9, 3), (33, 40, 1), (1, 1, 3)])
def test_ssim_equals_loops(shape):
    a, b = _random(*shape), _random(*shape, seed=1)
    expected = _ssim_by_loops(a.numpy(), b.numpy())
    assert float(ssim(a, b)) == pytest.approx(expected.mean(), abs=1e-12)
    np.testing.assert_allclose(ssim_map(a, b).numpy(), expected.mean(axis=2), atol=1e-12)


def test_ssim_of_equal_images_is_one_and_of_inverted_ones_is_low():
    image = _random(20, 30, 3)
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-12)
    assert float(ssim(1 - image, image)) < 0
    assert float(ssim(torch.zeros(20, 30, 3), torch.zeros(20, 30, 3))) == pytest.approx(1.0)


def test_ssim_gradient():
    reference = _random(6, 13, 2)
    image = _random(6, 13, 2, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: 3 * ssim(x, reference), image)


def test_blur_is_the_window_at_block_borders():
    for size in ((1, 1), (31, 33), (32, 64), (70, 65)):
        maps = torch.zeros(3, *size, dtype=torch.float64)
        y, x = size[0] // 2, size[1] // 2
        maps[1, y, x] = 1.0
        padded = np.zeros((size[0] + 10, size[1] + 10))
        padded[y : y + 11, x : x + 11] = _window()
        result = blur(maps)
        assert np.allclose(result[1].numpy(), padded[5:-5, 5:-5], atol=1e-16)
        assert not result[0].any() and not result[2].any()


def test_photometric_is_the_weighted_sum():
    drawn, photo = _random(12, 14, 3), _random(12, 14, 3, seed=1)
    inputs = _inputs(image=photo, color=drawn)
    similar = _ssim_by_loops(drawn.numpy(), photo.numpy()).mean()
    expected = 0.8 * float((drawn - photo).abs().mean()) + 0.2 * (1 - similar)
    assert float(PhotometricLoss().value(inputs)) == pytest.approx(expected)
    assert float(PhotometricLoss(ssim_weight=0.0).value(inputs)) == pytest.approx(float((drawn - photo).abs().mean()))


def test_photometric_gradient():
    photo, drawn = _random(5, 6, 3), _random(5, 6, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: PhotometricLoss().value(_inputs(image=photo, color=x)), drawn)


def test_ssim_mistakes_are_named():
    with pytest.raises(ValueError, match=r"\[2, 2, 3\] and \[2, 3, 3\]"):
        ssim(torch.zeros(2, 2, 3), torch.zeros(2, 3, 3))
    with pytest.raises(ValueError, match="detach"):
        ssim(torch.zeros(2, 2, 3), torch.zeros(2, 2, 3, requires_grad=True))


# ---------------------------------------------------------------- sums


def test_ordered_sums():
    for count in (0, 1, 1024, 1025, 3_000_000):
        values = _random(count)
        assert float(ordered_sum(values)) == pytest.approx(float(values.sum()))
    assert float(ordered_mean(torch.zeros(0))) == 0.0
    assert torch.autograd.gradcheck(lambda x: ordered_sum(x**2), _random(2000)[:1500].requires_grad_(), fast_mode=True)


def test_sums_of_outer_products():
    values, others = _random(5_000).view(-1, 4), _random(3_750, seed=1).view(-1, 3)
    torch.testing.assert_close(ordered_outer_sum(values, others), values.T @ others)


@pytest.mark.parametrize("count", [3, 64 * 64, 5_000])
def test_linear_products_and_the_gradients_that_are_asked_for(count):
    rows, weight, bias = _random(count, 5), _random(7, 5, seed=1), _random(7, seed=2)
    torch.testing.assert_close(ordered_linear(rows, weight, bias), rows @ weight.T + bias)
    expected = (rows.T @ _random(count, 7, seed=3)).T
    for with_rows in (False, True):
        x, w = rows.clone().requires_grad_(with_rows), weight.clone().requires_grad_()
        ordered_linear(x, w, bias).backward(_random(count, 7, seed=3))
        torch.testing.assert_close(w.grad, expected)
        assert (x.grad is not None) is with_rows
    torch.testing.assert_close(x.grad, _random(count, 7, seed=3) @ weight)


def test_photometric_does_not_depend_on_threads():
    photo, results, threads = _random(300, 260, 3).float(), [], torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            drawn = _random(300, 260, 3, seed=1).float().requires_grad_()
            value = PhotometricLoss().value(_inputs(image=photo, color=drawn))
            value.backward()
            results.append((value.detach(), drawn.grad))
    finally:
        torch.set_num_threads(threads)
    for value, grad in results[1:]:
        assert torch.equal(value, results[0][0]) and torch.equal(grad, results[0][1])


# ---------------------------------------------------------------- normal

K = torch.tensor([[22.0, 0.0, 6.3], [0.0, 25.0, 4.1], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _plane(normal, offset: float = 3.0, factor: float = 1.0):
    """Depth of the plane n . x = -offset under the pixel centres, and n; n is turned to the camera."""
    n = torch.tensor(normal, dtype=torch.float64)
    n = n / n.norm()
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 13, 9)
    x = (torch.arange(13) + 0.5 - K[0, 2]) / K[0, 0]
    y = (torch.arange(9) + 0.5 - K[1, 2]) / K[1, 1]
    rays = torch.stack([x.expand(9, 13), y[:, None].expand(9, 13), torch.ones(9, 13).double()], -1)
    depth = -offset * factor / (rays * n).sum(-1)
    assert (depth > 0).all()
    return depth, n, camera


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0.2, -1), (-1.2, 0.7, -1)])
@pytest.mark.parametrize("factor", [1.0, 1e-4, 1e6])
def test_normals_of_a_plane_are_exact(normal, factor):
    depth, n, camera = _plane(normal, factor=factor)
    normals, known = depth_normals(depth, camera)
    assert known.all() and normals.shape == (7, 11, 3)
    assert torch.allclose(normals, n.expand_as(normals), atol=1e-9)
    single, known = depth_normals(depth.float(), camera)
    assert known.all() and torch.allclose(single, n.float().expand_as(single), atol=1e-3)


def test_normal_loss_is_zero_on_the_plane_and_two_against_it():
    depth, n, camera = _plane((0.4, -0.3, -1))
    alpha = torch.full_like(depth, 0.7)
    for sign, expected in ((1.0, 0.0), (-1.0, 0.7 * 2.0)):
        inputs = _inputs(camera=camera, depth=depth, alpha=alpha, normal=(sign * n).expand(9, 13, 3))
        assert float(NormalConsistencyLoss().value(inputs)) == pytest.approx(expected, abs=1e-9)


def test_normal_loss_leaves_out_holes_and_has_finite_gradients():
    depth, n, camera = _plane((0.4, -0.3, -1))
    depth = depth.clone()
    depth[4, 5] = 0.0
    depth[0:2, 0:3] = 0.0
    depth[7, 8] *= 40.0  # a spike
    depth.requires_grad_()
    normal = n.expand(9, 13, 3).clone().requires_grad_()
    alpha = torch.ones(9, 13, dtype=torch.float64, requires_grad=True)
    NormalConsistencyLoss().value(_inputs(camera=camera, depth=depth, alpha=alpha, normal=normal)).backward()
    assert torch.isfinite(depth.grad).all() and torch.isfinite(normal.grad).all() and alpha.grad is None
    assert depth.grad[4, 5] == 0 and not normal.grad[4, 4:7].any() and not normal.grad[3:6, 5].any()
    assert normal.grad[1:-1, 1:-1].abs().sum() > 0 and not normal.grad[0].any() and not normal.grad[:, -1].any()

    nothing = torch.zeros(9, 13, dtype=torch.float64, requires_grad=True)
    value = NormalConsistencyLoss().value(_inputs(camera=camera, depth=nothing, alpha=alpha, normal=normal))
    value.backward()
    assert value.item() == 0.0 and not nothing.grad.any()


def test_normal_loss_gradient():
    depth, n, camera = _plane((0.4, -0.3, -1))
    depth = (depth + 0.05 * _random(9, 13)).requires_grad_()
    normal = (0.9 * n + 0.1 * _random(9, 13, 3, seed=2)).requires_grad_()
    alpha = _random(9, 13, seed=3)
    loss = NormalConsistencyLoss()
    assert torch.autograd.gradcheck(
        lambda d, m: loss.value(_inputs(camera=camera, depth=d, alpha=alpha, normal=m)), (depth, normal)
    )


def test_an_image_too_small_for_differences():
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 2, 2)
    value = NormalConsistencyLoss().value(
        _inputs(camera=camera, depth=_random(2, 2), alpha=_random(2, 2), normal=_random(2, 2, 3))
    )
    assert float(value) == 0.0


# ---------------------------------------------------------------- distortion, boundary


def test_distortion_is_the_mean():
    image = _random(4, 5)
    assert float(DistortionLoss().value(_inputs(distortion=image))) == pytest.approx(float(image.mean()))


def test_boundary_is_the_mean_over_labelled_pixels():
    labels = torch.zeros(4, 5, dtype=torch.int32)
    labels[:2] = IGNORE
    boundary = _random(4, 5)
    boundary[:2] = 0.0
    boundary.requires_grad_()
    value = BoundaryLoss().value(_inputs(labels=labels, boundary=boundary))
    assert float(value) == pytest.approx(float(boundary[2:].mean()))
    value.backward()
    assert torch.allclose(boundary.grad, torch.full_like(boundary, 0.1))


def test_boundary_without_labels():
    boundary = torch.zeros(4, 5, requires_grad=True)
    value = BoundaryLoss().value(_inputs(labels=torch.full((4, 5), IGNORE, dtype=torch.int32), boundary=boundary))
    value.backward()
    assert float(value) == 0.0 and torch.isfinite(boundary.grad).all()
    assert float(BoundaryLoss().value(_inputs())) == 0.0


def test_missing_products_are_named():
    for loss, word in ((NormalConsistencyLoss(), "geometry"), (DistortionLoss(), "distortion")):
        with pytest.raises(ValueError, match=word):
            loss.value(_inputs())
    with pytest.raises(ValueError, match="target"):
        BoundaryLoss().value(_inputs(labels=torch.zeros(2, 2, dtype=torch.int32)))
    assert math.isfinite(BoundaryLoss().weight)


def test_opacities_have_finite_gradients_everywhere_and_follow_the_logistic_function():
    logits = torch.tensor([-1e4, -90.0, -5.0, 0.0, 3.0, 90.0, 1e4], dtype=torch.float64, requires_grad=True)
    values = opacities(logits)
    values.sum().backward()
    assert torch.allclose(values, torch.sigmoid(logits), rtol=1e-12, atol=1e-34)
    assert torch.allclose(logits.grad, values * (1 - values), rtol=1e-9, atol=1e-34)
