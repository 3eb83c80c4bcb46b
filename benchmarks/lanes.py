"""python -m benchmarks.lanes: lanes that the compiled rasterizer evaluates, and the least for other shapes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from rich.console import Console
from torch import Tensor

from beags_plugin.bench.report import plain_table
from beags_plugin.rasterizers import native
from benchmarks.backends import surfel_inputs
from benchmarks.machine import commit
from benchmarks.scenes import Scene, make_scene, parse_size

TILE, GROUP = 16, 4  # kTile and kGroup of native/rasterizer/types.h: pixels along a side
GROUPS = ((4, 4), (4, 2), (2, 4), (4, 1), (2, 2))  # width and height of what is evaluated or left out together
REGISTER = 16  # lanes of an AVX-512 register


@dataclass(frozen=True)
class LaneOptions:
    """Evaluated lanes over contributing (pixel, surfel) pairs. sizes: names of ``SIZES``, or N/WIDTHxHEIGHT."""

    sizes: tuple[str, ...] = ("10k", "50k", "200k")


def count_lanes(scene: Scene) -> dict[str, float]:
    """Return lanes over contributing pairs: those evaluated, then the least there can be for each shape of a group.

    The last two fill registers of 16 lanes for each (tile, surfel) pair: with squares of 2x2 pixels in any order; and
    with single pixels that keep their lane, so that sums over pixels keep their order and so every bit.
    """
    inputs, camera = surfel_inputs(scene), scene.camera
    counts = native.work_counts(inputs, camera, scene.settings)
    surfel, x, y = contributing(scene)
    lanes = {"evaluated": counts.lanes}
    for width, height in GROUPS:
        at = _number(surfel, x // width, y // height, camera.width, camera.height)
        lanes[f"groups of {width}x{height} pixels"] = width * height * len(at.unique())
    pair = _number(surfel, x // TILE, y // TILE, camera.width, camera.height)
    squares = _number(surfel, x // 2, y // 2, camera.width, camera.height).unique(return_inverse=True)[1]
    of_square = pair.new_zeros(int(squares.max()) + 1).scatter_(0, squares, pair)
    per_pair = of_square.unique(return_counts=True)[1]
    lanes["squares of 2x2, packed"] = REGISTER * int(((4 * per_pair + REGISTER - 1) // REGISTER).sum())
    places, times = (pair * REGISTER + y % GROUP * GROUP + x % GROUP).unique(return_counts=True)
    of_place = (places // REGISTER).unique(return_inverse=True)[1]
    most = times.new_zeros(int(of_place.max()) + 1).scatter_reduce_(0, of_place, times, "amax")
    lanes["pixels, each in its lane"] = REGISTER * int(most.sum())
    return {name: count / len(surfel) for name, count in lanes.items()}


def contributing(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Return surfel, column and row, each [P] int64, of every pair of a pixel and a surfel that contributes to it."""
    camera = scene.camera
    pixels = camera.width * camera.height
    labels = torch.arange(pixels, dtype=torch.int32).reshape(camera.height, camera.width)  # each pixel a class
    made = native.NativeRasterizer()
    keys, _ = made.sparse_class_contributions(surfel_inputs(scene), camera, scene.settings, labels, pixels)
    pixel = keys % pixels
    return keys // pixels, pixel % camera.width, pixel // camera.width


def _number(surfel: Tensor, column: Tensor, row: Tensor, width: int, height: int) -> Tensor:
    return (surfel * height + row) * width + column


def main(options: LaneOptions) -> None:
    """Count and print a table."""
    found = {size: count_lanes(make_scene(parse_size(size))) for size in options.sizes}
    rows = [(name, *(f"{lanes[name]:.3f}" for lanes in found.values())) for name in next(iter(found.values()))]
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"{native.instruction_set()}; commit {commit()}")
    console.print(plain_table("Lanes over contributing pairs", ("what is evaluated", *found), rows))


if __name__ == "__main__":
    main(tyro.cli(LaneOptions))
