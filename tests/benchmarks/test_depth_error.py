"""Errors of depth against exact depth."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from run_folders import write_scene, write_trained

from beags_plugin.system.errors import UserError
from benchmarks.depth_error import measure, relative_errors


def test_errors_are_of_pixels_with_a_surface_and_a_depth():
    exact = np.array([[2.0, 4.0, 0.0, np.inf, 5.0]])
    depth = np.array([[2.5, 3.0, 1.0, 1.0, 0.0]])
    assert relative_errors(depth, exact).tolist() == [0.25, 0.25]


def test_a_run_is_compared_with_the_exact_depth_of_its_scene(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    with pytest.raises(UserError, match=r"depth/.*\.npy is missing: only generated scenes"):
        measure(config)
