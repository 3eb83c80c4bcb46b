"""Errors of depth against exact depth."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from run_folders import SETTINGS, discs, ring_cameras, write_scene, write_trained

from beags_plugin.plugin.runs.layout import TRANSFORM_FILE
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.errors import UserError
from benchmarks.depth_error import measure, relative_errors


def test_errors_are_of_pixels_with_a_surface_and_a_depth():
    exact = np.array([[2.0, 4.0, 0.0, np.inf, 5.0]])
    depth = np.array([[2.5, 3.0, 1.0, 1.0, 0.0]])
    assert relative_errors(depth, exact).tolist() == [0.25, 0.25]


def test_a_run_is_compared_with_the_exact_depth_of_its_scene(tmp_path):
    data = write_scene(tmp_path / "lab")
    config = write_trained(tmp_path / "run", data, scale=2.0)
    frame = {"transform": torch.eye(4)[:3].tolist(), "scale": 2.0}
    (config.parent / TRANSFORM_FILE).write_text(json.dumps(frame))
    with pytest.raises(UserError, match=r"depth/.*\.npy is missing: only generated scenes"):
        measure(config)
    folder = data / "ground_truth" / "depth"
    folder.mkdir(parents=True)
    surfels = discs()[0]
    for index, camera in enumerate(ring_cameras(9, 1)):
        drawn = make_rasterizer("auto").rasterize(surfel_inputs(surfels, camera), camera, SETTINGS, torch.zeros(3))
        np.save(folder / f"v{index:02d}.npy", drawn.median_depth)
    before, after = measure(config)
    assert (before.stage, after.stage) == ("before", "after")
    assert after.median < 1e-5 and after.without == 0.0 < before.without < 0.1  # the cup is off
    np.save(folder / "v00.npy", np.ones((3, 4)))
    with pytest.raises(UserError, match=r"v00\.npy is 4 x 3, but the run's views are"):
        measure(config)
