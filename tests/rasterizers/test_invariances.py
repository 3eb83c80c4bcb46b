"""Properties of any render: what a change of unit, place, order, names or window must not change (hypothesis)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from raster_scenes import CLASSES, FLOATS, OUTPUTS, Scene, make_scene

from beags_plugin.core.rotations import quat_product, rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers.interface import RasterSettings

# The same examples in every run; a fixture that names a backend holds no state between examples.
EXAMPLES = settings(
    max_examples=15, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def scenes(draw) -> Scene:
    """Scenes of any few surfels, whose size and opacity vary as much as those of real ones."""
    return make_scene(
        count=draw(st.integers(1, 60)),
        width=draw(st.integers(1, 40)),
        height=draw(st.integers(1, 40)),
        seed=draw(st.integers(0, 10_000)),
        opacity=draw(st.floats(-3.0, 5.0)),
        size=draw(st.floats(-4.0, 0.0)),
    )


def drawn(rasterizer, scene: Scene) -> dict[str, torch.Tensor]:
    """Outputs, and gradients of a combination of them that weighs every pixel alike."""
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
    images = scene.draw(rasterizer, **leaves)
    loss = sum(getattr(images, name).sum() for name in ("color", "alpha", "boundary", "normal", "distortion"))
    loss.backward()
    return {name: getattr(images, name).detach() for name in OUTPUTS} | {
        f"gradient of {name}": leaf.grad for name, leaf in leaves.items()
    }


def assert_alike(found, expected, names, factor=1.0):
    """Equal but for rounding, in units of the largest number expected; every 2,000th may be a hit at a threshold."""
    for name in names:
        value, wanted = found[name], factor * expected[name]
        off = (value - wanted).abs() > 1e-7 * max(float(wanted.abs().max()), 1.0)
        assert int(off.sum()) <= off.numel() // 2000, (name, float((value - wanted).abs().max()))


@EXAMPLES
@given(scene=scenes(), power=st.floats(-4.0, 6.0))
def test_the_unit_of_length_changes_depth_alone(rasterizer, scene, power):
    unit = 10.0**power
    viewmat = scene.camera.viewmat.clone()
    viewmat[:3, 3] *= unit
    inputs = replace(scene.inputs, means=scene.inputs.means * unit, log_scales=scene.inputs.log_scales + math.log(unit))
    limits = RasterSettings(scene.settings.near * unit, scene.settings.far * unit, distortion=True)
    rescaled = replace(scene, inputs=inputs, camera=replace(scene.camera, viewmat=viewmat), settings=limits)
    before, after = drawn(rasterizer, scene), drawn(rasterizer, rescaled)
    assert_alike(after, before, set(before) - {"depth", "median_depth", "gradient of means"})
    for name in ("depth", "median_depth"):
        assert_alike({name: after[name] / unit}, before, [name])
    assert_alike({"gradient of means": after["gradient of means"] * unit}, before, ["gradient of means"])


@EXAMPLES
@given(scene=scenes(), turn=st.tuples(*[st.floats(-1.0, 1.0)] * 4), shift=st.tuples(*[st.floats(-100.0, 100.0)] * 3))
def test_moving_everything_changes_nothing(rasterizer, scene, turn, shift):
    quat = torch.tensor(turn, dtype=torch.float64) + torch.tensor([1.5, 0.0, 0.0, 0.0])
    quat, shift = quat / quat.norm(), torch.tensor(shift, dtype=torch.float64)
    rotation = rotation_from_quat(quat)
    viewmat = scene.camera.viewmat.clone()
    viewmat[:3, :3] = scene.camera.rotation @ rotation.T
    viewmat[:3, 3] = scene.camera.translation - viewmat[:3, :3] @ shift
    inputs = replace(
        scene.inputs, means=scene.inputs.means @ rotation.T + shift, quats=quat_product(quat, scene.inputs.quats)
    )
    before = drawn(rasterizer, scene)
    after = drawn(rasterizer, replace(scene, inputs=inputs, camera=replace(scene.camera, viewmat=viewmat)))
    assert_alike(
        after, before, [*OUTPUTS, *(f"gradient of {name}" for name in FLOATS if name not in ("means", "quats"))]
    )
    assert_alike({"gradient of means": after["gradient of means"] @ rotation}, before, ["gradient of means"])


@EXAMPLES
@given(scene=scenes(), seed=st.integers(0, 1000))
def test_order_of_gaussians_and_names_of_classes_do_not_matter(rasterizer, scene, seed):
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scene.inputs.means), generator=generator)
    names = torch.randperm(60_000, generator=generator)[:CLASSES].int()
    floats = {name: getattr(scene.inputs, name)[order] for name in FLOATS}
    inputs = replace(scene.inputs, **floats, class_ids=names[scene.inputs.class_ids.long()][order])
    known = scene.target != IGNORE
    target = torch.where(known, names[torch.where(known, scene.target, 0).long()], scene.target)
    before, after = drawn(rasterizer, scene), drawn(rasterizer, replace(scene, inputs=inputs, target=target))
    assert_alike(after, before, OUTPUTS)
    for name in FLOATS:
        assert_alike({name: after[f"gradient of {name}"]}, {name: before[f"gradient of {name}"][order]}, [name])


@EXAMPLES
@given(scene=scenes(), data=st.data())
def test_a_window_of_the_picture_is_the_picture_of_a_window(rasterizer, scene, data):
    """A pixel shows the same, however the tiles fall."""
    x0, y0 = data.draw(st.integers(0, scene.camera.width - 1)), data.draw(st.integers(0, scene.camera.height - 1))
    width = data.draw(st.integers(1, scene.camera.width - x0))
    height = data.draw(st.integers(1, scene.camera.height - y0))
    K = scene.camera.K.clone()
    K[0, 2] -= x0
    K[1, 2] -= y0
    camera = replace(scene.camera, K=K, width=width, height=height)
    part = (slice(y0, y0 + height), slice(x0, x0 + width))
    whole = scene.draw(rasterizer)
    window = replace(scene, camera=camera, target=scene.target[part].contiguous()).draw(rasterizer)
    images = {name: getattr(whole, name)[part] for name in OUTPUTS}
    assert_alike({name: getattr(window, name) for name in OUTPUTS}, images, OUTPUTS)


@pytest.mark.parametrize("compiled", [True, False])
@EXAMPLES
@given(
    count=st.integers(1, 200), power=st.floats(-4.0, 6.0), steps=st.tuples(*[st.integers(-50, 50)] * 3),
    seed=st.integers(0, 1000),
)  # fmt: skip
def test_occupancy_knows_no_unit_no_origin_and_no_names(without_extension, compiled, count, power, steps, seed):
    """The samples are those of the Gaussians' numbers, so their order is kept here."""
    generator = torch.Generator().manual_seed(seed)
    scene = make_scene(count=count, seed=seed)
    unit = 2.0 ** round(power * math.log2(10.0))  # a power of two: points stay in their voxels
    names = torch.randperm(60_000, generator=generator)[:CLASSES].int()

    def value(unit, steps, names):
        inputs = scene.inputs
        points = inputs.means[::2] * unit + torch.tensor(steps, dtype=torch.float64) * 0.25 * unit
        grid = VisibilityGrid.from_points(
            [(points, names[inputs.class_ids[::2].long()])], 0.25 * unit, torch.zeros(3), 60_000
        )
        leaves = [
            (inputs.means * unit + torch.tensor(steps, dtype=torch.float64) * 0.25 * unit).requires_grad_(),
            inputs.quats.clone().requires_grad_(),
            (inputs.log_scales + math.log(unit)).requires_grad_(),
            inputs.opacity_logits.clone().requires_grad_(),
        ]
        surfels = Surfels.of(*leaves, inputs.colors[:, None])
        ids = names[inputs.class_ids.long()]
        given = LossInputs(1, 2, surfels, scene.camera, None, None, class_ids=ids, grid=grid)  # type: ignore
        loss = OccupancyLoss(samples=5).value(given)
        loss.backward()
        return {"value": loss.detach()} | {name: leaf.grad for name, leaf in zip(FLOATS, leaves, strict=False)}

    def both():
        plain = value(1.0, (0, 0, 0), torch.arange(CLASSES, dtype=torch.int32))
        return plain, value(unit, steps, names)

    before, after = both() if compiled else without_extension(both)
    assert_alike(after, before, set(before) - {"means"})
    assert_alike({"means": after["means"] * unit}, before, ["means"])
