"""One autograd function for every backend that has a forward and a backward kernel."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import FLOATS, Rasterizer, RasterOutputs, RasterSettings, SurfelInputs


class Images(NamedTuple):
    """The float images of ``RasterOutputs`` (names, shapes, dtypes), or gradients of the loss in them; None: absent."""

    color: Tensor | None
    alpha: Tensor | None
    depth: Tensor | None
    median_depth: Tensor | None
    normal: Tensor | None
    distortion: Tensor | None
    boundary: Tensor | None


class InputGradients(NamedTuple):
    """Gradients of the float fields of ``SurfelInputs`` and of the background, in their shapes; None: not needed."""

    means: Tensor | None
    quats: Tensor | None
    log_scales: Tensor | None
    opacity_logits: Tensor | None
    colors: Tensor | None
    screen_shift: Tensor | None
    background: Tensor | None


@dataclass(frozen=True)
class RenderCall:
    """One render: its tensors are checked and contiguous, and autograd does not record operations on them.

    inputs, camera, settings: as in ``Rasterizer.rasterize``.
    background: [3] of the inputs' dtype.
    target: [H, W] int32 class ids or IGNORE, or None: no boundary.
    differentiable: whether a backward may follow; if not, the forward need not save anything for it.
    """

    inputs: SurfelInputs
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor | None
    differentiable: bool

    def empty_image(self, wanted: bool, *channels: int, dtype: torch.dtype | None = None) -> Tensor | None:
        """Return memory for an image [H, W, *channels], of the inputs' dtype by default; None if not wanted."""
        shape = (self.camera.height, self.camera.width, *channels)
        return self.inputs.means.new_empty(shape, dtype=dtype) if wanted else None

    def empty_images(self) -> Images:
        """Return memory for the images that the settings and the target request."""
        geometry = self.settings.geometry
        return Images(
            color=self.empty_image(True, 3),
            alpha=self.empty_image(True),
            depth=self.empty_image(geometry),
            median_depth=self.empty_image(geometry),
            normal=self.empty_image(geometry, 3),
            distortion=self.empty_image(self.settings.distortion),
            boundary=self.empty_image(self.target is not None),
        )


class Forward(NamedTuple):
    """A forward kernel's result: the images, visible [N] bool, num_nonfinite, and a state for its backward."""

    images: Images
    visible: Tensor
    num_nonfinite: int
    state: Any


def check_image(name: str, value: Tensor, camera: Camera) -> Tensor:
    """Return ``value``, contiguous; raise ``ValueError`` unless it is an int32 class map of the camera's size."""
    shape = (camera.height, camera.width)
    if tuple(value.shape) != shape or value.dtype != torch.int32:
        raise ValueError(f"{name} must be {list(shape)} int32, not {list(value.shape)} {value.dtype}")
    return value.contiguous()


class KernelRasterizer(Rasterizer):
    """A backend made of two kernels; all float images are differentiable in all float inputs and the background.

    Cameras get no gradient, and there are no second derivatives.
    """

    @abstractmethod
    def forward_kernel(self, call: RenderCall) -> Forward:
        """Render; images that neither the settings nor the target request are None."""

    @abstractmethod
    def backward_kernel(
        self, call: RenderCall, state: Any, gradients: Images, needed: Sequence[bool]
    ) -> InputGradients:
        """Compute the gradients that are ``needed``, one bool for each field of ``InputGradients``.

        None among ``gradients`` means zero; the others are contiguous.
        """

    def rasterize(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,
        target: Tensor | None = None,
    ) -> RasterOutputs:
        inputs = inputs.checked()
        if tuple(background.shape) != (3,) or background.dtype != inputs.means.dtype:
            expected, got = inputs.means.dtype, f"{list(background.shape)} {background.dtype}"
            raise ValueError(f"background must be [3] {expected}, not {got}")
        if target is not None:
            target = check_image("target", target, camera)
            if inputs.class_ids is None:
                raise ValueError("class_ids must be given together with target")
        floats = [getattr(inputs, name) for name in FLOATS]
        watched = [value for value in (*floats, inputs.screen_shift, background) if value is not None]
        differentiable = torch.is_grad_enabled() and any(value.requires_grad for value in watched)
        call = RenderCall(inputs, camera, settings, background.contiguous(), target, differentiable)
        if not differentiable:
            images, visible, num_nonfinite, _ = self.forward_kernel(call)
        else:
            results: Any = _Rasterize.apply(self, call, *floats, inputs.screen_shift, background)
            *images, visible, num_nonfinite = results
        return RasterOutputs(*images, visible=visible, num_nonfinite=num_nonfinite)  # type: ignore


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rasterizer, call, *floats):
        images, visible, num_nonfinite, state = rasterizer.forward_kernel(call)
        # Autograd saves the inputs, so that it notices changes in place before the backward.
        ctx.save_for_backward(*floats)
        ctx.rasterizer, ctx.state = rasterizer, state
        ctx.call = (call.camera, call.settings, call.target)  # The inputs would otherwise live as long as ctx.
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)  # The kernel skips gradients that are None.
        return *images, visible, num_nonfinite

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        *floats, _, background = ctx.saved_tensors
        camera, settings, target = ctx.call
        call = RenderCall(SurfelInputs(*floats), camera, settings, background, target, True)
        images = Images(*[None if g is None else g.contiguous() for g in gradients[:-2]])
        if all(g is None for g in images):
            return (None,) * 9
        return None, None, *ctx.rasterizer.backward_kernel(call, ctx.state, images, ctx.needs_input_grad[2:])
