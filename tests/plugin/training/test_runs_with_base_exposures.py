"""Runs whose base begins the exposures of its photos: resumed, alike for all numbers of threads and processes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, checkpoint_of, interrupted, kill_at, resume_to_end, run_to_end, short_config
from trackless_scenes import SMALL, written
from training_in_processes import train_in_two

from beags_plugin.plugin.runs.read import read_run
from beags_plugin.plugin.training import exposure as learning

BASE_STEP = 2  # The base has 45 steps.


@pytest.fixture(scope="module")
def small(shared):
    """Photos of many exposures that see points, but nothing says which."""
    return shared("trackless_small", lambda at: written(at, replace(SMALL, exposure=1.5), points=True)) / "data"


def asking(data: Path, run: Path, **options):
    """The config of a short run whose base begins exposures, whatever it shows."""
    return short_config(data, run, **{"pipeline.model.exposure": "on", **options})


@pytest.fixture(scope="module")
def whole(shared, small):
    return shared("trackless_run", lambda at: run_to_end(asking(small, at / "run"))) / "run"


def test_a_base_begins_them_at_its_step(whole, small, tmp_path):
    exposures = read_run(whole / "config.yml").exposures
    assert exposures is not None and torch.allclose(exposures.affine.mean(dim=0), torch.eye(3, 4), atol=1e-6)
    part = checkpoint_of(whole)["beags"]["parts"]["exposure"]
    assert not torch.equal(part["start"], torch.eye(3, 4).repeat(8, 1, 1))
    assert float(part["adam"]["state"][0]["step"]) == 57 - BASE_STEP
    assert all("psnr_fit" in each for each in json.loads((whole / "held_out.json").read_text()))


@pytest.mark.parametrize(("step", "after"), [(BASE_STEP, False), (8, True), (30, True), (50, False)])
def test_a_killed_run_ends_as_the_whole_one(small, whole, tmp_path, monkeypatch, step, after):
    options = {"pipeline.model.exposure": "on"}
    interrupted(small, tmp_path / "run", monkeypatch, lambda patch: kill_at(patch, step, after), **options)
    resume_to_end(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


def test_the_number_of_threads_and_streaming_are_no_matter(small, whole, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2 if before == 1 else 1)
    try:
        run_to_end(asking(small, tmp_path / "run", **{"pipeline.datamanager.stream": "always"}))
    finally:
        torch.set_num_threads(before)
    assert_same_run(tmp_path / "run", whole)


def test_a_base_that_shows_no_difference_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "LEAST_SPREAD", 1.0)  # After two steps the surface is not yet right.
    data = written(tmp_path, SMALL, points=True)
    asked, found = [], learning.gains_of_points
    monkeypatch.setattr(learning, "gains_of_points", lambda *given: asked.append(given) or found(*given))
    run_to_end(short_config(data, tmp_path / "auto"))
    run_to_end(short_config(data, tmp_path / "off", **{"pipeline.model.exposure": "off"}))
    assert_same_run(tmp_path / "auto", tmp_path / "off")
    assert "exposure" not in checkpoint_of(tmp_path / "auto")["beags"]["parts"] and len(asked) == 1


def test_without_any_point_they_begin_at_the_identity_with_the_run(tmp_path):
    run_to_end(asking(written(tmp_path, replace(SMALL, exposure=1.5)), tmp_path / "run"))
    part = checkpoint_of(tmp_path / "run")["beags"]["parts"]["exposure"]
    assert torch.equal(part["start"], torch.eye(3, 4).repeat(8, 1, 1))
    assert float(part["adam"]["state"][0]["step"]) == 57


def test_a_scene_to_start_from_is_asked_at_once(small, whole, tmp_path):
    config = asking(small, tmp_path / "run", **{"pipeline.model.base_steps": 10, "pipeline.model.refine_steps": 0})
    config.pipeline.model.start_from = whole
    run_to_end(config)
    assert float(checkpoint_of(tmp_path / "run")["beags"]["parts"]["exposure"]["adam"]["state"][0]["step"]) == 10


@pytest.mark.skipif(not torch.distributed.is_gloo_available(), reason="torch was built without gloo")
def test_exposures_are_alike_in_two_processes(small, tmp_path):
    data = shutil.copytree(small, tmp_path / "data")
    train_in_two(data, tmp_path, **{"pipeline.model.exposure": "on"})
    first, second = (json.loads((tmp_path / f"rank{rank}.json").read_text())["end"] for rank in (0, 1))
    assert first["exposures"] is not None and first["exposures"] == second["exposures"]
    assert first["_model.gauss_params.means"] == second["_model.gauss_params.means"]
