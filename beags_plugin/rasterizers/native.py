"""The compiled CPU rasterizer: checks and allocates here, computes in ``beags_plugin._native``."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.ops import extension
from beags_plugin.rasterizers.autograd import (
    Drawing,
    Forward,
    Images,
    InputGradients,
    KernelRasterizer,
    Needed,
    check_image,
)
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs, map_ids
from beags_plugin.system.errors import UserError

_FLOATS = ("means", "quats", "log_scales", "opacity_logits", "colors")


@dataclass(frozen=True)
class WorkCounts:
    """How much one forward has to do: noise-free companions of its time.

    lanes: pixel lanes that the kernels evaluate. contributing: (pixel, surfel) pairs among them that contribute.
    tile_pairs: (tile, surfel) pairs that are kept. box_pairs: those that the usual bounds would give, boxes of 3.33
        standard deviations.
    """

    lanes: int
    contributing: int
    tile_pairs: int
    box_pairs: int


def instruction_set() -> str:
    """The instruction set in use; BEAGS_ISA in the environment forces one. Raises ``UserError`` if it cannot run."""
    return _module().instruction_set()


def instruction_sets() -> list[str]:
    """Those that this build holds and this processor runs, best first; "scalar", to measure against, comes last."""
    return _module().instruction_sets()


@torch.no_grad()
def work_counts(inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> WorkCounts:
    """What drawing these surfels takes; see ``Rasterizer.rasterize`` for the arguments."""
    frame, _ = _frame(_detached(inputs.checked()), camera, settings)
    return WorkCounts(*frame.work_counts(extension.threads()))


def _module() -> ModuleType:
    module, reason = extension.status()
    if module is None:
        raise UserError(f"the rasterizer 'native' cannot run here: {reason}")
    return module


class NativeRasterizer(KernelRasterizer):
    """Float32 and float64 on the CPU, on ``torch.get_num_threads()`` threads; the same bits for any number of them."""

    @classmethod
    def unavailable(cls) -> str | None:
        """See ``Rasterizer.unavailable``."""
        return extension.status()[1]

    def forward_kernel(self, drawing: Drawing) -> Forward:
        """See ``KernelRasterizer.forward_kernel``."""
        inputs, camera, settings = drawing.inputs, drawing.camera, drawing.settings
        frame, visible = _frame(inputs, camera, settings)

        def image(wanted: bool, *channels: int) -> Tensor | None:
            return inputs.means.new_empty(camera.height, camera.width, *channels) if wanted else None

        geometry = settings.geometry
        images = Images(
            color=image(True, 3),
            alpha=image(True),
            depth=image(geometry),
            median_depth=image(geometry),
            normal=image(geometry, 3),
            distortion=image(settings.distortion),
            boundary=image(drawing.target is not None),
        )
        frame.forward(drawing.background, drawing.target, *images, drawing.differentiable, extension.threads())
        return Forward(images, visible, frame.num_nonfinite, frame)

    def backward_kernel(self, drawing: Drawing, state: Any, gradients: Images, needed: Needed) -> InputGradients:
        """See ``KernelRasterizer.backward_kernel``.

        Only what is needed is allocated and returned. The tiles do less where nothing but ``colors`` and ``background``
        is needed; for any other field they add up the sums of all fields, and what then saves work is to need none of
        ``means``, ``quats``, ``log_scales`` and ``screen_shift``, as the way back through the projection is skipped.
        """
        floats = [getattr(drawing.inputs, name) for name in _FLOATS]
        shift = drawing.inputs.means[:, :2]
        likes = zip((*floats, shift, drawing.background), needed, strict=True)
        # not torch.zeros: the kernel writes the zeros of the surfels that are not seen
        found = InputGradients(*[value.new_empty(value.shape) if wanted else None for value, wanted in likes])
        state.backward(*floats, drawing.target, *gradients, *found, extension.threads())
        return found

    @torch.no_grad()
    def class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> Tensor:
        """See ``Rasterizer.class_contributions``."""
        inputs = _detached(inputs.checked())
        labels = check_image("labels", labels, camera)
        frame, _ = _frame(inputs, camera, settings)
        out = inputs.means.new_zeros(inputs.means.shape[0], num_classes)
        frame.class_contributions(labels, num_classes, out, extension.threads())
        return out

    @torch.no_grad()
    def sparse_class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """See ``Rasterizer.sparse_class_contributions``."""
        inputs = _detached(inputs.checked())
        labels = check_image("labels", labels, camera)
        frame, _ = _frame(inputs, camera, settings)
        found = frame.sparse_class_contributions(labels, num_classes, extension.threads())
        keys = torch.empty(found.count, dtype=torch.int64)
        values = inputs.means.new_empty(found.count)
        found.write(keys, values)
        return keys, values

    @torch.no_grad()
    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """See ``Rasterizer.class_map``."""
        inputs = _detached(inputs.checked())
        map_ids(inputs, num_classes)
        frame, _ = _frame(inputs, camera, settings)
        classes = torch.empty(camera.height, camera.width, dtype=torch.int32)
        share = inputs.means.new_empty(camera.height, camera.width)
        frame.class_map(num_classes, classes, share, extension.threads())
        return classes, share

    @torch.no_grad()
    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        """See ``Rasterizer.dominant_gaussian``."""
        frame, _ = _frame(_detached(inputs.checked()), camera, settings)
        indices = torch.empty(camera.height, camera.width, dtype=torch.int32)
        frame.dominant_gaussian(indices, extension.threads())
        return indices


def _detached(inputs: SurfelInputs) -> SurfelInputs:
    return SurfelInputs(*(getattr(inputs, name).detach() for name in _FLOATS), class_ids=inputs.class_ids)


def _frame(inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> tuple[Any, Tensor]:
    """The compiled module's frame (surfels projected and sorted into tiles), and visible [N] bool."""
    module = _module()
    if inputs.means.device.type != "cpu":
        raise ValueError(f"the native rasterizer takes CPU tensors, not {inputs.means.device}")
    make = module.FrameF32 if inputs.means.dtype == torch.float32 else module.FrameF64
    matrices = (camera.viewmat.tolist(), camera.K.tolist())
    visible = torch.empty(inputs.means.shape[0], dtype=torch.bool)
    floats = [getattr(inputs, name) for name in _FLOATS]
    size = (camera.width, camera.height)
    frame = make(*floats, inputs.class_ids, *matrices, *size, settings.near, settings.far, visible, extension.threads())
    return frame, visible
