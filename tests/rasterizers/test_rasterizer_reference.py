"""The rasterizer against finite differences and against the equations, worked out pixel by pixel without torch."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from raster_scenes import CLASSES, FLOATS, OUTPUTS, SCENES, make_scene

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.rendering import draw_features
from beags_plugin.rasterizers.torch_reference import BLOCK, TorchRasterizer


def rotation(quat):
    """Return the matrix of a wxyz quaternion, by turning the axes: v' = v + 2 w (r x v) + 2 r x (r x v)."""
    quat = quat / np.linalg.norm(quat)
    w, r = quat[0], quat[1:]
    return np.stack([v + 2 * w * np.cross(r, v) + 2 * np.cross(r, np.cross(r, v)) for v in np.eye(3)], axis=1)


def literal(scene):
    """Every output of every pixel by a plain loop over rays and surfels (E1 to E4, E7), ray meets plane in 3D."""
    inputs = {name: getattr(scene.inputs, name).numpy() for name in FLOATS}
    classes, target = scene.inputs.class_ids.numpy(), scene.target.numpy()
    W, t, K = scene.camera.rotation.numpy(), scene.camera.translation.numpy(), scene.camera.K.numpy()
    near, far = scene.settings.near, scene.settings.far
    centers = inputs["means"] @ W.T + t
    opacity = 1 / (1 + np.exp(-inputs["opacity_logits"]))
    order = sorted((i for i in range(len(opacity)) if centers[i, 2] > near and opacity[i] >= 1 / 255),
                   key=lambda i: (centers[i, 2], i))  # fmt: skip
    axes = [W @ rotation(q) for q in inputs["quats"]]
    scales = np.exp(inputs["log_scales"])
    H, width = scene.camera.height, scene.camera.width
    out = {name: np.zeros((H, width)) for name in OUTPUTS if name not in ("color", "normal")}
    out |= {name: np.zeros((H, width, 3)) for name in ("color", "normal")}
    weights = np.zeros((H, width, len(opacity)))
    for y in range(H):
        for x in range(width):
            ray = np.array([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], 1.0])
            T, seen = 1.0, []
            for i in order:
                p, R = centers[i], axes[i]
                slope = R[:, 2] @ ray
                depth = (R[:, 2] @ p) / slope if slope != 0 else math.inf
                local = R.T @ (depth * ray - p)
                rho3d = (local[0] / scales[i, 0]) ** 2 + (local[1] / scales[i, 1]) ** 2
                cx, cy = K[0, 0] * p[0] / p[2] + K[0, 2], K[1, 1] * p[1] / p[2] + K[1, 2]
                rho2d = 2 * ((x + 0.5 - cx) ** 2 + (y + 0.5 - cy) ** 2)
                if rho2d < rho3d:
                    depth = p[2]
                alpha = min(0.99, opacity[i] * math.exp(-0.5 * min(rho3d, rho2d)))
                if depth < near or alpha < 1 / 255:
                    continue
                if T * (1 - alpha) < 1e-4:
                    break
                n = R[:, 2] if R[:, 2] @ p <= 0 else -R[:, 2]
                seen.append((i, alpha * T, depth, n))
                if T > 0.5 >= T * (1 - alpha):
                    out["median_depth"][y, x] = depth
                T *= 1 - alpha
            A = sum(w for _, w, _, _ in seen)
            out["alpha"][y, x] = A
            out["color"][y, x] = sum((w * inputs["colors"][i] for i, w, _, _ in seen), T * scene.background.numpy())
            out["depth"][y, x] = sum(w * d for _, w, d, _ in seen) / A if A > 0 else 0.0
            out["normal"][y, x] = sum((w * n for _, w, _, n in seen), np.zeros(3))
            m = [far / (far - near) * (1 - near / d) for _, _, d, _ in seen]
            out["distortion"][y, x] = sum(
                seen[i][1] * seen[j][1] * (m[i] - m[j]) ** 2 for i in range(len(seen)) for j in range(i)
            )
            if target[y, x] != IGNORE:
                out["boundary"][y, x] = sum(w for i, w, _, _ in seen if classes[i] != target[y, x])
            for i, w, _, _ in seen:
                weights[y, x, i] = w
    return out, weights


@pytest.fixture(scope="module", params=["small", "opaque", "awkward"])
def worked_out(request):
    scene = SCENES[request.param]()
    return scene, *literal(scene)


def test_every_output_is_what_the_equations_say(worked_out):
    scene, expected, _ = worked_out
    drawn = scene.draw(TorchRasterizer())
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(drawn, name).numpy(), expected[name], rtol=1e-7, atol=1e-8, err_msg=name)


