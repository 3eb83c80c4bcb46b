"""Scenes for measurements: seeded clouds of surfels of a given width on the screen, in front of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
from beags_plugin.rasterizers.reference_geometry import project
from beags_plugin.system.errors import UserError

OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal", "distortion", "boundary")
CLASSES = 4  # 0, the background, and three objects
SLANT = 0.3  # slant of the borders between classes: image widths per image height
NEAREST, FARTHEST = 2.0, 6.0  # depth range of the centres, world units
SIGMA_PER_RADIUS = 0.468  # standard deviation over half the screen box, measured at these opacities and slants
MARGIN = 0.03  # share of the image's size by which the cloud exceeds its border, so that borders are covered


@dataclass(frozen=True)
class Size:
    """A case: n surfels on width x height pixels, their screen boxes ``diameter`` pixels wide at the median."""

    n: int
    width: int
    height: int
    diameter: float = 17.0

    @property
    def name(self) -> str:
        """Return the name on the command line: 50k/640x480."""
        count = f"{self.n // 1000}k" if self.n % 1000 == 0 else str(self.n)
        return f"{count}/{self.width}x{self.height}"


# 50k surfels of 17 pixels give every pixel about 45 contributing layers. The smaller sizes keep the width and have
# fewer layers (36 and 20); 200k keeps the layers, as a finer model of the same view would, with surfels half as wide.
SIZES = (Size(1_000, 128, 96), Size(10_000, 320, 240), Size(50_000, 640, 480), Size(200_000, 640, 480, 8.5))


def parse_size(text: str) -> Size:
    """Parse ``1k``, ``50k`` or another of ``SIZES``, or N/WIDTHxHEIGHT; raises ``UserError`` for anything else."""
    for size in SIZES:
        if text in (size.name, size.name.split("/")[0]):
            return size
    try:
        count, _, image = text.partition("/")
        width, height = image.split("x")
        n = int(count[:-1]) * 1000 if count.endswith("k") else int(count)
        size = Size(n, int(width), int(height))
    except ValueError:
        size = None
    if size is None or min(size.n, size.width, size.height) < 1:
        known = ", ".join(known.name for known in SIZES)
        raise UserError(f"there is no size {text!r}: choose of {known}, or write N/WIDTHxHEIGHT.")
    return size


@dataclass(frozen=True)
class Scene:
    """A scene to render, all float32.

    surfels: N, with spherical harmonics of degree 3. class_ids: [N] int32. colors: [N, 3].
    target: [H, W] int32, a class map of the same classes. image: [H, W, 3], a picture to compare with.
    gradients: one random image for each float output of ``RasterOutputs``, by name, from which the backward starts.
    """

    size: Size
    surfels: Surfels
    class_ids: Tensor
    colors: Tensor
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor
    image: Tensor
    gradients: dict[str, Tensor]


def make_scene(size: Size, seed: int = 0) -> Scene:
    """Return surfels of random position, slant and opacity, determined by size and seed."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g)

    n, width, height = size.n, size.width, size.height
    focal = 0.9 * width
    # Positions are uniform over the image and its depth, so that every pixel has about the same number of layers.
    across = uniform(n, low=-MARGIN, high=1 + MARGIN) * width
    down = uniform(n, low=-MARGIN, high=1 + MARGIN) * height
    depth = uniform(n, low=NEAREST, high=FARTHEST)
    means = torch.stack([(across - width / 2) * depth / focal, (down - height / 2) * depth / focal, depth], dim=-1)
    sigma = size.diameter / 2 * SIGMA_PER_RADIUS * depth / focal
    sizes = 0.45 * torch.randn(n, 1, generator=g)  # a few surfels are large, as in trained scenes
    log_scales = sigma.log()[:, None] + sizes + 0.25 * torch.randn(n, 2, generator=g)
    camera = Camera(
        torch.eye(4), torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]), width, height
    )
    stripes = uniform(n, 16, 3, low=-0.15, high=0.15)
    surfels = Surfels(
        means=means,
        quats=torch.randn(n, 4, generator=g),
        log_scales=log_scales,
        opacity_logits=-1.6 + 0.8 * torch.randn(n, generator=g),
        sh_dc=uniform(n, 3, low=-1.5, high=1.5),
        sh_rest=stripes[:, 1:].contiguous(),
    )
    shape = (height, width)
    gradients = {
        name: torch.randn(*shape, *((3,) if name in ("color", "normal") else ()), generator=g) for name in OUTPUTS
    }
    return Scene(
        size=size,
        surfels=surfels,
        class_ids=classes_at(across / width, down / height),
        colors=uniform(n, 3),
        camera=camera,
        settings=RasterSettings(near=0.05, far=100.0, geometry=True, distortion=True),
        background=torch.tensor([0.1, 0.2, 0.3]),
        target=classes_at(torch.linspace(0, 1, width), torch.linspace(0, 1, height)[:, None]),
        image=uniform(*shape, 3),
        gradients=gradients,
    )


def on_device(scene: Scene, device: str) -> Scene:
    """Return the scene on another device."""
    values = {name: value.to(device) for name, value in vars(scene).items() if isinstance(value, Tensor | Camera)}
    surfels = Surfels(**{name: value.to(device) for name, value in vars(scene.surfels).items()})
    gradients = {name: value.to(device) for name, value in scene.gradients.items()}
    return replace(scene, surfels=surfels, gradients=gradients, **values)


def classes_at(across: Tensor, down: Tensor) -> Tensor:
    """Return int32 classes in slanted bands across tiles. across, down: 0 is left and top, 1 right and bottom."""
    return ((across + SLANT * down) / (1 + SLANT) * 2 * CLASSES).clamp(0, 2 * CLASSES - 1).int() % CLASSES


def surfel_inputs(scene: Scene) -> SurfelInputs:
    """Return the inputs of the rasterizer, without gradients."""
    s = scene.surfels
    return SurfelInputs(s.means, s.quats, s.log_scales, s.opacity_logits, scene.colors, scene.class_ids)


def median_width(scene: Scene) -> float:
    """Return the median width in pixels of the surfels' screen boxes, where alpha can reach 1/255."""
    box = project(surfel_inputs(scene), scene.camera, scene.settings).box
    return float((box[:, 2] - box[:, 0]).median())
