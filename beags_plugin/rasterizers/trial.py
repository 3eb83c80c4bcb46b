"""Render a small scene forward and backward by a backend and by the torch reference, and compare the results.

``python -m beags_plugin.rasterizers.trial MODULE:CLASS DEVICE [DEVICE ...]`` prints as its last line, in JSON, a
sentence on the first difference, or "" if there is none. ``first_contact`` runs it in a process of its own, which may
crash or hang.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import FLOATS, Rasterizer, RasterSettings, SurfelInputs
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.registry import load

COUNT, WIDTH, HEIGHT, CLASSES = 300, 53, 39, 3  # several tiles; those at the right and the bottom are cut
_IMAGES = ("color", "alpha", "depth", "median_depth", "normal", "distortion", "boundary")
_EXACT = 1e-6  # float64, relative to the largest value: exp and sums of a GPU differ from the CPU's in the last digits
_ROUNDED = 1e-3  # float32 images, relative to the largest value
_ROUNDED_GRADIENT = 1e-2  # float32 gradients, relative to the gradient's length
_CARRIED = 0.01  # share of float32 pixels that rounding may move across a threshold (1/255, the median, a tie)


@dataclass(frozen=True)
class Trial:
    """The arguments of ``Rasterizer.rasterize``, on the CPU, and weights [H, W, 3] of the loss."""

    inputs: SurfelInputs
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor
    weights: Tensor


def trial_scene(dtype: torch.dtype) -> Trial:
    """Return random discs of any slant between depths 2 and 6, the same in every process."""
    random = torch.Generator().manual_seed(7)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    inputs = SurfelInputs(
        means=(uniform(COUNT, 3) - 0.5) * torch.tensor([4.0, 3.0, 4.0], dtype=torch.float64)
        + torch.tensor([0, 0, 4.0]),
        quats=normal(COUNT, 4),
        log_scales=-1.8 + 0.4 * normal(COUNT, 2),
        opacity_logits=normal(COUNT),
        colors=uniform(COUNT, 3),
        class_ids=torch.randint(0, CLASSES, (COUNT,), generator=random, dtype=torch.int32),
    )
    K = torch.tensor([[50.0, 0.0, 25.3], [0.0, 51.0, 20.1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    target = torch.randint(0, CLASSES, (HEIGHT, WIDTH), generator=random, dtype=torch.int32)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, WIDTH, HEIGHT)
    background, weights = uniform(3), normal(HEIGHT, WIDTH, 3)
    settings = RasterSettings(0.2, 20.0, distortion=True)
    return Trial(inputs.to(dtype), camera.to(dtype), settings, background.to(dtype), target, weights.to(dtype))


def rendered(rasterizer: Rasterizer, trial: Trial, device: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return all images, and the gradients of a loss over them with respect to the inputs, by name, on the CPU."""
    leaves = {name: getattr(trial.inputs, name).to(device).requires_grad_() for name in FLOATS}
    assert trial.inputs.class_ids is not None
    inputs = replace(trial.inputs, **leaves, class_ids=trial.inputs.class_ids.to(device))
    background, target = trial.background.to(device), trial.target.to(device)
    render = rasterizer.rasterize(inputs, trial.camera.to(device), trial.settings, background, target)
    images = {name: getattr(render, name) for name in _IMAGES}
    weights, loss = trial.weights.to(device), render.color.new_zeros(())
    for image in images.values():
        loss = loss + (image * (weights if image.dim() == 3 else weights[..., 0])).sum()
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    return (
        {name: image.detach().cpu() for name, image in images.items()},
        {name: value.cpu() for name, value in zip(leaves, gradients, strict=True)},
    )


def difference(rasterizer: Rasterizer, device: str) -> str:
    """Return which result of a backend differs from the torch reference's on the CPU; "" if none does.

    float64 must agree in every value, float32 within its bands; both are compared with the reference in float64.
    """
    expected = rendered(TorchRasterizer(), trial_scene(torch.float64), "cpu")
    for dtype, dtype_name in ((torch.float64, "float64"), (torch.float32, "float32")):
        results = rendered(rasterizer, trial_scene(dtype), device)
        for what, values, references in zip(("image", "gradient"), results, expected, strict=True):
            for name, reference in references.items():
                if not _alike(values[name].double(), reference, dtype, what):
                    return f"the {what} {name} differs from the torch reference's in {dtype_name}"
    return ""


def _alike(values: Tensor, expected: Tensor, dtype: torch.dtype, what: str) -> bool:
    if values.shape != expected.shape or not bool(values.isfinite().all()):
        return False
    errors, largest = (values - expected).abs(), float(expected.abs().max())
    if dtype == torch.float64:
        return float(errors.max()) <= _EXACT * largest
    if what == "gradient":
        return float(errors.norm()) <= _ROUNDED_GRADIENT * float(expected.norm())
    return float((errors > _ROUNDED * largest).double().mean()) <= _CARRIED


if __name__ == "__main__":
    backend = load(sys.argv[1])()
    print(json.dumps(next(filter(None, (difference(backend, device) for device in sys.argv[2:])), "")))
