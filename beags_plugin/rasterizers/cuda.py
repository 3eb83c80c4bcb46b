"""The CUDA rasterizer: it checks and allocates here, and computes in ``beags_plugin._native.cuda``.

All memory is torch's, all kernels run on torch's current stream. Only the GPU knows the number of pairs (a tile and a
Gaussian that reaches it), so their memory is guessed from earlier renders, and all kernels of a render are launched on
that guess. Then the host waits for the number, which the GPU has long before the image, and launches the last kernels
again in the rare case that the guess was too small. The GPU never waits for the host.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.ops import cuda_extension
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
from beags_plugin.rasterizers.pair_counts import PairCounts, capacity_for, start_copy
from beags_plugin.rasterizers.rendering import class_channels_by_threes
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError

_GEOMETRY, _DISTORTION, _BOUNDARY = 1, 2, 4  # Parts of native/rasterizer/types.h
_TILE = 16


@dataclass
class _Frame:
    """Gaussians projected and sorted into tiles.

    native: the compiled module's frame, which points into ``owned`` (per Gaussian) and ``pairs`` (per pair).
    saved: images that the forward saves for the backward.
    """

    native: Any
    visible: Tensor
    owned: list[Tensor]
    pairs: list[Tensor] = field(default_factory=list)
    num_nonfinite: int = 0
    saved: tuple[Tensor | None, ...] = ()


class CudaRasterizer(KernelRasterizer, OptionalProducts):
    """Float32 and float64 on one GPU; the same bits in every run (there are no atomic additions of floats)."""

    def __init__(self) -> None:
        self._module: ModuleType | None = None
        self._counts = PairCounts()

    @classmethod
    def unavailable(cls) -> str | None:
        return cuda_extension.status()[1]

    def pairs(self) -> int:
        """Return the number of pairs of the largest recent render on any GPU; 0 before the first."""
        return self._counts.largest()

    def forward_kernel(self, call: RenderCall) -> Forward:
        like, images = call.inputs.means, call.empty_images()
        geometry = call.differentiable and call.settings.geometry
        saved = (
            call.empty_image(call.differentiable),
            call.empty_image(call.differentiable, dtype=torch.int32),
            call.empty_image(geometry),
            call.empty_image(geometry, dtype=torch.int32),
            *(call.empty_image(call.differentiable and call.settings.distortion) for _ in range(3)),
        )

        def render(frame: _Frame) -> None:
            frame.native.forward(call.background, call.target, *images, *saved, self._stream(like))

        frame = self._frame(call.inputs, call.camera, call.settings, render)
        frame.saved = saved
        return Forward(images, frame.visible, frame.num_nonfinite, frame)

    def backward_kernel(
        self, call: RenderCall, state: Any, gradients: Images, needed: Sequence[bool]
    ) -> InputGradients:
        floats = [getattr(call.inputs, name) for name in FLOATS]
        like, n = call.inputs.means, len(call.inputs.means)
        *of_inputs, of_background = needed
        shapes = [*(value.shape for value in floats), (n, 2)]  # The last is that of screen_shift.
        results = [like.new_empty(shape) if wanted else None for shape, wanted in zip(shapes, of_inputs, strict=True)]
        parts = _GEOMETRY * any(g is not None for g in (gradients.depth, gradients.median_depth, gradients.normal))
        parts |= _DISTORTION * (gradients.distortion is not None) | _BOUNDARY * (gradients.boundary is not None)
        frame: _Frame = state
        capacity = len(frame.pairs[0])
        records = like.new_empty(capacity * frame.native.record_size(parts))
        sums = torch.empty(n, 20, dtype=torch.float64, device=like.device)
        per_tile = like.new_empty(_tiles(call.camera), 3)
        with cuda_extension.on_device(like.device):
            frame.native.backward(
                *floats, call.background, call.target, *gradients, *frame.saved, *results, per_tile, records, sums,
                parts, self._stream(like),
            )  # fmt: skip
        background = per_tile.sum(0, dtype=torch.float64).to(like.dtype) if of_background else None
        return InputGradients(*results, background)  # type: ignore[call-arg]

    @torch.no_grad()
    def class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> Tensor:
        inputs = inputs.checked().detached()
        labels = check_image("labels", labels, camera)
        like = inputs.means
        sums = torch.zeros(len(like), num_classes, dtype=torch.int64, device=like.device)

        def render(frame: _Frame) -> None:
            sums.zero_()
            frame.native.class_contributions(labels, num_classes, sums, self._stream(like))

        self._frame(inputs, camera, settings, render)
        return (sums.double() * self._native().WEIGHT_UNIT).to(like.dtype)

    def sparse_class_pixel_counts(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        min_weight: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """See ``OptionalProducts.sparse_class_pixel_counts``; the torch reference runs on the GPU."""
        labels = check_image("labels", labels, camera)
        return TorchRasterizer().sparse_class_pixel_counts(inputs, camera, settings, labels, num_classes, min_weight)

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
        """See ``OptionalProducts.sparse_top_contributions``; the torch reference runs on the GPU."""
        labels = check_image("labels", labels, camera)
        what = (inputs, camera, settings, labels, num_classes, most, within)
        return TorchRasterizer().sparse_top_contributions(*what)

    @torch.no_grad()
    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        inputs = inputs.checked().detached()
        map_ids(inputs, min(num_classes, IGNORE))
        like = inputs.means
        classes = torch.empty(camera.height, camera.width, dtype=torch.int32, device=like.device)
        share = like.new_empty(camera.height, camera.width)

        def render(frame: _Frame) -> None:
            frame.native.class_map(min(num_classes, IGNORE), classes, share, self._stream(like))

        self._frame(inputs, camera, settings, render)
        return classes, share

    def class_channels(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> Tensor:
        """See ``OptionalProducts.class_channels``; there is no kernel: three classes are rendered at a time."""
        return class_channels_by_threes(self, inputs, camera, settings, num_classes)

    @torch.no_grad()
    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        inputs = inputs.checked().detached()
        indices = torch.empty(camera.height, camera.width, dtype=torch.int32, device=inputs.means.device)
        stream = self._stream(inputs.means)
        self._frame(inputs, camera, settings, lambda frame: frame.native.dominant_gaussian(indices, stream))
        return indices

    def _native(self) -> ModuleType:
        if self._module is None:
            module, reason = cuda_extension.status()
            if module is None:
                raise UserError(f"the rasterizer 'cuda' cannot run here: {reason}")
            self._module = module
        return self._module

    @staticmethod
    def _stream(like: Tensor) -> int:
        return cuda_extension.stream(like.device)

    def _frame(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, render: Callable[[_Frame], None]
    ) -> _Frame:
        """Project, sort into tiles and render with ``render(frame)``, which may be called twice."""
        module, means = self._native(), inputs.means
        device, n = means.device, len(means)
        if device.type != ("cpu" if module.EMULATED else "cuda"):
            raise ValueError(f"the CUDA rasterizer takes tensors on a GPU, not on {device}")
        if _tiles(camera) > module.MOST_TILES:
            raise UserError(
                f"an image of {camera.width} x {camera.height} pixels is too large for the CUDA rasterizer, which "
                "renders 16 million pixels at most: use smaller images."
            )
        with cuda_extension.on_device(device):
            frame, totals = self._project(module, inputs, camera, settings)
            counts, place = self._counts, self._counts.place(device)
            wait = start_copy(totals)  # The numbers of pairs and of Gaussians that are not finite.
            guess = counts.guess(place)
            if guess is None:
                first, _ = wait()
                counts.learn(place, first)
                guess = float(first)
            capacity = self._bin(frame, camera, guess, n)
            render(frame)
            pairs, frame.num_nonfinite = wait()
            counts.learn(place, pairs)
            if pairs > capacity:
                self._bin(frame, camera, float(pairs), n)
                render(frame)
        return frame

    def _project(
        self, module: ModuleType, inputs: SurfelInputs, camera: Camera, settings: RasterSettings
    ) -> tuple[_Frame, Tensor]:
        means, n = inputs.means, len(inputs.means)
        make = module.FrameF32 if means.dtype == torch.float32 else module.FrameF64

        def memory(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return torch.empty(*shape, dtype=dtype, device=means.device)

        visible = memory(n, dtype=torch.bool)
        splats = memory(n * make.splat_bytes, dtype=torch.uint8)
        counts, order = memory(n), memory(n)
        pair_start, totals = memory(n + 1, dtype=torch.int64), memory(2, dtype=torch.int64)
        owned = [visible, splats, counts, order, pair_start, totals]
        floats = [getattr(inputs, name) for name in FLOATS]
        matrices = (camera.host.viewmat.tolist(), camera.host.K.tolist())
        native = make(
            *floats, inputs.class_ids, *matrices, camera.width, camera.height, settings.near, settings.far, *owned
        )
        low = memory(n) if means.dtype == torch.float64 else None
        temporary = memory(module.temporary_bytes(n + 1), dtype=torch.uint8)
        native.project(temporary, memory(n), memory(n), low, memory(n), self._stream(means))
        return _Frame(native, visible, owned), totals

    def _bin(self, frame: _Frame, camera: Camera, pairs: float, n: int) -> int:
        """Sort the pairs into tiles; return the number of pairs that the memory holds."""
        capacity = capacity_for(pairs)
        if capacity > 2**31 - 1 or n > 2**31 - 1:
            raise UserError("over 1.7 billion pairs of a tile and a surfel: render fewer surfels or smaller images.")
        device, module = frame.visible.device, self._native()

        def memory(count: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return torch.empty(count, dtype=dtype, device=device)

        lasting = [memory(capacity) for _ in range(3)] + [memory(_tiles(camera) + 1)]
        temporary = memory(module.temporary_bytes(capacity), torch.uint8)
        frame.native.bin(*lasting, temporary, memory(capacity), memory(capacity), cuda_extension.stream(device))
        frame.pairs = lasting
        return capacity


def _tiles(camera: Camera) -> int:
    return -(-camera.width // _TILE) * -(-camera.height // _TILE)
