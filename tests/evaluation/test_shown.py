"""Pixels that some training view shows: a disc before a wall, against rays cast one by one."""

from __future__ import annotations

import math

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.shown import shown_pixels
from beags_plugin.rasterizers.interface import RasterSettings

WIDTH, HEIGHT, FOCAL = 64, 48, 40.0
WALL, DISC = 4.0, 2.0  # depths
SIGMA, OPACITY = 0.3, 0.99
RADIUS = SIGMA * math.sqrt(2 * math.log(2 * OPACITY))  # Half of the light passes at this distance.


def camera(x: float, width: int = WIDTH, z: float = 0.0) -> Camera:
    """Look along z from (x, 0, z)."""
    viewmat = torch.eye(4)
    viewmat[0, 3], viewmat[2, 3] = -x, -z
    return Camera(viewmat, torch.tensor([[FOCAL, 0, width / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]), width, HEIGHT)


def on_disc(x: float, y: float) -> bool:
    return math.hypot(x, y) < RADIUS


def is_shown(view: float, column: int, row: int, training: dict[float, int], disc: bool = True) -> bool:
    """Cast the ray of a pixel and see whether a training view (place: width of its picture) shows what it meets."""
    dx, dy = (column + 0.5 - WIDTH / 2) / FOCAL, (row + 0.5 - HEIGHT / 2) / FOCAL
    depth = DISC if disc and on_disc(view + DISC * dx, DISC * dy) else WALL
    x, y = view + depth * dx, depth * dy
    for place, width in training.items():
        way = (x - place) / depth
        hidden = disc and depth == WALL and on_disc(place + DISC * way, DISC * y / depth)
        if abs(way) * FOCAL < width / 2 and not hidden:
            return True
    return False


@pytest.mark.parametrize("training", [{0.0: WIDTH}, {0.0: 30}, {-0.5: 40, 1.2: 20}, {}])
def test_what_training_views_show(rasterizer, training):
    means = torch.tensor([[0.0, 0.0, WALL], [0.0, 0.0, DISC]])
    scales = torch.tensor([[40.0, 40.0], [SIGMA, SIGMA]]).log()
    opacity = torch.full((2,), math.log(OPACITY / (1 - OPACITY)))
    scene = Surfels.of(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), scales, opacity, torch.zeros(2, 1, 3))
    views, cameras = [0.0, 0.6], [camera(x, width) for x, width in training.items()]
    settings = RasterSettings(0.01, 100.0)
    for surfels, disc in ((scene, True), (scene[torch.tensor([True, False])], False)):
        masks = shown_pixels(surfels, rasterizer, settings, [camera(x) for x in views], cameras)
        for view, found in zip(views, masks, strict=True):
            true = [[is_shown(view, i, j, training, disc) for i in range(WIDTH)] for j in range(HEIGHT)]
            wrong = (found != torch.tensor(true)).float().mean()
            assert wrong <= (0.02 if disc else 0.0)  # rims of the disc are a pixel wide
    nothing = shown_pixels(scene[:0], rasterizer, settings, [camera(0.0)], cameras)
    assert not nothing[0].any()  # no surface


@pytest.mark.parametrize(("by", "shown"), [(0.5 * TAU, True), (2 * TAU, False)])
def test_how_far_depths_may_differ(rasterizer, by, shown):
    """A veil stands before a wall in a training view, not in the held-out one; close to it, it counts as the wall."""
    means = torch.tensor([[0.0, 0.0, WALL], [0.0, 0.0, WALL * (1 - by)]])
    quats, sizes = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), torch.tensor([40.0, 0.2])
    opacity = torch.full((2,), 6.0)
    scene = Surfels.of(means, quats, sizes.log()[:, None].repeat(1, 2), opacity, torch.zeros(2, 1, 3))
    (found,) = shown_pixels(
        scene, rasterizer, RasterSettings(0.01, 100.0), [camera(0.0, z=0.995 * WALL)], [camera(0.0)]
    )
    assert found.all() if shown else not found.any()
