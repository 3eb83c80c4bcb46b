"""Normal consistency of a rendered view, with its gradient in closed form (method, section 1)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.ops import cuda_extension, extension


def normal_consistency(depth: Tensor, normal: Tensor, alpha: Tensor, K: Tensor, weight: float = 1.0) -> Tensor:
    """Return weight * mean over the inner pixels of A (1 - n . n_depth): a scalar.

    It is differentiable, once, in ``depth`` and ``normal``.

    depth: [H, W], 0 where unknown. normal: [H, W, 3], camera space. alpha: [H, W], held constant. All float32 or all
    float64, on the CPU or on one GPU. K: [3, 3], pixels; it is read on the host. ``losses.normal`` says which pixels
    count. The result has the same bits for any number of threads, and in every run on one GPU.
    """
    shape, dtype = tuple(depth.shape), depth.dtype
    if len(shape) != 2:
        raise ValueError(f"depth must be [H, W], not {list(shape)}")
    extension.plain("normal", normal, (*shape, 3), dtype)
    fixed = (extension.plain("alpha", alpha, shape, dtype), K.tolist(), weight)
    return _NormalConsistency.apply(depth, normal, fixed)  # type: ignore[return-value]


class _NormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(ctx, depth: Tensor, normal: Tensor, fixed) -> Tensor:
        alpha, K, weight = fixed
        d, n = depth.detach().contiguous(), normal.detach().contiguous()
        height, width = d.shape
        scale = weight / max((height - 2) * (width - 2), 1) if min(height, width) > 2 else weight
        gradients = (torch.empty_like(d), torch.empty_like(n)) if any(ctx.needs_input_grad) else (None, None)
        numbers = (K[0][0], K[1][1], K[0][1], K[0][2], K[1][2], scale)
        if gradients[0] is not None:
            ctx.save_for_backward(*gradients)
        module = cuda_extension.module_for(d, n, alpha)
        if module is not None:
            return _on_gpu(module, (d, n, alpha), numbers, gradients)
        compute = extension.function("normal_consistency", d)
        return d.new_full((), scale * compute(d, n, alpha, *numbers, *gradients, extension.threads()))

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs: Tensor):
        depth, normal = ctx.saved_tensors
        wanted, (factor,) = ctx.needs_input_grad, grad_outputs
        to_depth = extension.scaled(depth, factor) if wanted[0] else None
        return to_depth, extension.scaled(normal, factor) if wanted[1] else None, None


def _on_gpu(
    module, images: tuple[Tensor, ...], numbers: tuple[float, ...], gradients: tuple[Tensor | None, ...]
) -> Tensor:
    """Return the value as a scalar on the GPU, which the host does not wait for; fills ``gradients``."""
    depth = images[0]
    shares = None if gradients[0] is None else depth.new_empty(4, *depth.shape)
    blocks = -(-depth.numel() // module.NORMAL_THREADS)
    sums = torch.empty(blocks, dtype=torch.float64, device=depth.device)
    value = depth.new_empty(1)
    cuda_extension.call(module, "normal_consistency", depth, *images, *numbers, *gradients, shares, sums, value)
    return value[0]
