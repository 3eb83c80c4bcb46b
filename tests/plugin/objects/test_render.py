"""``beags render`` on runs on disk."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from PIL import Image
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands.cli import main
from beags_plugin.pictures.options import RenderOptions
from beags_plugin.plugin.objects.render import render_run
from beags_plugin.system.errors import UserError

SMALL = RenderOptions(size=32, frames=3, views=4)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    root = tmp_path_factory.mktemp("lab")
    return write_trained(root / "run", write_scene(root / "lab"))


def read(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def test_a_sheet_of_one_object_and_of_all(config, tmp_path, capsys):
    main(
        ["render", "--load-config", str(config), "--object", "cup", "--format", "sheet", "--size", "32", "--views", "4"]
    )
    assert read(config.parent / "renders" / "cup_sheet.png").shape == (32 + 22, 4 * 36, 3)
    assert "cup_sheet.png" in capsys.readouterr().out
    everything = render_run(config, (), "sheet", tmp_path / "all.png", SMALL)
    picture = read(everything)
    assert picture.shape == (2 * 54, 4 * 36, 3) and (picture[18:50, :32] < 200).any()
    assert render_run(config, ("background",), "sheet", tmp_path / "b.png", SMALL).exists()


def test_before_and_after_differ_where_the_base_did(config, tmp_path):
    picture = read(render_run(config, ("cup",), "before-after", tmp_path / "a.png", SMALL))
    assert picture.shape == (2 * 54, 2 * 36, 3)
    before, after = picture[18:50, :32], picture[18:50, 36:68]
    assert not np.array_equal(before, after)  # the base's cup is off
    assert render_run(config, ("cup",), "before-after", tmp_path / "a.gif", SMALL).exists()


def test_a_video_is_the_default(config):
    path = render_run(config, ("cup",), options=SMALL)
    assert path.stem == "cup_video" and path.stat().st_size > 100


def test_the_data_are_not_needed(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    shutil.rmtree(tmp_path / "lab")
    assert render_run(config, ("cup",), "sheet", tmp_path / "a.png", SMALL).exists()


def test_an_unknown_format_is_refused(config):
    with pytest.raises(UserError, match="there is no format 'hologram': choose one of video, sheet, before-after."):
        render_run(config, (), "hologram", None, SMALL)


def test_a_run_that_has_kept_no_base_has_nothing_to_compare(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), base=False)
    with pytest.raises(UserError, match="has kept no state before refinement"):
        render_run(config, (), "before-after", tmp_path / "a.png", SMALL)
