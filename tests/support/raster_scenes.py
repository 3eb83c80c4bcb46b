"""Small scenes that every rasterizer is tested on; they cross tiles and blocks, with an off-centre principal point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs

FLOATS = ("means", "quats", "log_scales", "opacity_logits", "colors")
CLASSES = 4


@dataclass(frozen=True)
class Scene:
    """The arguments of ``Rasterizer.rasterize``."""

    inputs: SurfelInputs
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor

    def to(self, dtype: torch.dtype) -> Scene:
        """Return the same scene in another precision."""
        camera, background = self.camera.to(dtype), self.background.to(dtype)
        return replace(self, inputs=self.inputs.to(dtype), camera=camera, background=background)

    def draw(self, rasterizer, **changes):
        """Render, with some of the inputs replaced (``background`` among them)."""
        background = changes.pop("background", self.background)
        return rasterizer.rasterize(
            replace(self.inputs, **changes), self.camera, self.settings, background, self.target
        )


def make_scene(
    count: int = 40, width: int = 37, height: int = 29, seed: int = 0, opacity: float = 0.0, size: float = -1.4
) -> Scene:
    """Return random surfels in float64 in front of an odd-sized camera: three tiles by two."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    inputs = SurfelInputs(
        means=normal(count, 3) * torch.tensor([1.1, 0.8, 0.6], dtype=torch.float64) + torch.tensor([0.1, 0.0, 4.0]),
        quats=normal(count, 4),
        log_scales=size + 0.4 * normal(count, 2),
        opacity_logits=opacity + normal(count),
        colors=torch.rand(count, 3, generator=g, dtype=torch.float64),
        class_ids=torch.randint(0, CLASSES, (count,), generator=g, dtype=torch.int32),
    )
    angle = torch.tensor(0.2, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = torch.cos(angle)
    viewmat[0, 2], viewmat[2, 0] = torch.sin(angle), -torch.sin(angle)
    viewmat[:3, 3] = torch.tensor([-0.6, 0.05, 0.3])
    K = torch.tensor([[41.0, 0.0, 15.3], [0.0, 43.0, 16.2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    target = torch.randint(0, CLASSES, (height, width), generator=g, dtype=torch.int32)
    target[::5, ::3] = IGNORE
    return Scene(
        inputs,
        Camera(viewmat, K, width, height),
        RasterSettings(near=0.2, far=50.0, distortion=True),
        torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64),
        target,
    )


def opaque_layers() -> Scene:
    """Return many opaque surfels behind one another: compositing stops early."""
    return make_scene(count=150, seed=5, opacity=4.0, size=-0.9)


def awkward() -> Scene:
    """Return surfels edge-on, crossing the camera plane, beside and behind the camera, tiny and huge."""
    scene = make_scene(count=24, seed=7)
    means, quats, log_scales = (getattr(scene.inputs, name).clone() for name in ("means", "quats", "log_scales"))
    turned = torch.tensor([0.70710678, 0.0, 0.70710678, 0.0], dtype=torch.float64)
    quats[0] = turned  # nearly edge-on
    quats[1] = turned + 1e-6
    means[2], log_scales[2], quats[2] = torch.tensor([0.3, 0.2, 0.6]), torch.tensor([0.7, 0.7]), turned
    means[3] = torch.tensor([0.0, 0.0, -2.0])
    log_scales[4] = torch.tensor([-12.0, -12.0])
    log_scales[5] = torch.tensor([2.0, -6.0])
    return replace(scene, inputs=replace(scene.inputs, means=means, quats=quats, log_scales=log_scales))


def empty() -> Scene:
    """Return a scene without surfels."""
    scene = make_scene()
    floats = {name: getattr(scene.inputs, name)[:0] for name in FLOATS}
    return replace(scene, inputs=replace(scene.inputs, **floats, class_ids=scene.inputs.class_ids[:0]))


def facing(
    width: int, height: int, surfels: list[tuple[float, float, float, float]], dtype: torch.dtype = torch.float64
) -> tuple[SurfelInputs, Camera]:
    """Return surfels parallel to the image, the first in front: (centre x, centre y, sigma, opacity), in pixels.

    A negative sigma puts a surfel behind the camera.
    """
    rows, focal = torch.tensor(surfels, dtype=torch.float64), 100.0
    depths = (2.0 + 1e-3 * torch.arange(len(rows), dtype=torch.float64)) * rows[:, 2].sign()
    means = torch.stack([rows[:, 0] * depths / focal, rows[:, 1] * depths / focal, depths], dim=-1)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(len(rows), 1)
    log_scales = (rows[:, 2] * depths / focal).log()[:, None].repeat(1, 2)
    inputs = SurfelInputs(means, quats, log_scales, torch.logit(rows[:, 3]), torch.zeros_like(means)).to(dtype)
    K = torch.tensor([[focal, 0, 0], [0, focal, 0], [0, 0, 1]], dtype=dtype)
    return inputs, Camera(torch.eye(4, dtype=dtype), K, width, height)


SCENES = {"small": make_scene, "opaque": opaque_layers, "awkward": awkward, "empty": empty}
OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal", "distortion", "boundary")


def gradients_by_output(rasterizer, scene: Scene) -> dict[str, dict[str, Tensor]]:
    """Return for each output the gradients of a random combination of it towards float inputs and background."""
    leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
    leaves["background"] = scene.background.clone().requires_grad_()
    losses = _losses(scene.draw(rasterizer, **leaves))
    return {name: _gradients(loss, leaves) for name, loss in losses.items()}


def gradients(
    rasterizer, scene: Scene, only: tuple[str, ...] | None = None, wanted: tuple[str, ...] = (*FLOATS, "background")
) -> dict[str, Tensor]:
    """Return the gradients of all these combinations together (or of some outputs') towards ``wanted``."""
    values = {name: getattr(scene.inputs, name) for name in FLOATS} | {"background": scene.background}
    leaves = {name: values[name].clone().requires_grad_() for name in wanted}
    losses = _losses(scene.draw(rasterizer, **leaves))
    return _gradients(sum(loss for name, loss in losses.items() if only is None or name in only), leaves)


def _losses(render) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(1)
    losses = {}
    for name in OUTPUTS:
        if (image := getattr(render, name)) is None:
            continue
        weight = torch.randn(image.shape, generator=g, dtype=torch.float64).to(image)
        losses[name] = (image * weight).sum()
    return losses


def _gradients(loss: Tensor, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    if not loss.requires_grad:
        return {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, retain_graph=True)
    pairs = zip(leaves.items(), found, strict=True)
    return {name: torch.zeros_like(leaf) if value is None else value for (name, leaf), value in pairs}


def error(found: Tensor, expected: Tensor) -> float:
    """Return the largest difference, in units of the largest expected number (or of 1, if that is more)."""
    if expected.numel() == 0:
        return 0.0
    return ((found.double() - expected.double()).abs().max() / expected.double().abs().max().clamp_min(1.0)).item()


def poisoned(scene: Scene) -> Scene:
    """Return the scene with as many surfels again that do not show: too faint, but for seven that are broken."""
    n = len(scene.inputs.means)
    bad = {name: torch.cat([getattr(scene.inputs, name)] * 2) for name in FLOATS}
    bad["opacity_logits"][n:] = -1e30
    for i, (name, poison) in enumerate(
        zip(FLOATS, (torch.nan, torch.inf, -torch.inf, torch.nan, torch.inf), strict=True)
    ):
        bad[name][n + i] = poison
    bad["quats"][n + 5] = 0
    bad["log_scales"][n + 6] = 1e4
    bad["opacity_logits"][n : n + 7] += 1e30
    return replace(scene, inputs=SurfelInputs(**bad, class_ids=torch.cat([scene.inputs.class_ids] * 2)))
