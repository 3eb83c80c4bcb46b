"""Colours from spherical harmonics, forward and backward (method, section 1)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.ops import cuda_extension, extension


def sh_colors(sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_center: Tensor, degree: int) -> Tensor:
    """Return the colour of each Gaussian as seen from ``camera_center``: SH + 0.5, clamped at 0; [N, 3].

    sh_dc: [N, 3], degree 0. sh_rest: [N, K, 3], the others, K >= (degree + 1)^2 - 1. means: [N, 3] world.
    camera_center: [3] world, without gradient, read faster from the CPU. degree: 0..3. All float32 or all float64, on
    the CPU or a GPU; differentiable, once, in ``sh_dc``, ``sh_rest`` and ``means``.
    """
    n, dtype = len(sh_dc), sh_dc.dtype
    if not 0 <= degree <= 3:
        raise ValueError(f"the degree of spherical harmonics must be 0..3, not {degree}")
    least, shape = (degree + 1) ** 2 - 1, tuple(sh_rest.shape)
    if len(shape) != 3 or shape[0] != n or shape[1] < least or shape[2] != 3 or sh_rest.dtype != dtype:
        raise ValueError(f"sh_rest must be [{n}, {least} or more, 3] {dtype}, not {list(shape)} {sh_rest.dtype}")
    extension.check("sh_dc", sh_dc, (n, 3), dtype)
    extension.check("means", means, (n, 3), dtype)
    extension.check("camera_center", camera_center, (3,), dtype)
    return _Colors.apply(sh_dc, sh_rest, means, camera_center.tolist(), degree)  # type: ignore[return-value]


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sh_dc: Tensor, sh_rest: Tensor, means: Tensor, center: list[float], degree: int) -> Tensor:
        plain = (sh_dc.contiguous(), sh_rest.contiguous(), means.contiguous())
        colors = torch.empty_like(plain[2])
        clamped = torch.empty(len(colors), dtype=torch.uint8, device=colors.device)
        module = cuda_extension.module_for(*plain)
        if module is not None:
            cuda_extension.call(module, "sh_colors", colors, *plain, center, degree, colors, clamped)
        else:
            extension.function("sh_colors", colors)(*plain, center, degree, colors, clamped, extension.threads())
        ctx.fixed = (center, degree, clamped, module)
        ctx.save_for_backward(sh_dc, sh_rest, means)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs: Tensor):
        center, degree, clamped, module = ctx.fixed
        plain = [value.contiguous() for value in ctx.saved_tensors]
        dc, rest, means = ctx.needs_input_grad[:3]
        wanted = (dc, rest, means and degree > 0)
        gradients = [torch.empty_like(value) if want else None for value, want in zip(plain, wanted, strict=True)]
        arguments = (*plain, center, degree, clamped, grad_outputs[0].contiguous(), *gradients)
        if any(wanted) and module is not None:
            cuda_extension.call(module, "sh_colors_backward", plain[2], *arguments)
        elif any(wanted):
            extension.function("sh_colors_backward", plain[2])(*arguments, extension.threads())
        return *gradients, None, None
