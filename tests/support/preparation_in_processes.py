"""Prepares a small scene in this process, one of several, and saves what it found: a program of test_processes.py.

Arguments: rank, number of processes, file through which they meet, file to write, folder that keeps finished stages.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import torch.distributed as dist
from labelled_views import labelled_views
from raster_scenes import CLASSES

from beags_plugin.preparation.pipeline import PreparationConfig, prepare
from beags_plugin.preparation.stages import StageStore
from beags_plugin.refiners import REFINERS
from beags_plugin.system.processes import add_up, average

METHODS = ("pairwise", "voxel")


def found(reprojection: str, store: StageStore | None = None) -> tuple[list[torch.Tensor], list[str]]:
    """Labels, confidence, classes, margins and voxels of five views, and what is told of the stages."""
    surfels, cameras, masks, rasterizer, settings = labelled_views(5, 0.15)
    names = {index: str(index) for index in range(CLASSES)}
    config = PreparationConfig(k=20, reprojection=reprojection)
    prepared = prepare(surfels, cameras, masks, names, rasterizer, settings, REFINERS.get("bea")(), config, store=store)
    assigned, grid = prepared.assignment, prepared.grid
    return [
        *prepared.labels, *prepared.confidence, assigned.class_ids, assigned.margin, assigned.strongest,
        grid.keys, grid.classes, torch.tensor(grid.voxel_size, dtype=torch.float64),
    ], prepared.findings  # fmt: skip


def main(rank: int, processes: int, meeting: str, out: str, kept: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=processes)
    results = {method: found(method, StageStore(Path(kept) / method)) for method in METHODS}
    mean, total = torch.arange(3.0) * (rank + 1), torch.tensor([rank + 1])
    average([mean])
    add_up([total])
    torch.save({**results, "exchanged": (mean, total)}, out)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
