"""The compiled CPU rasterizer: it checks and allocates here, and computes in ``beags_plugin._native``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beags_plugin.core.cameras import Camera
from beags_plugin.ops import extension
from beags_plugin.rasterizers.autograd import (
    Forward,
    Images,
    InputGradients,
    KernelRasterizer,
    RenderCall,
    check_image,
)
from beags_plugin.rasterizers.interface import FLOATS, RasterSettings, SurfelInputs, map_ids
from beags_plugin.rasterizers.optional import OptionalProducts
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class WorkCounts:
    """Work of one forward, which unlike its time has no noise.

    lanes: pixel lanes that the kernels evaluate. contributing: (pixel, Gaussian) pairs among them that contribute.
    tile_pairs: (tile, Gaussian) pairs of the kernels' bounds. box_pairs: those of the usual bounds, boxes of 3.33
        standard deviations.
    """

    lanes: int
    contributing: int
    tile_pairs: int
    box_pairs: int


def instruction_set() -> str:
    """Return the instruction set in use, which BEAGS_ISA may force; raises ``UserError`` if that one cannot run."""
    return _module().instruction_set()


def instruction_sets() -> list[str]:
    """Return the instruction sets that this build and processor have, best first; "scalar", a reference, is last."""
    return _module().instruction_sets()


@torch.no_grad()
def work_counts(inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> WorkCounts:
    """Count the work of a render; the arguments are as of ``Rasterizer.rasterize``."""
    frame, _ = _frame(inputs.checked().detached(), camera, settings)
    return WorkCounts(*frame.work_counts(extension.threads()))


def _module() -> ModuleType:
    module, reason = extension.status()
    if module is None:
        raise UserError(f"the rasterizer 'native' cannot run here: {reason}")
    return module


class NativeRasterizer(KernelRasterizer, OptionalProducts):
    """Float32 and float64 on the CPU, on ``torch.get_num_threads()`` threads; the same bits for any number of them."""

    @classmethod
    def unavailable(cls) -> str | None:
        return extension.status()[1]

    def forward_kernel(self, call: RenderCall) -> Forward:
        frame, visible = _frame(call.inputs, call.camera, call.settings)
        images = call.empty_images()
        frame.forward(call.background, call.target, *images, call.differentiable, extension.threads())
        return Forward(images, visible, frame.num_nonfinite, frame)

    def backward_kernel(
        self, call: RenderCall, state: Any, gradients: Images, needed: Sequence[bool]
    ) -> InputGradients:
        """See ``KernelRasterizer.backward_kernel``.

        Gradients of ``colors`` and ``background`` alone cost less; with ``opacity_logits`` they still skip the backward
        of the projection.
        """
        floats = [getattr(call.inputs, name) for name in FLOATS]
        shift = call.inputs.means[:, :2]
        likes = zip((*floats, shift, call.background), needed, strict=True)
        # new_empty suffices: the kernel writes zeros for the Gaussians that no pixel shows.
        results = InputGradients(*[value.new_empty(value.shape) if wanted else None for value, wanted in likes])
        state.backward(*floats, call.target, *gradients, *results, extension.threads())
        return results

    @torch.no_grad()
    def class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> Tensor:
        inputs = inputs.checked().detached()
        labels = check_image("labels", labels, camera)
        frame, _ = _frame(inputs, camera, settings)
        out = inputs.means.new_zeros(len(inputs.means), num_classes)
        frame.class_contributions(labels, num_classes, out, extension.threads())
        return out

    def sparse_class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        return _sparse("sparse_class_contributions", inputs, camera, settings, labels, num_classes)

    def sparse_class_pixel_counts(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        min_weight: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """See ``OptionalProducts.sparse_class_pixel_counts``; in float32, counts are exact up to 2^24."""
        what = (inputs, camera, settings, labels, num_classes, min_weight)
        keys, counts = _sparse("sparse_class_pixel_counts", *what)
        return keys, counts.int()

    def sparse_top_contributions(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        most: int,
        within: int,
    ) -> tuple[Tensor, Tensor]:
        return _sparse("sparse_top_contributions", inputs, camera, settings, labels, num_classes, most, within)

    @torch.no_grad()
    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        inputs = inputs.checked().detached()
        map_ids(inputs, num_classes)
        frame, _ = _frame(inputs, camera, settings)
        classes = torch.empty(camera.height, camera.width, dtype=torch.int32)
        share = inputs.means.new_empty(camera.height, camera.width)
        frame.class_map(num_classes, classes, share, extension.threads())
        return classes, share

    def class_channels(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> Tensor:
        inputs = inputs.checked()
        map_ids(inputs, num_classes)
        return _channels(inputs, camera, settings, num_classes, None)

    def feature_channels(
        self, inputs: SurfelInputs, features: Tensor, camera: Camera, settings: RasterSettings
    ) -> Tensor | None:
        inputs, count = inputs.checked(), features.shape[1]
        if count <= 3:  # They cost less as the colours of an image.
            return None
        padded = torch.nn.functional.pad(features, (0, -count % 4)).contiguous()
        return _channels(inputs, camera, settings, 0, padded)[..., :count]

    @torch.no_grad()
    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        frame, _ = _frame(inputs.checked().detached(), camera, settings)
        indices = torch.empty(camera.height, camera.width, dtype=torch.int32)
        frame.dominant_gaussian(indices, extension.threads())
        return indices


def _channels(
    inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int, features: Tensor | None
) -> Tensor:
    floats = [getattr(inputs, name) for name in FLOATS]
    what = (inputs.detached(), camera, settings, num_classes, features)
    return _Channels.apply(*what, *floats, inputs.screen_shift)  # type: ignore[return-value]


class _Channels(torch.autograd.Function):
    """Channels of features or, if these are None, of classes."""

    @staticmethod
    def forward(ctx, inputs, camera, settings, num_classes, features, *floats):
        frame, _ = _frame(inputs, camera, settings)
        count = num_classes if features is None else features.shape[1]
        channels = inputs.means.new_zeros(camera.height, camera.width, count)
        call = (channels, any(ctx.needs_input_grad), extension.threads())
        if features is None:
            frame.class_channels(num_classes, *call)
        else:
            frame.feature_channels(features, *call)
        ctx.save_for_backward(features, *floats)
        ctx.frame = frame
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        features, *floats, _ = ctx.saved_tensors
        means, quats, log_scales, opacity_logits, _ = floats
        wants_features, *geometry, _, shift = ctx.needs_input_grad[4:]
        values = (means, quats, log_scales, opacity_logits, means[:, :2], features)
        likes = zip(values, (*geometry, shift, wants_features), strict=True)
        *results, to_features = [value.new_empty(value.shape) if wanted else None for value, wanted in likes]
        if features is None:
            ctx.frame.class_channels_backward(*floats, gradient.contiguous(), *results, extension.threads())
        else:
            of_features = (features, gradient.contiguous(), *results, to_features)
            ctx.frame.feature_channels_backward(*floats, *of_features, extension.threads())
        return None, None, None, None, to_features, *results[:4], None, results[4]


@torch.no_grad()
def _sparse(
    name: str, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, *numbers: float
) -> tuple[Tensor, Tensor]:
    """Return the keys and values that the method ``name`` of the compiled frame lists for ``labels``."""
    inputs = inputs.checked().detached()
    labels = check_image("labels", labels, camera)
    frame, _ = _frame(inputs, camera, settings)
    listed = getattr(frame, name)(labels, *numbers, extension.threads())
    keys, values = torch.empty(listed.count, dtype=torch.int64), inputs.means.new_empty(listed.count)
    listed.write(keys, values)
    return keys, values


def _frame(inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> tuple[Any, Tensor]:
    """Return the compiled module's frame (surfels projected and sorted into tiles), and visible [N] bool."""
    module = _module()
    if inputs.means.device.type != "cpu":
        raise ValueError(f"the native rasterizer takes CPU tensors, not {inputs.means.device}")
    make = module.FrameF32 if inputs.means.dtype == torch.float32 else module.FrameF64
    matrices = (camera.viewmat.tolist(), camera.K.tolist())
    visible = torch.empty(inputs.means.shape[0], dtype=torch.bool)
    floats = [getattr(inputs, name) for name in FLOATS]
    size = (camera.width, camera.height)
    frame = make(*floats, inputs.class_ids, *matrices, *size, settings.near, settings.far, visible, extension.threads())
    return frame, visible
