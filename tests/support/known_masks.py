"""Scenes of opaque squares, rendered by a stand-in rasterizer, whose masks are known."""

from __future__ import annotations

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings

SIZE = 24
SETTINGS = RasterSettings(near=0.1, far=100.0)
CLASSES = {0: "background", 1: "cup", 2: "box"}


class Squares(Rasterizer):
    """A surfel is an opaque square: centre (x, y) pixels, half side z, depth 1 + log scale; earlier ones in front."""

    @classmethod
    def unavailable(cls) -> str | None:
        return None

    def rasterize(self, inputs, camera, settings, background, target=None) -> RasterOutputs:
        ys, xs = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        color, free = torch.zeros(camera.height, camera.width, 3), torch.ones(camera.height, camera.width)
        depth = torch.zeros_like(free)
        depths = 1.0 + inputs.log_scales[:, 0]
        for (x, y, half), rgb, far in zip(inputs.means.tolist(), inputs.colors, depths, strict=True):
            inside = ((xs - x).abs() < half) & ((ys - y).abs() < half)
            weight = free * inside
            color, depth, free = color + weight[..., None] * rgb, depth + weight * far, free - weight
        color = color + free[..., None] * background
        return RasterOutputs(color, 1 - free, depth, depth, None, None, None, torch.ones(len(inputs.means)) > 0, 0)

    def class_contributions(self, inputs, camera, settings, labels, num_classes):
        raise NotImplementedError

    def class_map(self, inputs, camera, settings, num_classes):
        raise NotImplementedError

    def dominant_gaussian(self, inputs, camera, settings):
        raise NotImplementedError


def camera(shift: float = 0.0) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = shift
    K = torch.tensor([[20.0, 0, SIZE / 2], [0, 20.0, SIZE / 2], [0, 0, 1]])
    return Camera(viewmat, K, SIZE, SIZE)


def scene(squares: list[tuple[float, float, float]], grey: float = 0.3) -> Surfels:
    n = len(squares)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    sh = torch.full((n, 1, 3), (grey - 0.5) / 0.28209479177387814)
    order = torch.arange(n, dtype=torch.float32)[:, None].repeat(1, 2)
    return Surfels.of(torch.tensor(squares), quats, order, torch.zeros(n), sh)


def square_mask(x: float, y: float, half: float) -> torch.Tensor:
    ys, xs = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    return ((xs - x).abs() < half) & ((ys - y).abs() < half)


# the cup stands before the box and covers its left half; a floor lies behind both
CUP, BOX, FLOOR = (8.0, 12.0, 4.0), (12.0, 12.0, 4.0), (12.0, 12.0, 12.0)


def truth() -> torch.Tensor:
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    labels[square_mask(*BOX)] = 2
    labels[square_mask(*CUP)] = 1
    return labels
