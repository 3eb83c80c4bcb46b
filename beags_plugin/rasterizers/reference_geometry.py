"""Gaussians in front of a camera and their hits with pixel rays, equation by equation (method, section 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat, usable_quats
from beags_plugin.rasterizers.interface import LARGEST, MAX_ALPHA, MIN_ALPHA, RasterSettings, SurfelInputs


@dataclass(frozen=True)
class ProjectedSurfels:
    """K Gaussians that survived culling, nearest first.

    index: [K] int64, their indices among the inputs.
    A, B, C: [K, 3] the ray-splat cross product is q = dx A + dy B + C, with (dx, dy) the pixel minus ``shifted``.
    det: [K] determinant of M; the plane's depth along a ray is det / q_z.
    center: [K, 2] pixels, the projected mean c, the centre of the low-pass filter; shifted: [K, 2] the same moved by
        the inputs' ``screen_shift``, the centre of the disc. depth: [K] the depth p_z of the mean.
    normal: [K, 3] camera space, towards the camera. opacity: [K]. box: [K, 4] x0, y0, x1, y1 in pixels.
    num_nonfinite: number of inputs that were dropped because they, or their projection, are not finite.
    """

    index: Tensor
    A: Tensor
    B: Tensor
    C: Tensor
    det: Tensor
    center: Tensor
    shifted: Tensor
    depth: Tensor
    normal: Tensor
    opacity: Tensor
    box: Tensor
    num_nonfinite: int = 0


@dataclass(frozen=True)
class Hits:
    """P pixels by K surfels: alpha [P, K], 0 where skipped, and the hit's depth [P, K] (the centre's where skipped)."""

    alpha: Tensor
    depth: Tensor


def finite_surfels(inputs: SurfelInputs) -> Tensor:
    """Return [N] bool: all parameters are finite, the quaternion has a usable length, the disc is not too large."""
    floats = (inputs.means, inputs.quats, inputs.log_scales, inputs.colors, inputs.opacity_logits[:, None])
    finite = torch.stack([torch.isfinite(value.detach()).all(dim=-1) for value in floats]).all(dim=0)
    return finite & usable_quats(inputs.quats) & (inputs.log_scales <= math.log(LARGEST)).all(dim=-1)


def project(inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> ProjectedSurfels:
    """Cull, project and sort N Gaussians; differentiable."""
    with torch.no_grad():
        depth = inputs.means @ camera.rotation[2] + camera.translation[2]
        finite = finite_surfels(inputs) & (depth <= LARGEST)
        opacity = torch.sigmoid(inputs.opacity_logits)
        index = (finite & (depth > settings.near) & (opacity >= MIN_ALPHA)).nonzero()[:, 0]
        index = index[depth[index].argsort(stable=True)]  # Order: centre depth, then index.
    projected = _project(inputs, index, camera)
    sound = _is_finite(projected)
    if not bool(sound.all()):
        # Gaussians that overflow are left out, the rest projected again: even an unused infinity would give NaN in the
        # backward.
        projected = _project(inputs, index[sound], camera)
    return replace(projected, num_nonfinite=int((~finite).sum()) + int((~sound).sum()))


def _is_finite(projected: ProjectedSurfels) -> Tensor:
    """Return [K] bool: the projection did not overflow; the box may be infinite."""
    fields = (projected.A, projected.B, projected.C, projected.center, projected.det[:, None], projected.depth[:, None])
    return torch.isfinite(torch.cat(fields, dim=-1)).all(dim=-1)


def _project(inputs: SurfelInputs, index: Tensor, camera: Camera) -> ProjectedSurfels:
    """Project the Gaussians ``index``; differentiable."""
    p = inputs.means[index] @ camera.rotation.T + camera.translation
    opacity = torch.sigmoid(inputs.opacity_logits[index])
    axes = camera.rotation @ rotation_from_quat(inputs.quats[index])
    scales = inputs.log_scales[index].exp()
    a, b, n = scales[:, :1] * axes[:, :, 0], scales[:, 1:] * axes[:, :, 1], axes[:, :, 2]
    n = torch.where((n * p).sum(dim=-1, keepdim=True) > 0, -n, n)  # normals that face the camera
    M = camera.K @ torch.stack([a, b, p], dim=-1)  # (E1)
    center = M[:, :2, 2] / M[:, 2:, 2]
    if inputs.screen_shift is not None:
        half = center.new_tensor([camera.width / 2, camera.height / 2])
        moved = torch.cat([M[:, :2, 2] + inputs.screen_shift[index] * half * M[:, 2:, 2], M[:, 2:, 2]], dim=-1)
        M = torch.cat([M[:, :, :2], moved[:, :, None]], dim=-1)
    shifted = M[:, :2, 2] / M[:, 2:, 2]
    # With the pixel relative to the disc's centre, large coordinates no longer cancel:
    # (dx Mw - Mx') x (dy Mw - My') is affine in dx, dy, because Mw x Mw = 0. (E2)
    Mw = M[:, 2]
    Mx, My = M[:, 0] - shifted[:, :1] * Mw, M[:, 1] - shifted[:, 1:] * Mw
    C = torch.linalg.cross(Mx, My)
    return ProjectedSurfels(
        index=index,
        A=torch.linalg.cross(My, Mw),
        B=torch.linalg.cross(Mw, Mx),
        C=C,
        det=(Mw * C).sum(dim=-1),
        center=center,
        shifted=shifted,
        depth=p[:, 2],
        normal=n,
        opacity=opacity,
        box=_screen_box(M.detach(), center.detach(), opacity.detach(), camera),
    )


def _screen_box(M: Tensor, center: Tensor, opacity: Tensor, camera: Camera) -> Tensor:
    """Return [K, 4] pixels where alpha can reach 1/255, the disc's conic united with the low-pass disc."""
    level = 2.0 * torch.log(opacity / MIN_ALPHA)
    signs = torch.stack([level, level, -torch.ones_like(level)], dim=-1)
    d = (signs * M[:, 2] ** 2).sum(dim=-1)
    f = signs / torch.where(d < 0, d, -torch.ones_like(d))[:, None]
    conic_center = (f[:, None] * M[:, :2] * M[:, 2:]).sum(dim=-1)
    half = (conic_center**2 - (f[:, None] * M[:, :2] ** 2).sum(dim=-1)).clamp_min(0.0).sqrt()
    low_pass = (0.5 * level).clamp_min(0.0).sqrt()[:, None]  # 2 r^2 = 2 ln(255 o)
    low = torch.minimum(conic_center - half, center - low_pass)
    high = torch.maximum(conic_center + half, center + low_pass)
    box = torch.cat([low, high], dim=-1)
    screen = box.new_tensor([0.0, 0.0, camera.width, camera.height])
    # A disc that crosses the camera plane has no conic: it may lie anywhere on the screen.
    return torch.where((d < 0)[:, None] & torch.isfinite(box).all(dim=-1, keepdim=True), box, screen)


