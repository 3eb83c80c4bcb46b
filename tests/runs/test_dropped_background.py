"""What a preparation says of the voxels of the background."""

from __future__ import annotations

import json

import pytest

from beags_plugin.runs.prepared import PREPARATION_REPORT, dropped_background


@pytest.mark.parametrize(
    ("report", "dropped"),
    [
        pytest.param({"background_voxels": False}, True, id="a loss ignored it"),
        pytest.param({"background_voxels": True}, False, id="there may be none all the same"),
        pytest.param({}, False, id="an older run"),
        pytest.param(None, False, id="no report"),
    ],
)
def test_only_a_grid_whose_background_was_left_out_is_refused(tmp_path, report, dropped):
    if report is not None:
        (tmp_path / PREPARATION_REPORT).write_text(json.dumps(report))
    assert dropped_background(tmp_path) == dropped
