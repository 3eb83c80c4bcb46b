"""Prepares a small scene in this process, one of several, and saves what it found: a program of test_processes.py.

Arguments: rank, number of processes, file through which they meet, file to write.
"""

from __future__ import annotations

import sys

import torch
import torch.distributed as dist
from raster_scenes import CLASSES, make_scene

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.drawing import draw_class_map
from beags_plugin.refiners import REFINERS
from beags_plugin.refiners.preparation import PreparationConfig, prepare


def found() -> list[torch.Tensor]:
    """Labels, confidence, classes, margins and voxels of five views."""
    scene = make_scene(count=80, size=-1.0, opacity=2.0).to(torch.float32)
    s = scene.inputs
    surfels = Surfels.of(s.means, s.quats, s.log_scales, s.opacity_logits, torch.zeros(len(s.means), 1, 3))
    cameras = []
    for view in range(5):
        viewmat = scene.camera.viewmat.clone()
        viewmat[0, 3] += 0.15 * view
        cameras.append(Camera(viewmat, scene.camera.K, scene.camera.width, scene.camera.height))
    rasterizer = make_rasterizer("auto")
    masks = [draw_class_map(rasterizer, surfels, s.class_ids, camera, scene.settings)[0] for camera in cameras]
    masks[3] = None
    names = {index: str(index) for index in range(CLASSES)}
    prepared = prepare(
        surfels, cameras, masks, names, rasterizer, scene.settings, REFINERS.get("bea")(), PreparationConfig(k=20)
    )
    assigned, grid = prepared.assignment, prepared.grid
    return [
        *prepared.labels, *prepared.confidence, assigned.class_ids, assigned.margin, assigned.strongest,
        grid.keys, grid.classes, torch.tensor(grid.voxel_size, dtype=torch.float64),
    ]  # fmt: skip


def main(rank: int, processes: int, meeting: str, out: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=processes)
    torch.save(found(), out)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
