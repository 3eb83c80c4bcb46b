"""L1 and SSIM with their gradient in closed form, in one pass over the image (method, section 1)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.ops import cuda_extension, extension


def photometric(
    image: Tensor, reference: Tensor, l1_weight: float, ssim_weight: float, c1: float, c2: float, offset: float = 0.0
) -> Tensor:
    """Return offset + l1_weight * mean |x - y| + ssim_weight * mean SSIM: a scalar.

    It is differentiable, once, in ``image``.

    image, reference: [H, W, 3], both float32 or both float64, on the CPU or on one GPU. c1, c2: the constants of SSIM.
    The window has 11 pixels, sigma 1.5, and zeros outside the image. The result has the same bits for any number of
    threads, and in every run on one GPU.
    """
    shape = tuple(image.shape)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise ValueError(f"image must be [H, W, 3], not {list(shape)}")
    extension.plain("reference", reference, shape, image.dtype)
    return _Photometric.apply(image, reference, (l1_weight, ssim_weight, c1, c2, offset))  # type: ignore[return-value]


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, reference: Tensor, numbers: tuple[float, ...]) -> Tensor:
        l1_weight, ssim_weight, c1, c2, offset = numbers
        x, y = image.detach().contiguous(), reference.detach().contiguous()
        gradient = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        scales = (l1_weight / x.numel(), ssim_weight / x.numel())
        if gradient is not None:
            ctx.save_for_backward(gradient)
        module = cuda_extension.module_for(x, y)
        if module is not None:
            return _on_gpu(module, x, y, (c1, c2, *scales, offset), gradient)
        sums = extension.function("photometric", x)(x, y, c1, c2, *scales, gradient, extension.threads())
        return x.new_full((), offset + scales[0] * sums[0] + scales[1] * sums[1])

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs: Tensor):
        (gradient,) = ctx.saved_tensors
        return extension.scaled(gradient, grad_outputs[0]), None, None


def _on_gpu(module, x: Tensor, y: Tensor, numbers: tuple[float, ...], gradient: Tensor | None) -> Tensor:
    """Return the value as a scalar on the GPU, which the host does not wait for; fills ``gradient``."""
    height, width, _ = x.shape
    tiles = -(-height // module.PHOTOMETRIC_TILE) * -(-width // module.PHOTOMETRIC_TILE)
    slopes = None if gradient is None else x.new_empty(3, *x.shape)
    sums = torch.empty(tiles, 2, dtype=torch.float64, device=x.device)
    value = x.new_empty(1)
    cuda_extension.call(module, "photometric", x, x, y, *numbers, slopes, gradient, sums, value)
    return value[0]
