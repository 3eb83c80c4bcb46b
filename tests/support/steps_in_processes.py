"""Training steps that each look at two views, in one process or in two: a program of test_processes.py.

Arguments: rank, number of processes, file through which they meet, file to write.
"""

from __future__ import annotations

import sys
from dataclasses import fields, replace

import torch
import torch.distributed as dist
from labelled_views import labelled_views

from beags_plugin.core.densification import GradientStatistics
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.photometric import ssim
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.processes import add_up, average

STEPS, VIEWS = 3, 2


def trained(rank: int, processes: int) -> list[torch.Tensor]:
    """Return the parameters, Adam's moments and the statistics of growth after some steps."""
    start, cameras, _, rasterizer, settings = labelled_views(STEPS * VIEWS, 0.15)
    leaves = [getattr(start, field.name).clone().requires_grad_() for field in fields(Surfels)]
    adam = torch.optim.Adam(leaves, lr=0.01, eps=1e-15, fused=True)
    statistics = GradientStatistics(len(start.means))
    for step in range(STEPS):
        adam.zero_grad()
        for view in range(VIEWS):
            if processes > 1 and view != rank:
                continue
            camera, shift = cameras[VIEWS * step + view], torch.zeros(len(start.means), 2, requires_grad=True)
            inputs = replace(surfel_inputs(Surfels(*leaves), camera), screen_shift=shift)
            drawn = rasterizer.rasterize(inputs, camera, settings, torch.zeros(3))
            photo = drawn.color.detach().roll(3, dims=1)
            (1.0 - ssim(drawn.color, photo)).backward()
            assert shift.grad is not None
            statistics.add(shift.grad.norm(dim=-1), drawn.visible)
        gradients = [leaf.grad for leaf in leaves if leaf.grad is not None]
        average(gradients)
        if processes == 1:
            for gradient in gradients:
                gradient /= VIEWS
        adam.step()
    add_up([statistics.total, statistics.views])
    moments = [adam.state[leaf][name] for leaf in leaves if leaf.grad is not None for name in ("exp_avg", "exp_avg_sq")]
    return [*(leaf.detach() for leaf in leaves), *moments, statistics.views, statistics.total]


def main(rank: int, processes: int, meeting: str, out: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=processes)
    torch.save(trained(rank, processes), out)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
