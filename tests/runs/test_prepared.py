"""What a preparation wrote: its grid is read whole, or refused in one sentence; its report."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("nerfstudio")

from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.runs.prepared import PREPARATION_REPORT, dropped_background, read_grid
from beags_plugin.system.errors import UserError


def grid() -> VisibilityGrid:
    keys, classes = torch.tensor([3, 4], dtype=torch.int64), torch.tensor([1, 0], dtype=torch.int32)
    return VisibilityGrid(0.5, torch.zeros(3, dtype=torch.float64), 2, keys, classes)


def test_a_grid_and_no_grid_are_read_as_they_were_written(tmp_path):
    torch.save(grid().state_dict(), tmp_path / "grid.pt")
    found = read_grid(tmp_path / "grid.pt")
    assert found is not None and found.voxel_size == 0.5 and torch.equal(found.keys, grid().keys)
    torch.save({}, tmp_path / "none.pt")
    assert read_grid(tmp_path / "none.pt") is None


@pytest.mark.parametrize("content", [torch.zeros(2), torch.zeros(()), None, 0, [], "grid"], ids=repr)
def test_what_is_no_table_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "grid.pt")
    with pytest.raises(UserError, match="grid.pt is damaged: restore it"):
        read_grid(tmp_path / "grid.pt")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("voxel_size", torch.tensor(1 + 2j)),
        ("voxel_size", torch.tensor(float("nan"))),
        ("voxel_size", torch.tensor(0.0)),
        ("origin", torch.zeros(2)),
        ("num_classes", torch.tensor(2.5)),
        ("keys", torch.zeros(2)),
        ("classes", torch.zeros(3, dtype=torch.int32)),
        ("classes", None),
    ],
)
def test_a_damaged_grid_is_refused(tmp_path, name, value):
    torch.save({**grid().state_dict(), name: value}, tmp_path / "grid.pt")
    with pytest.raises(UserError, match="grid.pt is damaged: restore it"):
        read_grid(tmp_path / "grid.pt")


@pytest.mark.parametrize("report", [{"background_voxels": False}, {"background_voxels": True}, None], ids=str)
def test_only_a_grid_whose_background_was_left_out_is_refused(tmp_path, report):
    """With voxels of the background wanted, there may be none all the same."""
    if report is not None:
        (tmp_path / PREPARATION_REPORT).write_text(json.dumps(report))
    assert dropped_background(tmp_path) == (report == {"background_voxels": False})
