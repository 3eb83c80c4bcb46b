"""What a run needs: Gaussians, samples, voxels, bytes; counted by hand on a small run on disk."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("nerfstudio")

import torch
from run_folders import write_scene, write_trained

from beags_plugin.bench.required import cells, load, run_required
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.ops import extension
from beags_plugin.system.errors import UserError


@pytest.fixture
def run(tmp_path):
    """A refined run whose grid has a voxel about each Gaussian of the refined scene, of all three classes."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "data"))
    scene = load(config)
    grid = VisibilityGrid.from_points([(scene.refined.means, scene.class_ids)], 0.25, torch.zeros(3), 3)
    (tmp_path / "run" / "prepared").mkdir()
    torch.save(grid.state_dict(), tmp_path / "run" / "prepared" / "grid.pt")
    return config


def test_rows_are_what_a_count_by_hand_gives(run, tmp_path):
    rows = {row.what: row for row in run_required(run, tmp_path / "rows.json", tmp_path / "rows.csv")}
    scene = load(run)
    unseen = rows["Gaussians that no training view shows"]
    assert unseen.whole == len(scene.base) == 75 and unseen.difference == pytest.approx(0.0, abs=1e-3)
    bounds = [row.needed for name, row in rows.items() if name.startswith("Gaussians below")]
    assert bounds == sorted(bounds, reverse=True) and bounds[-1] < unseen.needed
    assert all(row.seconds_whole > 0 and row.seconds_needed > 0 for row in rows.values() if row.timed)
    maps = rows["class maps of training views"]
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    assert (maps.whole, maps.needed, maps.difference) == (4 * pixels, pixels, 0.0)
    assert rows["training images as floats, in the preparation"].whole == 12 * pixels
    colour = rows["coefficients of the colour that no view tells apart"]
    assert colour.whole == 75 * 4 * 3 and 0 < colour.needed <= colour.whole
    assert 0 < rows["Gaussians whose views do not resolve degree 1"].needed <= 75
    (kept,) = [row for name, row in rows.items() if name.startswith("bands above degree 0") and row.timed]
    assert (kept.whole, kept.needed) == (75 * 4 * 3 * 4, 75 * 3 * 4) and kept.seconds_needed > 0
    alone = rows["objects alone in held-out views"]
    assert rows["pairs of views in reprojection"].whole == 7 * 7 == rows["pairs of views in reprojection"].needed
    assert alone.whole == 2 * 2 and 0 < alone.needed <= 4
    voxels = rows["voxels of the background"]
    assert 0 < voxels.needed < voxels.whole and voxels.difference == 0.0
    content = json.loads((tmp_path / "rows.json").read_text())
    assert [row["what"] for row in content["rows"]] == list(rows) and content["experiment"] == "required"
    assert (tmp_path / "rows.csv").read_text().count("\n") == len(rows) + 1
    if extension.load() is not None:
        samples = rows["occupancy samples in discs that are wholly valid"]
        assert samples.whole == 20 * 75 and 0 < samples.needed < samples.whole and samples.difference == 0.0
    assert cells(voxels)[-1] == "none" and "PSNR" in cells(rows["Gaussians below 4 px in every view"])[-1]


def test_a_base_without_classes_is_measured_as_far_as_it_goes(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "data"), assigned=False)
    found = {row.what for row in run_required(config)}
    assert "coefficients of the colour that no view tells apart" in found and "class maps of training views" in found
    assert not any("voxels" in what for what in found)


def test_a_run_without_a_base_is_refused(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "data"), base=False)
    with pytest.raises(UserError, match="keeps no base"):
        run_required(config)
