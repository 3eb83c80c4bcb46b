"""gsplat's 2DGS functions in plain torch, completed so that they run without CUDA.

Two parts of them exist as CUDA kernels only and are written here from the maths, in torch: the list of (surfel, pixel)
pairs that contribute, and nerfacc's transmittance along each pixel's list. The rest is gsplat's own.
"""

from __future__ import annotations

from unittest.mock import patch

import nerfacc
import torch
from gsplat.cuda import _torch_impl, _torch_impl_2dgs, _wrapper
from torch import Tensor

from beags_plugin.core.cameras import Camera

TILE = 16
MIN_ALPHA, MIN_TRANSMITTANCE = 1 / 255, 1e-4  # gsplat's


def render(leaves: dict[str, Tensor], camera: Camera, near: float, far: float) -> dict[str, Tensor]:
    """Render color [H, W, 3], alpha [H, W] and normal [H, W, 3], differentiable in ``leaves``.

    leaves: named as in ``SurfelInputs``.
    """
    width, height = camera.width, camera.height
    scales = leaves["log_scales"].exp()
    scales = torch.cat([scales, torch.ones_like(scales[:, :1])], dim=-1)  # the third scales the normal
    radii, means2d, depths, transforms, normals = _torch_impl_2dgs._fully_fused_projection_2dgs(
        leaves["means"], leaves["quats"], scales, camera.viewmat[None], camera.K[None], width, height, near, far
    )
    tiles = (-(-width // TILE), -(-height // TILE))
    with torch.no_grad():
        _, keys, ids = _torch_impl._isect_tiles(means2d, radii, depths, TILE, *tiles)
        offsets = _torch_impl._isect_offset_encode(keys, 1, *tiles)
    with (
        patch.object(_wrapper, "rasterize_to_indices_in_range_2dgs", contributing_pairs),
        patch.object(nerfacc, "render_weight_from_alpha", weights_along_rays),
    ):
        color, alpha, normal = _torch_impl_2dgs._rasterize_to_pixels_2dgs(
            means2d,
            transforms.transpose(-1, -2),  # the projection returns columns where rendering wants rows
            leaves["colors"][None],
            normals,
            torch.sigmoid(leaves["opacity_logits"])[None],
            width,
            height,
            TILE,
            offsets,
            ids,
            leaves["background"][None],
        )
    return {"color": color[0], "alpha": alpha[0, ..., 0], "normal": normal[0]}


@torch.no_grad()
def contributing_pairs(
    start, stop, transmittances, means2d, transforms, opacities, width, height, tile, offsets, ids
):  # fmt: skip
    """Return the pairs of batches start..stop that add to a pixel: surfels, pixels, cameras, [M] int64 each.

    Replaces a CUDA kernel of the same arguments. Tile by tile: alpha of every surfel at every pixel, the transmittance
    as a running product, and what survives both thresholds.
    """
    surfels, pixels = [], []
    ends = torch.cat([offsets.flatten(), offsets.new_tensor([len(ids)])])
    for index in range(len(ends) - 1):
        first = int(ends[index]) + start * tile * tile
        last = min(int(ends[index + 1]), int(ends[index]) + stop * tile * tile)
        if first >= last:
            continue
        chosen = ids[first:last].long()
        row, column = divmod(index, offsets.shape[2])
        y, x = torch.meshgrid(
            torch.arange(row * tile, min((row + 1) * tile, height)),
            torch.arange(column * tile, min((column + 1) * tile, width)),
            indexing="ij",
        )
        x, y = x.reshape(-1, 1), y.reshape(-1, 1)
        matrix = transforms[0, chosen]
        px, py = x[..., None] + 0.5, y[..., None] + 0.5
        q = torch.cross(px * matrix[:, 2] - matrix[:, 0], py * matrix[:, 2] - matrix[:, 1], dim=-1)  # (E2)
        rho3d = (q[..., 0] / q[..., 2]) ** 2 + (q[..., 1] / q[..., 2]) ** 2
        offset = torch.cat([px, py], dim=-1) - means2d[0, chosen]
        rho = torch.minimum(rho3d, 2.0 * offset.square().sum(dim=-1))
        alpha = (opacities[0, chosen] * torch.exp(-0.5 * rho)).clamp_max(0.999)  # (E3), with gsplat's maximum
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
        left = transmittances[0][y[:, 0], x[:, 0], None] * torch.cumprod(1.0 - alpha, dim=-1)
        pixel, surfel = ((alpha > 0) & (left > MIN_TRANSMITTANCE)).nonzero().unbind(-1)
        surfels.append(chosen[surfel])
        pixels.append((y * width + x)[pixel, 0])
    if not surfels:
        nothing = torch.zeros(0, dtype=torch.int64)
        return nothing, nothing, nothing
    joined = torch.cat(surfels)
    return joined, torch.cat(pixels), torch.zeros_like(joined)


def weights_along_rays(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """w_i = alpha_i T_i and T_i [M], T_i the product of 1 - alpha over the earlier entries of the same pixel.

    Replaces nerfacc's function of this name, whose segmented scan is a CUDA kernel. Entries of a pixel are neighbours.
    """
    log_left = torch.log1p(-alphas.double())  # double: one running sum over all pixels
    before = torch.cumsum(log_left, dim=0) - log_left
    fresh = torch.ones_like(ray_indices, dtype=torch.bool)
    fresh[1:] = ray_indices[1:] != ray_indices[:-1]
    segment = torch.cumsum(fresh, dim=0) - 1
    transmittance = torch.exp(before - before[fresh][segment]).to(alphas)
    return transmittance * alphas, transmittance
