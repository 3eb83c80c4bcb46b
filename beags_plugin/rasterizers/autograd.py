"""One autograd function for every backend that brings a forward and a backward kernel."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs


class Images(NamedTuple):
    """The float images of ``RasterOutputs`` (names, shapes, dtypes), or gradients towards them; None: absent."""

    color: Tensor | None
    alpha: Tensor | None
    depth: Tensor | None
    median_depth: Tensor | None
    normal: Tensor | None
    distortion: Tensor | None
    boundary: Tensor | None


class InputGradients(NamedTuple):
    """Gradients towards the float fields of ``SurfelInputs`` and the background, shaped as these; None: not needed."""

    means: Tensor | None
    quats: Tensor | None
    log_scales: Tensor | None
    opacity_logits: Tensor | None
    colors: Tensor | None
    screen_shift: Tensor | None
    background: Tensor | None


class Needed(NamedTuple):
    """Which fields of ``InputGradients`` are needed."""

    means: bool
    quats: bool
    log_scales: bool
    opacity_logits: bool
    colors: bool
    screen_shift: bool
    background: bool


@dataclass(frozen=True)
class Drawing:
    """What one call draws; tensors are checked and contiguous, and nothing that is done with them is recorded.

    inputs, camera, settings: as in ``Rasterizer.rasterize``.
    background: [3] of the inputs' dtype.
    target: [H, W] int32 class ids or IGNORE, or None: no boundary.
    differentiable: whether a backward may follow; if not, the forward need not keep anything for it.
    """

    inputs: SurfelInputs
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor | None
    differentiable: bool


class Forward(NamedTuple):
    """What a forward kernel returns: the images, visible [N] bool, num_nonfinite, and a state for its own backward."""

    images: Images
    visible: Tensor
    num_nonfinite: int
    state: Any


def check_image(name: str, value: Tensor, camera: Camera) -> Tensor:
    """``value``, contiguous, if it is an int32 class map of the camera's size; else raises ``ValueError``."""
    shape = (camera.height, camera.width)
    if tuple(value.shape) != shape or value.dtype != torch.int32:
        raise ValueError(f"{name} must be {list(shape)} int32, not {list(value.shape)} {value.dtype}")
    return value.contiguous()


class KernelRasterizer(Rasterizer):
    """A backend made of two kernels; all float images are differentiable in all float inputs and the background.

    Cameras get no gradient, and there are no second derivatives.
    """

    @abstractmethod
    def forward_kernel(self, drawing: Drawing) -> Forward:
        """Draw. depth, median_depth and normal are None without ``settings.geometry``, and so on."""

    @abstractmethod
    def backward_kernel(self, drawing: Drawing, state: Any, gradients: Images, needed: Needed) -> InputGradients:
        """The way back. None among ``gradients`` means zero; the others are contiguous."""

    def rasterize(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,
        target: Tensor | None = None,
    ) -> RasterOutputs:
        """See ``Rasterizer.rasterize``."""
        inputs = inputs.checked()
        if tuple(background.shape) != (3,) or background.dtype != inputs.means.dtype:
            expected, got = inputs.means.dtype, f"{list(background.shape)} {background.dtype}"
            raise ValueError(f"background must be [3] {expected}, not {got}")
        if target is not None:
            target = check_image("target", target, camera)
            if inputs.class_ids is None:
                raise ValueError("class_ids must be given together with target")
        floats = (inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits, inputs.colors)
        watched = [value for value in (*floats, inputs.screen_shift, background) if value is not None]
        differentiable = torch.is_grad_enabled() and any(value.requires_grad for value in watched)
        drawing = Drawing(inputs, camera, settings, background.contiguous(), target, differentiable)
        if not differentiable:
            images, visible, num_nonfinite, _ = self.forward_kernel(drawing)
        else:
            found: Any = _Rasterize.apply(self, drawing, *floats, inputs.screen_shift, background)
            *images, visible, num_nonfinite = found
        return RasterOutputs(*images, visible=visible, num_nonfinite=num_nonfinite)  # type: ignore


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rasterizer, drawing, *floats):
        images, visible, num_nonfinite, state = rasterizer.forward_kernel(drawing)
        # The inputs are saved through autograd, which notices it if they are changed in place before the backward.
        ctx.save_for_backward(*floats)
        ctx.rasterizer, ctx.state = rasterizer, state
        ctx.drawing = (drawing.camera, drawing.settings, drawing.target)  # not the inputs: they would live as long
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)  # None tells the kernel what it need not compute
        return *images, visible, num_nonfinite

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        *floats, _, background = ctx.saved_tensors
        camera, settings, target = ctx.drawing
        drawing = Drawing(SurfelInputs(*floats), camera, settings, background, target, True)
        images = Images(*[None if g is None else g.contiguous() for g in gradients[:-2]])
        if all(g is None for g in images):
            return (None,) * 9
        found = ctx.rasterizer.backward_kernel(drawing, ctx.state, images, Needed(*ctx.needs_input_grad[2:]))
        return None, None, *found
