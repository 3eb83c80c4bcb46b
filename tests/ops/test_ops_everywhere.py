"""The plain kernels of the ops, for processors without AVX2, against those that this machine uses."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from places import ROOT, SUPPORT

from beags_plugin.ops import extension

PROGRAM = """
import sys
sys.path[:0] = sys.argv[2:]
import torch
from test_ops_everywhere import results
torch.save(results(), sys.argv[1])
"""


def results() -> dict[str, list[torch.Tensor]]:
    """Something of every op that has a kernel for each instruction set."""
    from test_image_ops import normal_results, photometric_results
    from test_occupancy_loss import evaluate, make_grid, make_surfels
    from test_sh_colors import evaluate as evaluate_colors
    from test_sh_colors import scene
    from voted_views import larger_scene

    from beags_plugin.masks.reprojection import reproject_pairwise

    found = {}
    for dtype in (torch.float32, torch.float64):
        found[f"occupancy {dtype}"] = evaluate(make_surfels(700, dtype), make_grid())
        found[f"colors {dtype}"] = evaluate_colors(*scene(200, 16, dtype), 3)
        masks = list(reproject_pairwise(*larger_scene(dtype)))
        found[f"votes {dtype}"] = [value for mask in masks for value in (mask.labels, mask.confidence)]
        found[f"photometric {dtype}"] = photometric_results((50, 61), dtype)
        found[f"normal consistency {dtype}"] = normal_results((50, 61), dtype)
    return found


@pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
def test_plain_kernels_agree(tmp_path):
    """The instruction set is chosen once a process, so the plain one runs in a process of its own."""
    folders = [str(Path(__file__).parent), str(SUPPORT)]
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "plain.pt"), *folders]
    subprocess.run(command, env={**os.environ, "BEAGS_ISA": "baseline"}, check=True, cwd=ROOT)
    plain = torch.load(tmp_path / "plain.pt", weights_only=True)
    for name, found in results().items():
        for a, b in zip(found, plain[name], strict=True):
            if "votes" in name or "colors" in name:  # no fused operations there: the same bits
                assert torch.equal(a, b), name
            else:
                tolerance = 1e-12 if a.dtype == torch.float64 else 1e-4
                assert (a - b).abs().max() <= tolerance * b.abs().max(), name
