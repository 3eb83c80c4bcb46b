"""Focus in training: the same bits after a break and for any number of threads, sharper objects, and growth."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, checkpoint_of, interrupted, kill_at, resume_to_end, run_to_end, short_config
from run_folders import write_drawn_scene, write_scene

FOCUSED = {"pipeline.datamanager.focus": "0.5", "pipeline.datamanager.dataparser.downscale_factor": 2.0}


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
    near = {name for name in masks if "-close-up-" in name}
    assert near and {name.partition("-close-up-")[0] for name in near} <= masks - near


def test_refinement_sharpens_a_base_that_saw_no_close_ups(tmp_path):
    """Gaussians of objects grow, those of the background do not, and nothing grows without focus."""
    data, base = tmp_path / "data", tmp_path / "base"
    write_drawn_scene(data)
    plain = {**FOCUSED, "pipeline.datamanager.focus": "off", "pipeline.model.densify.stop": 0}
    run_to_end(short_config(data, base, **plain, **{"pipeline.model.refine_steps": 0}))

    def refined(name: str, focus: str) -> dict:
        options = {**FOCUSED, "pipeline.datamanager.focus": focus, "load_dir": base / "nerfstudio_models"}
        steps = {"pipeline.model.base_steps": 0, "pipeline.model.refine_steps": 104}
        steps["optimizers.opacities.optimizer.lr"] = 0.01
        run_to_end(short_config(data, tmp_path / name, **options, **steps))
        return checkpoint_of(tmp_path / name)["pipeline"]

    off, on = refined("off", "off"), refined("on", "0.5")
    counts = [torch.bincount(state["_model.class_ids"].clamp_max(1), minlength=2).tolist() for state in (off, on)]
    assert counts[1][1] > 1.1 * counts[0][1] and counts[1][0] <= counts[0][0]
