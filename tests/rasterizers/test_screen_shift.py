"""The gradient that densification looks at: how strongly each disc is pulled across the screen."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import make_scene

from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.torch_reference import TorchRasterizer


def loss_of(drawn):
    """Something that looks at several images."""
    images = (drawn.color, 0.5 * drawn.alpha, 0.4 * drawn.normal, 0.3 * drawn.depth)
    return sum(image.square().sum() for image in images)


def pull(rasterizer, scene, **changes):
    """Gradients towards screen shift and means of that loss."""
    means = scene.inputs.means.clone().requires_grad_()
    shift = torch.zeros_like(means[:, :2]).requires_grad_()
    drawn = scene.draw(rasterizer, means=means, screen_shift=shift, **changes)
    loss_of(drawn).backward()
    return shift.grad, means.grad


def test_it_is_the_slope_of_a_loss_against_a_real_shift():
    """Finite differences of the reference, which does shift; some surfels are small, so that the low-pass shows."""
    scene = make_scene(12, size=-3.0)
    shift, weights = torch.zeros(12, 2, dtype=torch.float64), torch.randn(29, 37, 3, dtype=torch.float64)
    rasterizer = TorchRasterizer(smooth_cutoff=True)

    def loss(shift):
        return (scene.draw(rasterizer, screen_shift=shift).color * weights).sum()

    gradient = torch.autograd.functional.jacobian(loss, shift)
    for surfel, axis in ((0, 0), (3, 1), (7, 0), (11, 1)):
        step = torch.zeros_like(shift)
        step[surfel, axis] = 1e-7
        slope = (loss(shift + step) - loss(shift - step)) / 2e-7
        assert float(gradient[surfel, axis]) == pytest.approx(float(slope), rel=1e-4, abs=1e-6)


def test_of_large_discs_it_is_that_of_their_means_across_the_image(rasterizer):
    """Moving c by a pixel parallel to the image moves the mean by p_z / f; half the image is W / 2 pixels."""
    scene = make_scene(8, size=-0.5)
    turns = torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.1 * scene.inputs.quats  # none edge-on, where the low-pass shows
    scene = replace(scene, inputs=replace(scene.inputs, quats=turns))
    found, towards_means = pull(rasterizer, scene)
    camera = scene.camera
    in_camera = towards_means @ camera.rotation.T
    depth = (scene.inputs.means @ camera.rotation.T + camera.translation)[:, 2:]
    focal = torch.stack([camera.K[0, 0], camera.K[1, 1]])
    halves = torch.tensor([camera.width / 2, camera.height / 2], dtype=torch.float64)
    torch.testing.assert_close(found, in_camera[:, :2] * depth / focal * halves, rtol=1e-8, atol=1e-10)


def test_surfels_far_below_a_pixel_have_none(rasterizer):
    """They show as their low-pass filter only, so that splitting them could add no detail."""
    found, towards_means = pull(rasterizer, make_scene(40, size=-9.0, opacity=2.0))
    assert float(towards_means.abs().max()) > 0
    assert float(found.abs().max()) < 1e-9 * float(towards_means.abs().max())


@pytest.mark.parametrize("size", [-1.4, -3.0, -4.5])
def test_the_compiled_rasterizer_agrees_with_the_reference(size):
    native = make_rasterizer("native")
    scene = make_scene(60, size=size)
    expected, _ = pull(make_rasterizer("torch"), scene)
    found, _ = pull(native, scene)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()))


def test_asking_for_it_changes_nothing_else(rasterizer):
    scene = make_scene(30)
    _, with_shift = pull(rasterizer, scene)
    means = scene.inputs.means.clone().requires_grad_()
    drawn = scene.draw(rasterizer, means=means)
    loss_of(drawn).backward()
    torch.testing.assert_close(means.grad, with_shift, rtol=1e-12, atol=1e-14)


def test_a_wrong_shape_is_refused(rasterizer):
    scene = make_scene(5)
    with pytest.raises(ValueError, match=r"screen_shift must be \[5, 2\]"):
        rasterizer.rasterize(
            replace(scene.inputs, screen_shift=torch.zeros(5, 3, dtype=torch.float64)),
            scene.camera, scene.settings, scene.background,
        )  # fmt: skip
