"""Focus in training: the same bits after a break and for any number of threads, sharper objects, and growth."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, interrupted, kill_at, resume_to_end, run_to_end, short_config
from run_folders import write_drawn_scene, write_scene

from beags_plugin.views.close_ups import CLOSE_UP

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
    masks = {path.stem for path in (focused / "run/prepared/masks").iterdir()}
    near = {name for name in masks if CLOSE_UP in name}
    assert near and {name.partition(CLOSE_UP)[0] for name in near} <= masks - near
    report = json.loads((focused / "run/prepared/report.json").read_text())
    assert {each["view"] for each in report["agreement"]["views"]} == masks - near and report["magnified"] > 1.2


def test_close_ups_belong_to_runs_with_a_base_of_their_own(tmp_path, capsys):
    data, base = tmp_path / "data", tmp_path / "base"
    write_drawn_scene(data)
    auto = {**FOCUSED, "pipeline.datamanager.focus": "auto"}
    run_to_end(short_config(data, base, **auto, **{"pipeline.model.refine_steps": 0}))
    assert "of the steps see close-ups" in capsys.readouterr().out.replace("\n", " ")
    options = {**auto, "load_dir": base / "nerfstudio_models", "pipeline.model.base_steps": 0}
    run_to_end(short_config(data, tmp_path / "refined", **options))
    assert "of the steps see close-ups" not in capsys.readouterr().out.replace("\n", " ")
    assert not [path for path in (tmp_path / "refined/prepared/masks").iterdir() if CLOSE_UP in path.name]
