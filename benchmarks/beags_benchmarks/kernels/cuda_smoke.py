"""Run of every CUDA kernel on a small scene, for a memory checker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from beags_benchmarks.kernels.scenes import CLASSES, Scene, Size, make_scene, on_device
from beags_benchmarks.kernels.training_step import visibility_grid
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.masks.voxel_reprojection import reproject_voxel
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.ops.normal_consistency import normal_consistency
from beags_plugin.ops.occupancy_loss import occupancy_loss
from beags_plugin.ops.photometric import photometric
from beags_plugin.ops.sh_colors import sh_colors
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings, SurfelInputs

LEAVES = ("means", "quats", "log_scales", "opacity_logits", "colors")
SMALL = Size(2_000, 130, 100)
DEGREES = (0, 1, 2, 3)
VARIANTS = (  # geometry, distortion, boundary; each has its own float32 kernels
    (False, False, False),
    (False, False, True),
    (True, False, False),
    (True, False, True),
    (True, True, True),
)


def smoke(rasterizer: Rasterizer, device: str = "cuda", size: Size = SMALL) -> list[str]:
    """Return the names of results that are not finite, in float32 and float64, forward and backward."""
    scene = on_device(make_scene(size), device)
    grid = visibility_grid(scene)
    wrong = []
    for dtype in (torch.float32, torch.float64):
        for name, values in _results(rasterizer, scene, grid, dtype):
            if not all(bool(value.isfinite().all()) for value in values):
                wrong.append(f"{name}, {dtype}")
    return wrong


def _results(
    rasterizer: Rasterizer, scene: Scene, grid: VisibilityGrid, dtype: torch.dtype
) -> Iterator[tuple[str, list[Tensor]]]:
    values = {**vars(scene.surfels), "colors": scene.colors}
    leaves = {name: values[name].detach().to(dtype).requires_grad_() for name in LEAVES}
    inputs = SurfelInputs(**leaves, class_ids=scene.class_ids)
    shift = torch.zeros(len(inputs.means), 2, dtype=dtype, device=inputs.means.device, requires_grad=True)
    for variant in VARIANTS:
        yield f"rendering {variant}", _rendered(rasterizer, scene, replace(inputs, screen_shift=shift), variant)
    plain = SurfelInputs(**{name: leaf.detach() for name, leaf in leaves.items()}, class_ids=scene.class_ids)
    camera, settings = scene.camera, scene.settings
    yield "contributions", [rasterizer.class_contributions(plain, camera, settings, scene.target, CLASSES)]
    yield "class map", list(rasterizer.class_map(plain, camera, settings, CLASSES))
    yield "dominant_gaussian", [rasterizer.dominant_gaussian(plain, camera, settings)]
    dc, rest = (value.to(dtype).requires_grad_() for value in (scene.surfels.sh_dc, scene.surfels.sh_rest))
    for degree in DEGREES:
        colors = sh_colors(dc, rest, inputs.means, torch.zeros(3, dtype=dtype), degree)
        yield f"colours of degree {degree}", [colors, *_gradients(colors, [dc, rest, inputs.means])]
    ids, (axis_u, axis_v) = scene.class_ids, (0.01 * (plain.means.roll(by, 0) - plain.means) for by in (1, 2))
    yield "voxel counts", [grid.count(plain.means, ids), grid.valid(plain.means, ids)]
    yield "discs inside", [grid.disc_inside(plain.means, axis_u, axis_v, ids)]
    lookup = grid.lookup()
    assert lookup is not None  # the compiled module has the CUDA rasterizer too
    shape = [inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits]
    loss = occupancy_loss(shape[0], shape[1], shape[2], shape[3], ids, lookup, stream=7, samples=20)
    yield "occupancy loss", [loss, *_gradients(loss, shape)]
    yield "image losses", _compared(rasterizer, scene, plain)
    yield "reprojection", list(_reprojected(rasterizer, scene, plain))


def _reprojected(rasterizer: Rasterizer, scene: Scene, inputs: SurfelInputs) -> Iterator[Tensor]:
    """Yield confidences of both reprojections from two views with different depths and masks."""
    settings, background = replace(scene.settings, geometry=True), scene.background.to(inputs.means.dtype)
    rendered = rasterizer.rasterize(inputs, scene.camera, settings, background)
    depths = [image for image in (rendered.depth, rendered.median_depth) if image is not None]
    masks = [scene.target, scene.target.flip(0).contiguous()]
    for reproject in (reproject_pairwise, reproject_voxel):
        for voted in reproject(depths, [scene.camera] * 2, masks, CLASSES):
            yield voted.confidence


def _compared(rasterizer: Rasterizer, scene: Scene, inputs: SurfelInputs) -> list[Tensor]:
    """Return L1 with SSIM and normal consistency of a view, with their gradients."""
    settings, background = replace(scene.settings, geometry=True), scene.background.to(inputs.means.dtype)
    rendered = rasterizer.rasterize(inputs, scene.camera, settings, background)
    images = [
        image.requires_grad_() for image in (rendered.color, rendered.depth, rendered.normal) if image is not None
    ]
    color, depth, normal = images
    likeness = photometric(color, color.detach().flip(0).contiguous(), 0.8, -0.2, 1e-4, 9e-4)
    smoothness = normal_consistency(depth, normal, rendered.alpha, scene.camera.host.K)
    return [likeness, smoothness, *_gradients(likeness + smoothness, images)]


def _rendered(
    rasterizer: Rasterizer, scene: Scene, inputs: SurfelInputs, variant: tuple[bool, bool, bool]
) -> list[Tensor]:
    geometry, distortion, boundary = variant
    settings = RasterSettings(0.05, 100.0, geometry=geometry, distortion=distortion)
    background = scene.background.to(inputs.means.dtype)
    rendered = rasterizer.rasterize(inputs, scene.camera, settings, background, scene.target if boundary else None)
    outputs = (
        rendered.color, rendered.alpha, rendered.depth, rendered.normal, rendered.median_depth, rendered.distortion,
        rendered.boundary,
    )  # fmt: skip
    images = [image for image in outputs if image is not None]
    leaves = [getattr(inputs, name) for name in (*LEAVES, "screen_shift")]
    return [*images, *_gradients(sum(image.square().sum() for image in images), leaves)]  # type: ignore[arg-type]


def _gradients(value: Tensor, leaves: list[Tensor]) -> list[Tensor]:
    gradients = torch.autograd.grad(value.sum(), leaves, allow_unused=True)
    return [gradient for gradient in gradients if gradient is not None]