def test_contributions_class_map_and_heaviest(worked_out, rasterizer):
    scene, _, weights = worked_out
    arguments = (scene.inputs, scene.camera, scene.settings)
    target = scene.target.numpy()
    expected = np.stack([(weights * (target == c)[..., None]).sum((0, 1)) for c in range(CLASSES)], axis=-1)  # E6
    contributions = rasterizer.class_contributions(*arguments, scene.target, CLASSES)
    np.testing.assert_allclose(contributions.numpy(), expected, rtol=1e-6, atol=1e-8)
    for least in (0.0, 0.1):
        expected = np.stack([((weights > least) & (target == c)[..., None]).sum((0, 1)) for c in range(CLASSES)], -1)
        keys, counts = rasterizer.sparse_class_pixel_counts(*arguments, scene.target, CLASSES, least)
        assert keys.tolist() == np.flatnonzero(expected).tolist()
        assert counts.tolist() == expected[expected > 0].tolist()

    classes = scene.inputs.class_ids.numpy()
    per_class = np.stack([weights[..., classes == c].sum(-1) for c in range(CLASSES)], axis=-1)
    ids, share = rasterizer.class_map(*arguments, CLASSES)
    np.testing.assert_array_equal(ids.numpy(), per_class.argmax(-1))
    alpha = weights.sum(-1)
    winner = np.divide(per_class.max(-1), alpha, out=np.zeros_like(alpha), where=alpha > 0)
    np.testing.assert_allclose(share.numpy(), winner, rtol=1e-6, atol=1e-8)

    dominant_gaussian = np.where(weights.max(-1) > 0, weights.argmax(-1), -1)
    np.testing.assert_array_equal(rasterizer.dominant_gaussian(*arguments).numpy(), dominant_gaussian)


