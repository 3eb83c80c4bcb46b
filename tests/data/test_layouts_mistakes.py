"""Mistakes in the files of a layout are refused with one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from data_folders import write_image
from layout_folders import ids, write_lerf_mask, write_llff
from parsed_views import parse

from beags_plugin.system.errors import UserError


def test_a_folder_without_images_is_refused(tmp_path):
    write_llff(tmp_path)
    for path in (tmp_path / "images_4").iterdir():
        path.unlink()
    with pytest.raises(UserError, match="images_4 holds no images"):
        parse(tmp_path, images_path=Path("images_4"))


def test_a_test_mask_of_no_view_is_refused(tmp_path):
    write_lerf_mask(tmp_path)
    write_image(tmp_path / "test_mask/2/green apple.png", ids())
    with pytest.raises(UserError, match="test_mask/2 is for no test view, of which there are 2"):
        parse(tmp_path)
