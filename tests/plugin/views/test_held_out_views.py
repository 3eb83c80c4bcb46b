"""What counts as truth of the held-out views."""

from __future__ import annotations

import pytest
import torch
from run_folders import write_scene

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.held_out_views import HeldOutViews


@pytest.mark.parametrize("given", [True, False])
def test_masks_that_a_program_made_of_all_photos_are_trained_on_but_are_no_truth(tmp_path, given):
    data = write_scene(tmp_path)
    if not given:
        (data / "masks/no_truth.json").write_text("{}")
    manager = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data)).setup(device="cpu")
    views = HeldOutViews(manager, {0: "background", 1: "cup", 2: "box"}, torch.zeros(3))
    assert all((view.visible is not None) == given for view in views) and len(views) > 0
    assert all(view.labels is not None for view in manager.views("train"))
