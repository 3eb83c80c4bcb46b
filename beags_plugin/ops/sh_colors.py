"""Colours from spherical harmonics, forward and backward (method, section 1)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.ops import extension


def sh_colors(sh: Tensor, means: Tensor, camera_center: Tensor, degree: int) -> Tensor:
    """Colour of each surfel as seen from ``camera_center``: SH + 0.5, clamped at 0; [N, 3].

    sh: [N, K, 3], K >= (degree + 1)^2. means: [N, 3] world. camera_center: [3] world, without gradient. degree: 0..3.
    All float32 or all float64, on the CPU; differentiable, once, in ``sh`` and ``means``.
    """
    n, dtype = len(sh), sh.dtype
    if not 0 <= degree <= 3:
        raise ValueError(f"the degree of spherical harmonics must be 0..3, not {degree}")
    if sh.dim() != 3 or sh.shape[1] < (degree + 1) ** 2 or sh.shape[2] != 3:
        raise ValueError(f"sh must be [{n}, {(degree + 1) ** 2} or more, 3], not {list(sh.shape)}")
    extension.plain("means", means, (n, 3), dtype)
    center = extension.plain("camera_center", camera_center, (3,), dtype).tolist()
    return _Colors.apply(sh, means, center, degree)  # type: ignore[return-value]


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sh: Tensor, means: Tensor, center: list[float], degree: int) -> Tensor:
        ctx.fixed = (center, degree)
        plain = (sh.detach().contiguous(), means.detach().contiguous())
        colors = torch.empty_like(plain[1])
        clamped = torch.empty(len(sh), dtype=torch.uint8)
        extension.function("sh_colors", sh)(*plain, center, degree, colors, clamped, extension.threads())
        ctx.save_for_backward(sh, means, clamped)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs: Tensor):
        sh, means, clamped = ctx.saved_tensors
        center, degree = ctx.fixed
        plain = (sh.detach().contiguous(), means.detach().contiguous())
        wanted = (ctx.needs_input_grad[0], ctx.needs_input_grad[1] and degree > 0)
        found = [torch.empty_like(value) if want else None for value, want in zip(plain, wanted, strict=True)]
        if any(wanted):
            backward = extension.function("sh_colors_backward", sh)
            backward(*plain, center, degree, clamped, grad_outputs[0].contiguous(), *found, extension.threads())
        return *found, None, None
