"""Threads and memory do not change a render; edge-on discs and poisoned numbers do not break it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from raster_scenes import CLASSES, FLOATS, OUTPUTS, SCENES, make_scene

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
from beags_plugin.rasterizers.torch_reference import TorchRasterizer


def everything(scene, rasterizer, **changes):
    """All outputs, all gradients and the gradient-free products."""
    leaves = {name: changes.get(name, getattr(scene.inputs, name)).clone().requires_grad_() for name in FLOATS}
    drawn = scene.draw(rasterizer, **leaves)
    sum(getattr(drawn, name).sum() for name in OUTPUTS).backward()
    results = {name: getattr(drawn, name).detach() for name in OUTPUTS}
    results |= {f"gradient of {name}": value.grad for name, value in leaves.items()}
    inputs = replace(scene.inputs, **{name: value.detach() for name, value in leaves.items()})
    arguments = (inputs, scene.camera, scene.settings)
    results["contributions"] = rasterizer.class_contributions(*arguments, scene.target, CLASSES)
    results["class map"], results["share"] = rasterizer.class_map(*arguments, CLASSES)
    return results, drawn


@pytest.mark.parametrize("name", ["small", "opaque", "awkward"])
def test_contributions_and_class_map_agree_with_alpha(rasterizer, name):
    scene = SCENES[name]()
    drawn = scene.draw(rasterizer)
    arguments = (scene.inputs, scene.camera, scene.settings)
    contributions = rasterizer.class_contributions(*arguments, scene.target, CLASSES)
    labelled = scene.target != IGNORE
    torch.testing.assert_close(contributions.sum(), drawn.alpha[labelled].sum(), rtol=1e-9, atol=1e-9)
    assert not contributions[~drawn.visible].any()
    ids, share = rasterizer.class_map(*arguments, CLASSES)
    # The share of a class at a pixel is 1 - B / A for the target that names this class.
    boundary = replace(scene, target=ids).draw(rasterizer).boundary
    torch.testing.assert_close(share * drawn.alpha, drawn.alpha - boundary, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_bit_is_the_same_for_any_number_of_threads(rasterizer, dtype):
    scene = make_scene(count=400, width=64, height=40, opacity=-2.0, seed=3).to(dtype)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        single, _ = everything(scene, rasterizer)
        torch.set_num_threads(3)
        several, _ = everything(scene, rasterizer)
    finally:
        torch.set_num_threads(threads)
    for name, value in single.items():
        assert torch.equal(value, several[name]), name


def test_rendering_blocks_again_to_save_memory_changes_no_bit():
    scene = make_scene()
    kept, _ = everything(scene, TorchRasterizer())
    again, _ = everything(scene, TorchRasterizer(memory_limit=0))
    assert all(torch.equal(kept[name], again[name]) for name in kept)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("parameter", "value", "dropped"),
    [
        ("log_scales", -46.0, 0),
        ("log_scales", -90.0, 0),
        ("log_scales", 400.0, 1),
        ("log_scales", -math.inf, 1),
        ("opacity_logits", 100.0, 0),
        ("opacity_logits", -100.0, 0),
        ("opacity_logits", math.nan, 1),
        ("quats", 0.0, 1),
        ("quats", 1e-20, 1),  # its gradient would overflow float32
        ("quats", 1e-9, 0),
        ("quats", 1e9, 0),
        ("quats", 1e20, 1),
        ("means", 1e-40, 0),
        ("means", math.inf, 1),
    ],
)
def test_one_poisoned_surfel_spoils_nothing_else(rasterizer, dtype, parameter, value, dropped):
    scene = make_scene(count=12).to(dtype)
    poisoned = getattr(scene.inputs, parameter).clone()
    poisoned[0] = value
    results, drawn = everything(scene, rasterizer, **{parameter: poisoned})
    assert drawn.num_nonfinite == dropped
    for name, result in results.items():
        assert torch.isfinite(result).all(), name


def test_an_edge_on_disc_is_rendered_by_the_low_pass_at_its_centre_depth(rasterizer):
    """Every ray's q_z is exactly 0 in the column of the centre: the depth must be the centre's, not a spike."""
    double = {"dtype": torch.float64}
    inputs = SurfelInputs(
        means=torch.tensor([[0.0, 0.0, 2.0]], **double),
        quats=torch.tensor([[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]], **double),  # normal along x
        log_scales=torch.full((1, 2), -2.0, **double).requires_grad_(),
        opacity_logits=torch.full((1,), 2.0, **double),
        colors=torch.ones(1, 3, **double),
    )
    camera = Camera(torch.eye(4, **double), torch.tensor([[20.0, 0, 4.0], [0, 20.0, 4.5], [0, 0, 1]], **double), 9, 9)
    drawn = rasterizer.rasterize(inputs, camera, RasterSettings(0.1, 10.0), torch.zeros(3, **double))
    hit = drawn.alpha[4] > 0
    assert hit.any()
    torch.testing.assert_close(drawn.depth[4][hit], torch.full((int(hit.sum()),), 2.0, **double), rtol=1e-6, atol=1e-6)
    (drawn.depth.sum() + drawn.color.sum()).backward()
    assert torch.isfinite(inputs.log_scales.grad).all()


def test_a_disc_that_crosses_the_camera_plane_reaches_the_whole_screen(rasterizer):
    """A floor through the camera's foot: its box would be wrong, so it must be looked for everywhere."""
    double = {"dtype": torch.float64}
    inputs = SurfelInputs(
        means=torch.tensor([[0.0, 0.5, 1.0]], **double),
        quats=torch.tensor([[math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]], **double),  # normal along y
        log_scales=torch.full((1, 2), 1.0, **double),
        opacity_logits=torch.full((1,), 4.0, **double),
        colors=torch.ones(1, 3, **double),
    )
    camera = Camera(
        torch.eye(4, **double), torch.tensor([[20.0, 0, 18.0], [0, 20.0, 17.0], [0, 0, 1]], **double), 40, 35
    )
    near = 0.1
    drawn = rasterizer.rasterize(inputs, camera, RasterSettings(near, 100.0), torch.zeros(3, **double))
    rows, columns = torch.meshgrid(torch.arange(35) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    depth = 0.5 * 20.0 / (rows.double() - 17.0)  # The ray meets the floor y = 0.5 there.
    u, v = (columns - 18.0) / 20.0 * depth / math.e, (depth - 1.0) / math.e
    alpha = torch.sigmoid(torch.tensor(4.0, **double)) * torch.exp(-0.5 * (u * u + v * v))
    below = (depth >= near) & (alpha >= 1 / 255)
    assert below[20:].any(dim=1).all() and (below & (rows > 33)).any()
    torch.testing.assert_close(drawn.alpha[below], alpha[below], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(drawn.depth[below], depth[below], rtol=1e-6, atol=1e-8)
