"""Masks and points under lens distortion: there and back, and against the lens models' formulas."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from distorted_views import LARGE_H, LARGE_W, distort, manager, write_distorted

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.views.lens import project_through_lens


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_class_map_comes_back_to_its_photo(tmp_path, model):
    write_distorted(tmp_path, model, [])
    data = manager(tmp_path)
    row, column = np.mgrid[:LARGE_H, :LARGE_W]
    given = (1 + row // 20 * 8 + column // 20).astype(np.uint16)  # squares: their borders tell any shift
    back = data.files["train"].as_in_file(data.files["train"].undistorted(given, 0), 0)
    known = back != IGNORE
    assert back.shape == given.shape and known.mean() > 0.7
    inner = known & (row % 20 > 1) & (row % 20 < 18) & (column % 20 > 1) & (column % 20 < 18)
    np.testing.assert_array_equal(back[inner], given[inner])
    assert (back == given)[known].mean() > 0.93  # The nearest pixel is taken twice at borders.


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_points_land_where_the_lens_shows_them(tmp_path, model):
    write_distorted(tmp_path, model, [])
    cameras = manager(tmp_path).train_dataparser_outputs.cameras  # those of the dataset are straightened
    rays = [(x, y) for x in (-0.42, 0.0, 0.37) for y in (-0.3, 0.01, 0.21)]
    pose = torch.cat([cameras.camera_to_worlds[0], torch.tensor([[0.0, 0, 0, 1]])]).double().numpy()
    local = np.array([(2 * x, -2 * y, -2.0, 1.0) for x, y in rays])  # depth 2, OpenGL axes
    xy, z = project_through_lens((local @ pose.T)[:, :3], cameras, 0)
    np.testing.assert_allclose(z, 2.0, rtol=1e-5)
    np.testing.assert_allclose(xy, [distort(model, *ray) for ray in rays], atol=1e-2)
    behind = (np.array([[0.0, 0.0, 2.0, 1.0]]) @ pose.T)[:, :3]
    assert project_through_lens(behind, cameras, 0)[1][0] <= 0