def test_features_are_drawn_with_the_weights_of_the_image(worked_out, rasterizer):
    scene, _, weights = worked_out
    features = torch.randn(len(scene.inputs.means), 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    drawn = draw_features(rasterizer, scene.inputs, features, scene.camera, scene.settings)
    np.testing.assert_allclose(drawn.numpy(), weights @ features.numpy(), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("output", OUTPUTS)
def test_gradients_are_finite_differences(output):
    """Every output by every input, in float64, over several blocks; the cut at 1/255 is faded, since it is a jump."""
    scene = make_scene(count=14, seed=11)
    assert scene.camera.width > 2 * BLOCK and scene.camera.height > BLOCK
    rasterizer = TorchRasterizer(smooth_cutoff=True)
    g = torch.Generator().manual_seed(1)
    values = {name: getattr(scene.inputs, name) for name in FLOATS} | {"background": scene.background}
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    image = getattr(scene.draw(rasterizer, **leaves), output)
    factors = torch.rand(image.shape, generator=g, dtype=torch.float64)
    (image * factors).sum().backward()
    step = 1e-6
    for name, value in values.items():
        gradient = leaves[name].grad
        gradient = torch.zeros_like(value) if gradient is None else gradient
        assert torch.isfinite(gradient).all()
        picks = torch.randperm(value.numel(), generator=g)[:12].tolist()
        for pick in picks:
            shifted = []
            for sign in (1, -1):
                moved = value.clone()
                moved.view(-1)[pick] += sign * step
                shifted.append((getattr(scene.draw(rasterizer, **{**values, name: moved}), output) * factors).sum())
            numeric = float(shifted[0] - shifted[1]) / (2 * step)
            assert float(gradient.view(-1)[pick]) == pytest.approx(numeric, rel=2e-4, abs=2e-4), (name, pick)
        # All entries at once, along a random direction.
        direction = torch.rand(value.shape, generator=g, dtype=torch.float64) - 0.5
        ahead, behind = (
            (getattr(scene.draw(rasterizer, **{**values, name: value + s * step * direction}), output) * factors).sum()
            for s in (1, -1)
        )
        assert float((gradient * direction).sum()) == pytest.approx(
            float(ahead - behind) / (2 * step), rel=1e-3, abs=1e-3
        )


def test_boundary_gradient_has_the_stated_closed_form():
    """dB/dalpha_i = T_i H_i - (sum_{j>i} w_j H_j) / (1 - alpha_i), read off three stacked surfels and one pixel."""
    logits = torch.tensor([-0.5, 0.3, 0.1], dtype=torch.float64, requires_grad=True)
    scene = make_scene(count=3, width=1, height=1)
    inputs = replace(
        scene.inputs,
        means=torch.tensor([[0.0, 0, 2], [0, 0, 3], [0, 0, 4]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(3, 1),
        log_scales=torch.zeros(3, 2, dtype=torch.float64),
        opacity_logits=logits,
        class_ids=torch.tensor([1, 0, 1], dtype=torch.int32),
    )
    K = torch.tensor([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)
    target = torch.zeros(1, 1, dtype=torch.int32)
    drawn = TorchRasterizer().rasterize(inputs, camera, scene.settings, scene.background, target)
    drawn.boundary.sum().backward()
    a = torch.sigmoid(logits.detach())
    w = a * torch.stack([torch.ones(()), 1 - a[0], (1 - a[0]) * (1 - a[1])])
    H = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    T = w / a
    expected = [T[i] * H[i] - (w[i + 1 :] * H[i + 1 :]).sum() / (1 - a[i]) for i in range(3)]
    torch.testing.assert_close(logits.grad, torch.stack(expected) * a * (1 - a))


def test_the_clamp_at_099_lets_the_gradient_through(rasterizer):
    """d colour / d logit = 0.99 (c - background) (1 - o): alpha is cut to 0.99, its slope by log o is not 0."""
    scene = make_scene(count=1, width=1, height=1)
    logit = torch.tensor([7.0], dtype=torch.float64, requires_grad=True)
    inputs = replace(
        scene.inputs,
        means=torch.tensor([[0.0, 0, 2]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        log_scales=torch.zeros(1, 2, dtype=torch.float64),
        opacity_logits=logit,
        colors=torch.tensor([[0.8, 0.6, 0.4]], dtype=torch.float64),
    )
    K = torch.tensor([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)
    drawn = rasterizer.rasterize(inputs, camera, scene.settings, torch.zeros(3, dtype=torch.float64))
    drawn.color.sum().backward()
    assert drawn.alpha.item() == pytest.approx(0.99, rel=1e-12)
    assert logit.grad.item() == pytest.approx(0.99 * 1.8 * float(1 - torch.sigmoid(logit.detach())), rel=1e-9)


def test_weight_is_the_derivative_of_the_image_by_the_colour(rasterizer):
    scene = make_scene()
    colors = scene.inputs.colors.clone().requires_grad_()
    scene.draw(rasterizer, colors=colors).color.sum().backward()
    everything = torch.zeros_like(scene.target)
    total = rasterizer.class_contributions(scene.inputs, scene.camera, scene.settings, everything, 1)[:, 0]
    torch.testing.assert_close(colors.grad, total[:, None].expand(-1, 3), rtol=1e-8, atol=1e-10)


def test_nonfinite_surfels_are_dropped_and_counted(rasterizer):
    scene = make_scene()
    clean = scene.draw(rasterizer, **{n: getattr(scene.inputs, n)[3:] for n in (*FLOATS, "class_ids")})
    means, quats, colors = (getattr(scene.inputs, n).clone() for n in ("means", "quats", "colors"))
    means[0, 1], quats[1, 2], colors[2, 0] = math.nan, math.inf, -math.inf
    leaves = {"means": means, "quats": quats, "colors": colors}
    leaves = {name: value.requires_grad_() for name, value in leaves.items()}
    drawn = scene.draw(rasterizer, **leaves)
    assert drawn.num_nonfinite == 3 and clean.num_nonfinite == 0
    assert not drawn.visible[:3].any()
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(drawn, name), getattr(clean, name), rtol=1e-9, atol=1e-10)
    drawn.color.sum().backward()
    assert all(torch.isfinite(value.grad).all() and not value.grad[:3].any() for value in leaves.values())


def test_surfels_too_large_or_too_far_for_float32_are_dropped_and_counted(rasterizer):
    scene = make_scene().to(torch.float32)
    clean = scene.draw(rasterizer, **{n: getattr(scene.inputs, n)[2:] for n in (*FLOATS, "class_ids")})
    leaves = {name: getattr(scene.inputs, name).clone() for name in FLOATS}
    ahead = scene.camera.rotation[2]
    leaves["means"][0], leaves["log_scales"][1, 1] = 1e20 * ahead, 80.0
    leaves = {name: value.requires_grad_() for name, value in leaves.items()}
    drawn = scene.draw(rasterizer, **leaves)
    assert drawn.num_nonfinite == 2 and clean.num_nonfinite == 0 and not drawn.visible[:2].any()
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(drawn, name), getattr(clean, name), rtol=1e-5, atol=1e-6)
    (drawn.color.sum() + drawn.depth.sum()).backward()
    assert all(torch.isfinite(value.grad).all() and not value.grad[:2].any() for value in leaves.values())


def test_nothing_to_render_gives_the_background_with_finite_gradients(rasterizer):
    scene = SCENES["empty"]()
    background = scene.background.clone().requires_grad_()
    drawn = scene.draw(rasterizer, background=background)
    torch.testing.assert_close(drawn.color, background.expand_as(drawn.color))
    assert not drawn.alpha.any() and not drawn.depth.any()
    drawn.color.sum().backward()
    pixels = scene.camera.width * scene.camera.height
    torch.testing.assert_close(background.grad, torch.full((3,), float(pixels), dtype=torch.float64))
    assert int(rasterizer.dominant_gaussian(scene.inputs, scene.camera, scene.settings).max()) == -1


def test_depth_has_finite_gradients_where_nothing_is(rasterizer):
    scene = make_scene(count=2, size=-3.0)
    means = scene.inputs.means.clone().requires_grad_()
    drawn = scene.draw(rasterizer, means=means)
    assert (drawn.alpha == 0).any() and (drawn.alpha > 0).any()
    drawn.depth.sum().backward()
    assert torch.isfinite(means.grad).all()


def test_wrong_shapes_are_named():
    scene = make_scene()
    with pytest.raises(ValueError, match="quats"):
        scene.draw(TorchRasterizer(), quats=scene.inputs.quats[:-1])
    with pytest.raises(ValueError, match="class_ids"):
        scene.draw(TorchRasterizer(), class_ids=None)