def on_screen(projected: ProjectedSurfels, x0: float, y0: float, x1: float, y1: float) -> Tensor:
    """Return [K] bool: the Gaussian's box touches the rectangle (pixels)."""
    low, high = projected.box[:, :2], projected.box[:, 2:]
    return (low[:, 0] < x1) & (high[:, 0] > x0) & (low[:, 1] < y1) & (high[:, 1] > y0)


def hits(projected: ProjectedSurfels, chosen: Tensor, pixels: Tensor, near: float, smooth_cutoff: bool) -> Hits:
    """Return alpha and depth of the chosen Gaussians [S] at pixel centres [P, 2].

    smooth_cutoff: fade alpha out above 1/255 instead of cutting it there, so that finite differences hold (tests).
    """
    dx, dy = (pixels[:, None] - projected.shifted[chosen])[..., None].unbind(-2)
    q = dx * projected.A[chosen] + dy * projected.B[chosen] + projected.C[chosen]  # (E2)
    rho2d = 2.0 * (pixels[:, None] - projected.center[chosen]).square().sum(dim=-1)
    with torch.no_grad():
        # The choice comes first: where the low-pass wins, q_z may be 0 (the ray runs along the plane) or so small that
        # rho3d overflows, and then the branch not taken would still send NaN to the backward.
        on_disc = (q[..., 2] != 0) & ((q[..., :2] / q[..., 2:]).square().sum(dim=-1) <= rho2d)
    q_z = torch.where(on_disc, q[..., 2], torch.ones_like(q[..., 2]))
    rho3d = (q[..., 0] / q_z) ** 2 + (q[..., 1] / q_z) ** 2
    rho = torch.where(on_disc, rho3d, rho2d)
    center_depth = projected.depth[chosen].expand_as(rho)
    depth = torch.where(on_disc, projected.det[chosen] / q_z, center_depth)
    alpha = projected.opacity[chosen] * torch.exp(-0.5 * rho)
    alpha = alpha * (MAX_ALPHA / alpha.detach()).clamp_max(1.0)  # (E3); the clamp lets the gradient through
    if smooth_cutoff:
        fade = ((alpha - MIN_ALPHA) / MIN_ALPHA).clamp(0.0, 1.0)
        alpha = alpha * fade * fade * (3.0 - 2.0 * fade)
    counted = (depth >= near) & (alpha >= (0.0 if smooth_cutoff else MIN_ALPHA))
    return Hits(torch.where(counted, alpha, torch.zeros_like(alpha)), torch.where(counted, depth, center_depth))
