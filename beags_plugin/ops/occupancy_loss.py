"""The occupancy loss with its gradients, in one pass over the Gaussians (method, section 6; E9)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.ops import cuda_extension, extension
from beags_plugin.ops.voxel_lookup import VoxelLookup


def occupancy_loss(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    class_ids: Tensor,
    lookup: VoxelLookup,
    stream: int,
    samples: int,
    background: bool = True,
    weight: float = 1.0,
) -> Tensor:
    """Return weight * L_occ (E9), a scalar; differentiable, once, in the four parameters.

    Its memory does not grow with ``samples``.

    means [N, 3], quats [N, 4] wxyz, log_scales [N, 2], opacity_logits [N]: as in ``core.surfels.Surfels``; float32 or
        float64, on the CPU or a GPU. Gaussians with a parameter that is not finite, or with a scale of 0, count as 0.
    class_ids: [N] int32, phi.
    lookup: that of the visibility grid.
    stream: 64 bits that decide the random points, from ``occupancy.sampling.sample_stream``.
    samples: Z, points per Gaussian.
    background: whether the Gaussians of class 0 take part.
    """
    n, dtype = len(means), means.dtype
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 2), "opacity_logits": (n,)}
    parameters = [means, quats, log_scales, opacity_logits]
    for (name, shape), value in zip(shapes.items(), parameters, strict=True):
        extension.plain(name, value, shape, dtype)
    class_ids = extension.plain("class_ids", class_ids, (n,), torch.int32)
    if samples < 0:
        raise ValueError(f"samples must be 0 or more, not {samples}")
    module = cuda_extension.module_for(*parameters)
    tables = lookup.native if module is None else lookup.voxels(module, means.device)
    fixed = (module, lookup.ranks(class_ids), tables, stream, samples, background, weight)
    return _OccupancyLoss.apply(fixed, *parameters)  # type: ignore[return-value]


class _OccupancyLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, fixed, *parameters: Tensor) -> Tensor:
        plain = [value.detach().contiguous() for value in parameters]
        wanted = any(ctx.needs_input_grad)
        gradients = [torch.empty_like(value) for value in plain] if wanted else [None] * 4
        module, *arguments, weight = fixed
        if wanted:
            ctx.save_for_backward(*gradients)
        if module is not None:
            return _on_gpu(module, plain, arguments, gradients, weight)
        compute = extension.function("occupancy_loss", plain[0])
        value, _ = compute(*plain, *arguments, *gradients, extension.threads(), weight)
        return plain[0].new_full((), value)

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs: Tensor):
        return None, *(extension.scaled(gradient, grad_outputs[0]) for gradient in ctx.saved_tensors)


def _on_gpu(module, plain: list[Tensor], arguments: list, gradients: list, weight: float) -> Tensor:
    """Return the value as a scalar on the GPU, which the host does not wait for; fills ``gradients``."""
    blocks = -(-len(plain[0]) // module.OCCUPANCY_THREADS)
    partial = torch.empty(blocks, dtype=torch.float64, device=plain[0].device)
    value = plain[0].new_empty(1)
    arguments = [*plain, *arguments, *gradients, partial, value, weight, True]
    cuda_extension.call(module, "occupancy_loss", plain[0], *arguments)
    return value[0]
