"""How exact each rasterizer is, beside its time: python -m beags_benchmarks.kernels.accuracy --help."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from beags_benchmarks.experiments.report import write_json
from beags_benchmarks.kernels.backends import run
from beags_benchmarks.kernels.scenes import Scene, make_scene, parse_size
from beags_benchmarks.provenance import command, commit, describe_machine
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import native
from beags_plugin.system.errors import UserError

TRUTH = ("torch", torch.float64)
COMPARED = (("native", torch.float32), ("torch", torch.float32), ("native", torch.float64))
FIGURES = ("color_error", "image_error", "gradient_error", "cpu_ms")


@dataclass
class Arguments:
    """Compare the images and gradients of each rasterizer with those of the torch reference in float64."""

    size: str = "10k"
    """Size of 1k 10k 50k, or N/WIDTHxHEIGHT."""
    seeds: int = 3
    """Number of scenes; errors and times are means of them."""
    calls: int = 3
    """Calls of each rasterizer on each scene; the least time counts."""
    json: Path | None = None
    """File to write everything to, such as docs/results/rasterizers.json, the source of the pages' table."""


def in_dtype(scene: Scene, dtype: torch.dtype) -> Scene:
    """Return the scene with all floats in another dtype."""

    def cast(values: Mapping[str, Any]) -> dict[str, Tensor]:
        floats = {name: value for name, value in values.items() if isinstance(value, Tensor)}
        return {name: value.to(dtype) for name, value in floats.items() if value.is_floating_point()}

    surfels = Surfels(**cast(vars(scene.surfels)))
    return replace(scene, surfels=surfels, gradients=cast(scene.gradients), **cast(vars(scene)))


def errors(found: Mapping[str, Tensor], true: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the relative error of each tensor: the norm of the difference over that of the true one."""
    pairs = {name: (found[name].detach().double(), exact.detach()) for name, exact in true.items()}
    return {name: float((value - exact).norm() / exact.norm()) for name, (value, exact) in pairs.items()}


def measure(scene: Scene, calls: int) -> list[dict[str, float]]:
    """Return for each of ``COMPARED`` the errors of its colours, worst image and worst gradient, and its CPU time."""
    name, dtype = TRUTH
    _, _, images, gradients = run(name, in_dtype(scene, dtype))
    rows = []
    for name, dtype in COMPARED:
        cast = in_dtype(scene, dtype)
        results = [run(name, cast) for _ in range(calls)]
        of_images = errors(results[0][2], images)
        figures = (
            of_images["color"],
            max(of_images.values()),
            max(errors(results[0][3], gradients).values()),
            min(1e3 * (forward.cpu + backward.cpu) for forward, backward, _, _ in results),
        )
        rows.append(dict(zip(FIGURES, figures, strict=True)))
    return rows


def main(arguments: list[str]) -> None:
    """Measure, print the table and write the file; raises ``UserError`` for options out of range."""
    chosen = tyro.cli(Arguments, args=arguments)
    size = parse_size(chosen.size)
    if min(chosen.seeds, chosen.calls) < 1:
        raise UserError("at least one scene and one call are needed.")
    if (reason := native.NativeRasterizer.unavailable()) is not None:
        raise UserError(reason)
    torch.set_num_threads(1)
    rows = [
        {"variant": f"{name}, {str(dtype).removeprefix('torch.')}", "scene": size.name, "seed": seed, **figures}
        for seed in range(chosen.seeds)
        for (name, dtype), figures in zip(COMPARED, measure(make_scene(size, seed), chosen.calls), strict=True)
    ]
    table = Table("mean relative error of", "colours", "worst image", "worst gradient", "CPU ms")
    for variant in list(dict.fromkeys(row["variant"] for row in rows)):
        own = [row for row in rows if row["variant"] == variant]
        color, image, gradient, ms = (sum(row[name] for row in own) / len(own) for name in FIGURES)
        table.add_row(variant, f"{color:.1e}", f"{image:.1e}", f"{gradient:.1e}", f"{ms:.1f}")
    console = Console()
    console.print(table)
    if chosen.json is not None:
        about = {"command": command(), "commit": commit(), "machine": describe_machine(), "torch": torch.__version__}
        write_json(chosen.json, {**about, "quick": False, "rows": rows})
        console.print(f"written: {chosen.json}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as mistake:
        sys.exit(f"benchmark: {mistake}")
