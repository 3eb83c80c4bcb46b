"""Forward and backward of rasterizers on one scene."""

from __future__ import annotations

import hashlib
from dataclasses import asdict

import torch
from torch import Tensor

from beags_benchmarks.kernels.clock import Seconds
from beags_benchmarks.kernels.scenes import OUTPUTS, Scene, surfel_inputs
from beags_plugin.rasterizers import RASTERIZERS, native
from beags_plugin.rasterizers.interface import Rasterizer, SurfelInputs
from beags_plugin.system.memory import available_mb

LEAVES = ("means", "quats", "log_scales", "opacity_logits", "colors", "background")


def rasterizer(name: str) -> Rasterizer:
    """Return a registered rasterizer; the reference may take a quarter of the free memory."""
    if name == "torch":
        return RASTERIZERS.get("torch")(memory_limit=min(4e9, 0.25e6 * available_mb()))
    return RASTERIZERS.get(name)()


def make_leaves(scene: Scene) -> dict[str, Tensor]:
    """Return fresh leaves of the scene's float inputs, sharing its storage."""
    values = {**vars(scene.surfels), "colors": scene.colors, "background": scene.background}
    return {name: values[name].detach().requires_grad_() for name in LEAVES}


def run(name: str, scene: Scene) -> tuple[Seconds, Seconds, dict[str, Tensor], dict[str, Tensor]]:
    """Run forward and backward of a rasterizer; returns the time of each, and images and gradients by name."""
    leaves = make_leaves(scene)
    floats = {leaf: leaves[leaf] for leaf in LEAVES if leaf != "background"}
    inputs = SurfelInputs(**floats, class_ids=scene.class_ids)
    start = Seconds.now()
    outputs = rasterizer(name).rasterize(inputs, scene.camera, scene.settings, leaves["background"], scene.target)
    images = {output: getattr(outputs, output) for output in OUTPUTS}
    rendered = Seconds.now()
    loss = _Loss.apply([scene.gradients[name] for name in images], *images.values())
    grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    end = Seconds.now()
    gradients = {name: g for name, g in zip(leaves, grads, strict=True) if g is not None}
    return rendered - start, end - rendered, images, gradients


class _Loss(torch.autograd.Function):
    """A scalar whose backward has given gradients: passing them to autograd directly costs more time."""

    @staticmethod
    def forward(ctx, gradients: list[Tensor], *images: Tensor) -> Tensor:
        ctx.gradients = gradients
        return images[0].new_zeros(())

    @staticmethod
    def backward(ctx, *_: Tensor):
        return None, *ctx.gradients


def digest(*tensors: Tensor) -> str:
    """Return a hash of every bit of the tensors."""
    total = hashlib.sha256()
    for tensor in tensors:
        total.update(tensor.detach().contiguous().numpy().tobytes())
    return total.hexdigest()


def work_counts(scene: Scene) -> dict[str, int] | None:
    """Return {"lanes", "contributing", "tile_pairs", "box_pairs"} of one view; None without the compiled rasterizer."""
    if native.NativeRasterizer.unavailable() is not None:
        return None
    return asdict(native.work_counts(surfel_inputs(scene), scene.camera, scene.settings))
