"""What the parts of ``beags bench required`` share: the scene that is measured, a row of the table, timing, drawing."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import psnr
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs

if TYPE_CHECKING:
    from beags_plugin.plugin.views.views import View

CALLS = 5  # of which the median counts; both sides take turns


@dataclass(frozen=True)
class Row:
    """One thing that may not be needed.

    whole, needed: how much there is of it and how much is left, in ``unit``. seconds_whole, seconds_needed: of what
    ``timed`` names, with all and with what is left. difference: what the result loses, in ``measure``; 0.0 where it is
    the same bit for bit.
    """

    what: str
    unit: str
    whole: float
    needed: float
    timed: str = ""
    seconds_whole: float | None = None
    seconds_needed: float | None = None
    measure: str = ""
    difference: float | None = None


@dataclass(frozen=True)
class Scene:
    """A run as it is measured: the base that refinement started from, its views, and the refined surfels and grid.

    Of a base without classes, ``refined`` is the base itself, and ``class_ids`` and ``grid`` are None.
    """

    base: Surfels
    refined: Surfels
    class_ids: Tensor | None
    grid: VisibilityGrid | None
    train: Sequence[View]
    test: Sequence[View]
    num_classes: int
    rasterizer: Rasterizer
    settings: RasterSettings
    samples: int


def in_turn(*ways: Callable[[], object]) -> tuple[list[float], list]:
    """Median seconds of each way, and what it returned; they take turns, ``CALLS`` times each."""
    seconds: list[list[float]] = [[] for _ in ways]
    results: list[object] = [None] * len(ways)
    for _ in range(CALLS):
        for index, way in enumerate(ways):
            start = time.perf_counter()
            results[index] = way()
            seconds[index].append(time.perf_counter() - start)
    return [median(values) for values in seconds], results


def draw(scene: Scene, surfels: Surfels, views: Sequence[View] | None = None) -> list[Tensor]:
    """Colours of the held-out (or other) views, on black."""
    settings = replace(scene.settings, geometry=False, distortion=False)
    with torch.no_grad():
        return [
            scene.rasterizer.rasterize(surfel_inputs(surfels, view.camera), view.camera, settings, torch.zeros(3)).color
            for view in (scene.test if views is None else views)
        ]


def mean_psnr(pictures: Sequence[Tensor], views: Sequence[View]) -> float:
    """Mean over views, dB."""
    values = [psnr(picture, view.image) for picture, view in zip(pictures, views, strict=True)]
    return sum(values) / len(values)
