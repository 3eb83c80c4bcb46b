"""Prepare a scene for a rasterizer, and read what it renders."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs, map_ids
from beags_plugin.system.errors import check_choice

if TYPE_CHECKING:
    from beags_plugin.options.scene_options import SceneOptions

SURFACE_DEPTHS = ("median", "expected")
"""The depths of E4 that can stand for the surface where pixels are lifted into space."""


def fixed_background(config: SceneOptions, device: torch.device | str = "cpu") -> Tensor:
    """Return the colour [3] behind a scene outside training: the one of its training, black for "random"."""
    return torch.full((3,), 1.0 if config.background_color == "white" else 0.0, device=device)


def surfel_inputs(
    surfels: Surfels, camera: Camera, sh_degree: int | None = None, class_ids: Tensor | None = None
) -> SurfelInputs:
    """Return the scene with its colours as ``camera`` sees them; differentiable.

    surfels: N surfels. sh_degree: degrees to use, all if None. class_ids: [N] int32, phi, or None.
    """
    degree = surfels.sh_degree if sh_degree is None else sh_degree
    colors = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, camera.host.center, degree)
    return SurfelInputs(surfels.means, surfels.quats, surfels.log_scales, surfels.opacity_logits, colors, class_ids)


def geometry_inputs(surfels: Surfels, class_ids: Tensor | None = None) -> SurfelInputs:
    """Return the scene without colours and gradients, for depth and products without gradient."""
    bare = surfels.detach()
    colors = torch.zeros_like(bare.means)
    return SurfelInputs(bare.means, bare.quats, bare.log_scales, bare.opacity_logits, colors, class_ids)


def shape_inputs(surfels: Surfels, members: Tensor) -> SurfelInputs:
    """Return some Gaussians without colours, for their alpha and depth; differentiable.

    surfels: N surfels. members: [M] int64, each at most once, so that every device adds the gradients alike.
    """
    values = (surfels.means, surfels.quats, surfels.log_scales, surfels.opacity_logits)
    means, quats, log_scales, logits = (value.index_select(0, members) for value in values)
    return SurfelInputs(means, quats, log_scales, logits, torch.zeros_like(means))


def render_class_map(
    rasterizer: Rasterizer, surfels: Surfels, class_ids: Tensor, camera: Camera, settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """Render the ``Rasterizer.class_map`` of class ids that may lie far apart: the rasterizer gets their ranks.

    surfels: N surfels. class_ids: [N] int32, phi. Returns ([H, W] int32 class ids, [H, W] float share), no gradient.
    """
    known = ClassRanks(class_ids)
    inputs = geometry_inputs(surfels, known.ranks(class_ids))
    classes, share = rasterizer.class_map(inputs, camera, settings, len(known))
    return known.class_ids(classes), share


def draw_features(
    rasterizer: Rasterizer, inputs: SurfelInputs, features: Tensor, camera: Camera, settings: RasterSettings
) -> Tensor:
    """Render any number of channels, [H, W, F] sum_i w_i f_i: no background, not divided by A.

    features: [N, F] of the inputs' dtype, F at least 1. Differentiable in them and in the inputs except the colours.
    A Gaussian with a colour or feature that is not finite contributes to no channel. Backends without
    ``feature_channels`` render three channels at a time.
    """
    channels, n = features.shape[-1], len(inputs.means)
    if features.shape != (n, channels) or features.dtype != inputs.means.dtype:
        expected, got = f"[{n}, F] {inputs.means.dtype}", f"{list(features.shape)} {features.dtype}"
        raise ValueError(f"features must be {expected}, not {got}")
    broken = sum((0 * value.detach()).sum(dim=1, keepdim=True) for value in (features, inputs.colors))  # NaN, else 0
    inputs = replace(inputs, colors=inputs.colors.detach() + broken)
    if (image := rasterizer.feature_channels(inputs, features, camera, settings)) is not None:
        return image
    settings = replace(settings, geometry=False, distortion=False)
    padded = torch.nn.functional.pad(features + broken, (0, -channels % 3))
    nothing = features.new_zeros(3)
    images = [
        rasterizer.rasterize(replace(inputs, colors=padded[:, first : first + 3]), camera, settings, nothing).color
        for first in range(0, channels, 3)
    ]
    return torch.cat(images, dim=-1)[..., :channels]


def class_channels_by_threes(
    rasterizer: Rasterizer, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
) -> Tensor:
    """Compute ``OptionalProducts.class_channels`` by ``draw_features``, for backends without a faster way."""
    one_hot = torch.nn.functional.one_hot(map_ids(inputs, num_classes).long(), num_classes)
    return draw_features(rasterizer, inputs, one_hot.to(inputs.means), camera, settings)


def surface_depth(render: RasterOutputs, kind: str) -> Tensor:
    """Return [H, W] depth of the surface that each pixel shows, world units; 0 where there is none.

    kind: "median", the hit at which half of the light is stopped, which always lies on a surface; or "expected", the
    mean over all hits (the D of E5), which at an object's boundary lies between the object and its background.
    Raises ``UserError`` for another kind.
    """
    check_choice(kind, SURFACE_DEPTHS, "surface depth")
    surface = render.median_depth if kind == "median" else render.depth
    if surface is None:
        raise ValueError("the settings must request geometry")
    return surface
