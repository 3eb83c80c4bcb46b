"""Solids of surfels on a floor, seen from a ring of cameras above: what objects are picked out of."""

from __future__ import annotations

import math

import numpy as np
import torch
from random_surfels import camera_at

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.picking.cutter import ViewMarks
from beags_plugin.rasterizers.interface import RasterSettings

SETTINGS = RasterSettings(0.01, 100.0)
SPACING = 0.05
AXES = {0: (0.5, 0.5, 0.5, 0.5), 1: (0.5**0.5, -(0.5**0.5), 0.0, 0.0), 2: (1.0, 0.0, 0.0, 0.0)}  # z onto x, y, z


def overlap(found: torch.Tensor, exact: torch.Tensor) -> float:
    """Return the intersection over the union of two sets, [N] bool."""
    return float((found & exact).sum() / (found | exact).sum())


def sheet(axis: int, level: float, low: tuple[float, float], high: tuple[float, float]) -> tuple[np.ndarray, int]:
    """Return points [n, 3] on a rectangle square to an axis, ``SPACING`` apart, and that axis."""
    grids = [np.arange(a + SPACING / 2, b, SPACING) for a, b in zip(low, high, strict=True)]
    first, second = np.meshgrid(*grids, indexing="ij")
    points = np.zeros((first.size, 3))
    others = [each for each in range(3) if each != axis]
    points[:, axis], points[:, others[0]], points[:, others[1]] = level, first.ravel(), second.ravel()
    return points, axis


def solids(colors: dict[int, tuple[float, float, float]]) -> tuple[Surfels, torch.Tensor]:
    """Return a floor (0), a low block (1) and a high one that touches it (2), their outsides; their numbers, [N] int64.

    colors: by number.
    """
    parts = {
        0: [sheet(2, 0.0, (-1.0, -1.0), (1.0, 1.0))],
        1: [
            sheet(2, 0.25, (-0.4, -0.2), (0.0, 0.2)),
            sheet(0, -0.4, (-0.2, 0.0), (0.2, 0.25)),
            *(sheet(1, y, (-0.4, 0.0), (0.0, 0.25)) for y in (-0.2, 0.2)),
        ],
        2: [
            sheet(2, 0.5, (0.0, -0.35), (0.3, 0.35)),
            sheet(0, 0.0, (-0.2, 0.25), (0.2, 0.5)),
            *(sheet(0, 0.0, (side[0], 0.0), (side[1], 0.5)) for side in ((-0.35, -0.2), (0.2, 0.35))),
            sheet(0, 0.3, (-0.35, 0.0), (0.35, 0.5)),
            *(sheet(1, y, (0.0, 0.0), (0.3, 0.5)) for y in (-0.35, 0.35)),
        ],
    }
    means, quats, numbers = [], [], []
    for number, sheets in parts.items():
        for points, axis in sheets:
            means.append(points)
            quats += [AXES[axis]] * len(points)
            numbers += [number] * len(points)
    owner = torch.tensor(numbers)
    colour = torch.tensor([colors[number] for number in range(3)])[owner]
    count = len(owner)
    return Surfels(
        torch.from_numpy(np.concatenate(means)).float(),
        torch.tensor(quats),
        torch.full((count, 2), math.log(0.6 * SPACING)),
        torch.full((count,), 3.0),
        (colour - 0.5) / 0.28209479177387814,
        torch.zeros(count, 0, 3),
    ), owner


def views(count: int = 8) -> list[Camera]:
    """Return cameras around the solids, looking down at them; each pair of them in turn higher."""
    eyes = [
        (2.2 * math.cos(angle), 2.2 * math.sin(angle), 1.2 + 0.8 * (index % 2))
        for index, angle in enumerate(2 * math.pi * (np.arange(count) + 0.3) / count)
    ]
    return [camera_at(eye, torch.tensor([0.0, 0.0, 0.15]), pixels=96) for eye in eyes]


def pixel_of(camera: Camera, point: tuple[float, float, float]) -> tuple[int, int]:
    """Return row and column of a point of the world."""
    local = camera.rotation @ torch.tensor(point) + camera.translation
    x, y, z = (camera.K @ local).tolist()
    return int(y / z), int(x / z)


def marks(camera: Camera, on=(), beside=(), within: torch.Tensor | None = None) -> ViewMarks:
    """Return marks of three pixels' width at points of the world that the camera sees."""
    numbers = torch.full((camera.height, camera.width), IGNORE, dtype=torch.int32)
    for number, point in enumerate([*on, *beside]):
        row, column = pixel_of(camera, point)
        numbers[row - 1 : row + 2, column - 1 : column + 2] = number
    return ViewMarks("v0", camera, numbers, (True,) * len(on) + (False,) * len(beside), within)
