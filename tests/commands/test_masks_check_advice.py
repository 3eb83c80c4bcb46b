"""What ``beags masks check`` tells people to do next can be pasted."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import tyro
from run_folders import write_scene

from beags_plugin.commands.masks import Agree, Check
from beags_plugin.objects.check_masks import check, options_beside
from beags_plugin.system.errors import UserError


def test_the_command_that_makes_masks_agree_names_the_same_run_data_and_masks(tmp_path):
    check = Check(load_config=Path("my run/config.yml"), data=Path("/my data"), masks_path=Path("my masks"))
    words = shlex.split(check._agreement(tmp_path))
    assert words[:3] == ["beags", "masks", "agree"]
    agree = tyro.cli(Agree, args=words[3:])
    assert (agree.load_config, agree.data) == (check.load_config, check.data)
    assert agree.masks_path == tmp_path / "my masks" and agree.classes_path is None


def test_masks_agree_takes_output_dir_too():
    agree = tyro.cli(Agree, args=["--load-config", "run", "--output-dir", "there"])
    assert agree.output == Path("there")


def test_a_folder_of_masks_that_is_not_in_the_scene_is_told_where_it_was_looked_for(tmp_path):
    """A shell completes paths from where one stands; what makes masks would be told of a scene that is not there."""
    data = write_scene(tmp_path / "lab")
    with pytest.raises(UserError, match=r"lab/runs/picked/masks does not exist: .* a relative one lies in the scene"):
        check(options_beside(None, data, masks_path=Path("runs/picked/masks")))
