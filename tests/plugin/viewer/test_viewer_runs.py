"""Masks and grids of a run in the viewer: in training, used again, a base alone, extracted from another."""

from __future__ import annotations

import json
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from run_folders import write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from nerfstudio.utils.eval_utils import eval_setup
from viewer_windows import ALWAYS, Stand, write_finished

from beags_plugin.labels.classes import write_mask
from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.viewer.export import ShownFiles
from beags_plugin.plugin.viewer.viewing import CHANNELS
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return write_finished(tmp_path_factory.mktemp("viewer"))


def test_a_run_in_training_lists_what_will_come(finished):
    trainer = SimpleNamespace(training_state="training")
    window = Stand(finished, trainer, lambda model: model.assigned.fill_(False))
    assert set(window.look()) == ALWAYS | set(CHANNELS)
    assert window.look("class_map")["class_map"].sum() == 0.0
    assert "no classes yet" in window.model.viewing.notes["classes"]
    window.model.assigned.fill_(True)
    window.panel.follow()
    assert window.look("class_map")["class_map"].sum() > 0.0 and window.panel.object.options[1] == "cup"


@pytest.mark.parametrize("name", ["html", "glb"])
def test_a_viewer_of_moved_photos_exports_what_needs_their_cameras(tmp_path, name):
    if name == "glb":
        pytest.importorskip("open3d")
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    (tmp_path / "lab").rename(tmp_path / "moved")
    window = Stand(config, data=tmp_path / "moved")
    files = ShownFiles(window.model.viewing, lambda: "all", lambda: name, lambda text: None)
    assert files.write() == tmp_path / f"run/exports/all.{name}" and files.write().stat().st_size > 1000


def test_masks_of_a_former_run_in_the_folder_are_not_shown_while_a_base_is_trained(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    write_prepared(tmp_path / "run", shift=1)
    window = Stand(config, SimpleNamespace(training_state="training"), lambda model: model.assigned.fill_(False))
    run = window.model.viewing.run
    assert run.mask(0, "before", 20, 12) is not None and run.mask(0, "after", 20, 12) is None
    window.model.prepared = True  # The switch to refinement says so once it is done.
    first = run.mask(0, "after", 20, 12)
    path = tmp_path / "run/prepared/masks" / f"{run.names[0]}.png"
    write_mask(path, np.zeros((12, 20), np.uint8))  # prepared again
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 1))
    assert set(first.unique().tolist()) == {0, 1, 2} and not run.mask(0, "after", 20, 12).any()


def test_a_base_opened_again_shows_no_masks_of_a_former_run_in_its_folder(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), assigned=False)
    write_prepared(tmp_path / "run", shift=1)
    window = Stand(config)
    run = window.model.viewing.run
    assert run.mask(0, "after", 20, 12) is None
    assert set(window.look()) == ALWAYS | {"mask_before"}


def test_an_extracted_run_shows_its_object_and_the_masks_of_the_run_it_is_from(finished, tmp_path):
    (extracted,) = extract_objects(finished, ["cup"], output=tmp_path / "out")
    window = Stand(extracted.config)
    assert window.panel.object.options == ["cup"]
    outputs = window.look("mask_after")
    assert set(outputs) == ALWAYS | set(CHANNELS)
    window.panel.follow()
    assert window.look("mask_after")["mask_after"].sum() > 0
    assert window.panel.files.write() == extracted.config.parent / "exports/shown_scene.ply"


@pytest.mark.parametrize("changed", ["a mask", "the grid"])
def test_an_extracted_run_whose_origin_was_trained_again_shows_none_of_its_masks(tmp_path, changed):
    run = tmp_path / "run"
    config = write_trained(run, write_scene(tmp_path / "lab"))
    write_prepared(run, shift=1)
    (extracted,) = extract_objects(config, ["cup"], output=tmp_path / "out")
    (of_extracted,) = extract_objects(extracted.config, ["cup"], output=tmp_path / "twice")
    for each in (extracted, of_extracted):
        assert Stand(each.config).panel.notes == {}
    open_now = Stand(extracted.config).model.viewing.run
    shutil.rmtree(run / "prepared")
    write_prepared(run, shift=1, **({"scale": 2.0} if changed == "the grid" else {}))
    if changed == "a mask":
        write_mask(run / "prepared/masks/v03.png", np.zeros((12, 20), np.uint8))
    os.utime(run / "prepared/grid.pt", ns=(1, 1))  # another file, even where the clock is coarse
    assert open_now.prepared is None and open_now.mask(0, "after", 20, 12) is None
    for each in (extracted, of_extracted):
        window = Stand(each.config)
        assert set(window.look("rgb")) == ALWAYS | {"class_map", "class_confidence", "boundary_error", "mask_before"}
        assert window.panel.notes["run"] == (
            f"No masks after reprojection: {run} has been trained again since this was extracted from it. Extract it "
            "again."
        )
    origin = Stand(config)  # the run itself shows what it has
    assert origin.panel.notes == {} and "mask_after" in origin.look()
    (again,) = extract_objects(config, ["cup"], output=tmp_path / "out")
    assert Stand(again.config).panel.notes == {}


def test_an_extracted_run_without_digests_shows_masks_and_one_without_its_origin_does_not(finished, tmp_path):
    (extracted,) = extract_objects(finished, ["cup"], output=tmp_path / "out")
    origin = extracted.config.parent / "extraction.json"
    content = json.loads(origin.read_text())
    assert content["prepared"]
    origin.write_text(json.dumps({**content, "run": str(tmp_path / "gone/config.yml")}))
    listed = set(Stand(extracted.config).look())
    assert listed == ALWAYS | {"class_map", "class_confidence", "boundary_error", "mask_before"}
    del content["prepared"]
    origin.write_text(json.dumps(content))
    assert "mask_after" in Stand(extracted.config).look()


def test_a_base_without_masks_lists_what_it_has(tmp_path):
    window = Stand(write_trained(tmp_path / "run", write_scene(tmp_path / "lab", masks=False), assigned=False))
    assert set(window.look()) == ALWAYS
    window.panel.follow()
    assert window.panel.object.options == ["none yet"]


def test_without_a_viewer_there_is_no_export(finished):
    _, pipeline, _, _ = eval_setup(finished, test_mode="test")
    with pytest.raises(UserError, match="beags export"):
        pipeline.model.viewer_panel.files.write()
