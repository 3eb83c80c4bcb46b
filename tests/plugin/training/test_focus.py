"""Focus in training: the same bits after a break and for any number of threads, and which runs see close-ups."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, interrupted, kill_at, resume_to_end, run_to_end, short_config
from run_folders import write_drawn_scene, write_scene

from beags_plugin.views.close_ups import CLOSE_UPS

FOCUSED = {
    "pipeline.datamanager.focus": "0.5",
    "pipeline.datamanager.dataparser.downscale_factor": 2.0,
    "pipeline.model.prepare.agree": True,
}


@pytest.fixture
def focused(shared):
    """A folder with ``data`` and ``run``: a short run that sees close-ups."""

    def train(folder) -> None:
        run_to_end(short_config(write_scene(folder / "data"), folder / "run", **FOCUSED))

    return shared("focused_run", train)


@pytest.mark.parametrize(("step", "after"), [(20, True), (47, False)])  # one in the base, one refining
def test_a_killed_run_ends_as_the_whole_one(focused, tmp_path, monkeypatch, step, after):
    run = tmp_path / "run"
    interrupted(focused / "data", run, monkeypatch, lambda patch: kill_at(patch, step, after), **FOCUSED)
    resume_to_end(run)
    assert_same_run(run, focused / "run")


def test_the_number_of_threads_is_no_matter(focused, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2 if before == 1 else 1)
    try:
        run_to_end(short_config(focused / "data", tmp_path / "run", **FOCUSED))
    finally:
        torch.set_num_threads(before)
    assert_same_run(tmp_path / "run", focused / "run")


def test_close_ups_get_consistent_masks_of_their_own(focused):
    folder = focused / "run/prepared/masks"
    masks, near = ({path.stem for path in each.glob("*.png")} for each in (folder, folder / CLOSE_UPS))
    assert near and {name.rpartition("-")[0] for name in near} <= masks
    report = json.loads((focused / "run/prepared/report.json").read_text())
    assert {each["view"] for each in report["agreement"]["views"]} == masks and report["magnified"] > 1.2


def test_a_run_that_goes_on_with_another_sees_close_ups_if_that_did(tmp_path, capsys):
    data = tmp_path / "data"
    write_drawn_scene(data)

    def saw(name: str, focus: str, **options) -> bool:
        own = {**FOCUSED, "pipeline.datamanager.focus": focus, **options}
        run_to_end(short_config(data, tmp_path / name, **own))
        folder = tmp_path / name / "prepared/masks" / CLOSE_UPS
        said = "of the steps see close-ups" in capsys.readouterr().out.replace("\n", " ")
        assert folder.exists() == (said and "load_dir" in own)
        return said

    assert saw("near", "auto", **{"pipeline.model.refine_steps": 0})
    assert not saw("far", "off", **{"pipeline.model.refine_steps": 0})
    alone = {"pipeline.model.base_steps": 0}
    assert saw("near-refined", "auto", load_dir=tmp_path / "near/nerfstudio_models", **alone)
    assert not saw("far-refined", "auto", load_dir=tmp_path / "far/nerfstudio_models", **alone)
    assert saw("near-again", "auto", load_dir=tmp_path / "near-refined/base/nerfstudio_models", **alone)
    assert not saw("far-again", "auto", load_dir=tmp_path / "far-refined/base/nerfstudio_models", **alone)


def test_objects_alone_and_masks_of_some_photos_are_trained_with_close_ups(tmp_path):
    data = tmp_path / "data"
    write_drawn_scene(data)
    for path in sorted((data / "masks").glob("*.png"))[::2]:
        path.unlink()
    points = {"pipeline.datamanager.dataparser.num_random_points": 900}  # More points make surfaces solid sooner.
    options = {**FOCUSED, **points, "pipeline.datamanager.photos": "objects"}
    run_to_end(short_config(data, tmp_path / "run", **options))
    assert any((tmp_path / "run/prepared/masks" / CLOSE_UPS).glob("*.png"))
