"""A run that is killed and resumed ends bit for bit as without the break."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from places import SUPPORT

pytest.importorskip("nerfstudio")

from resumed_runs import (
    STEPS,
    Killed,
    assert_same_run,
    checkpoint_of,
    interrupted,
    kill_at,
    killed,
    resume_to_end,
    run_to_end,
    short_config,
)
from same_bits import differences, without_clocks

from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.preparation import pipeline as preparation
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import UserError

LAST = sum(STEPS) - 1


@pytest.fixture
def data(short_run):
    return short_run / "data"


@pytest.fixture
def whole(short_run):
    """The run without a break; tests that change it copy it."""
    return short_run / "run"


def test_the_run_grows_and_prepares(whole):
    saved = checkpoint_of(whole)
    assert saved["step"] == LAST and int(saved["pipeline"]["_model.refined_steps"]) == STEPS[1]
    assert len(saved["pipeline"]["_model.gauss_params.means"]) != 300  # those of the seed points
    assert saved["beags"]["parts"]["refinement"] == {"prepared": True, "evaluated": True}


# The steps are after growth, the last of the base and the first of refinement; the test of many kills has others.
@pytest.mark.parametrize(("step", "after"), [(36, True), (44, True), (45, False)])
def test_a_killed_run_ends_as_the_whole_one(data, whole, tmp_path, monkeypatch, step, after):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, step, after))
    resume_to_end(run)
    assert_same_run(run, whole)
    assert not list(run.rglob("*.part"))


def test_a_run_that_is_killed_again_and_again(data, whole, tmp_path, monkeypatch):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 15))
    for step in (30, 46, 52):
        with monkeypatch.context() as patch:
            kill_at(patch, step)
            with pytest.raises(Killed):
                resume_to_end(run)
    resume_to_end(run)
    assert_same_run(run, whole)


STAGES = ["render_depths", "reprojected_masks", "contributions", "build_visibility_grid"]


def stage_module(name):
    from beags_plugin.refiners import bea

    return bea if name == "build_visibility_grid" else preparation


@pytest.mark.parametrize("name", STAGES)
def test_a_kill_in_the_preparation_ends_as_the_whole_one(data, whole, tmp_path, monkeypatch, name):
    """The preparation that was interrupted is made again, from the scene that was saved before it."""
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: patch.setattr(stage_module(name), name, killed))
    resume_to_end(run)
    assert_same_run(run, whole)


@pytest.mark.parametrize("name", ["write_run", "write_mask"])
def test_a_kill_while_the_base_or_the_masks_are_written(data, whole, tmp_path, monkeypatch, name):
    from beags_plugin.plugin.training import prepared_files, refinement

    run, module = tmp_path / "run", refinement if name == "write_run" else prepared_files
    interrupted(data, run, monkeypatch, lambda patch: patch.setattr(module, name, killed))
    resume_to_end(run)
    assert_same_run(run, whole)


@pytest.mark.parametrize("at", [14, 44, LAST])
def test_a_kill_in_the_middle_of_a_checkpoint_leaves_the_former_one(data, whole, tmp_path, monkeypatch, at):
    run, save = tmp_path / "run", torch.save

    def kill(patch):
        def half(content, file):
            if isinstance(content, dict) and content.get("step") == at and "beags" in content:
                file.write(b"half of it")
                raise Killed
            save(content, file)

        patch.setattr(torch, "save", half)

    interrupted(data, run, monkeypatch, kill, steps_per_save=7)
    assert [path.suffix for path in run.glob(".*.part")] == [".part"]
    assert all(torch.load(path, weights_only=True)["step"] < at for path in run.glob("nerfstudio_models/*"))
    resume_to_end(run)
    assert not list(run.rglob(".*.part"))
    assert_same_run(run, whole)


def test_resuming_by_load_dir_into_another_folder(data, whole, tmp_path, monkeypatch):
    first, second = tmp_path / "first", tmp_path / "second"
    interrupted(data, first, monkeypatch, lambda patch: kill_at(patch, 53))
    config = short_config(data, second)
    config.load_dir = first / "nerfstudio_models"
    run_to_end(config)
    assert_same_run(second, whole)


def test_refinement_of_a_loaded_base_is_resumed(data, whole, tmp_path, monkeypatch):
    base = whole / "base" / "nerfstudio_models"
    options = {"pipeline.model.base_steps": 0}
    runs = [tmp_path / name for name in ("whole", "killed")]
    configs = [short_config(data, run, **options) for run in runs]
    for config in configs:
        config.load_dir = base
    run_to_end(configs[0])
    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_at(patch, 9, after=True)
        run_to_end(configs[1])
    resume_to_end(runs[1])
    assert differences(*(without_clocks(checkpoint_of(run)) for run in runs)) == []


def test_another_run_into_the_folder_leaves_no_mask_of_the_former(data, tmp_path):
    former = tmp_path / "run/prepared/masks/former.png"
    former.parent.mkdir(parents=True)
    former.touch()
    run_to_end(short_config(data, tmp_path / "run"))
    assert list(former.parent.iterdir()) and not former.exists()


def test_a_run_of_a_gpu_goes_on_without_one_if_asked(data, tmp_path, monkeypatch):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 20))
    config = run / "config.yml"
    config.write_text(config.read_text().replace("device_type: cpu", "device_type: cuda"))
    assert "device_type: cuda" in config.read_text()
    if not torch.cuda.is_available():
        with pytest.raises(UserError, match="beags resume: --device cpu"):
            resume_to_end(run)
    resume_to_end(run, "cpu")
    assert checkpoint_of(run)["step"] == LAST


def test_a_kill_before_the_first_checkpoint_starts_again(data, whole, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 5))
    assert not (run / "nerfstudio_models").exists()
    resume_to_end(run)
    assert "starts from the beginning" in capsys.readouterr().out
    assert_same_run(run, whole)


def test_a_kill_between_the_last_checkpoint_and_the_report(data, whole, tmp_path, monkeypatch):
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: patch.setattr(BeagsTrainer, "_write_report", killed))
    assert checkpoint_of(run)["step"] == LAST and not (run / "training.json").exists()
    resume_to_end(run)
    assert json.loads((run / "training.json").read_text())["seconds"]["refinement"] > 0
    assert_same_run(run, whole)


@pytest.mark.slow("trains until it is killed, and on")
def test_a_real_kill(data, whole, tmp_path):
    """SIGKILL from outside while a process trains."""
    run = tmp_path / "run"
    code = (
        "import sys, time; from pathlib import Path; from resumed_runs import *\n"
        "from beags_plugin.plugin.trainer import BeagsTrainer\n"
        "train = BeagsTrainer.train_iteration\n"
        "def slow(self, step):\n"
        "    time.sleep(600 if step == 50 else 0.02)\n"  # It waits for the kill.
        "    return train(self, step)\n"
        "BeagsTrainer.train_iteration = slow\n"
        f"run_to_end(short_config(Path({str(data)!r}), Path({str(run)!r})))"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SUPPORT), os.getcwd()])}
    with subprocess.Popen(bound([sys.executable, "-c", code]), env=environment, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 600
        while not any(run.glob("nerfstudio_models/step-0000000[234]?.ckpt")):  # one of step 20 or later
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert not (run / "training.json").exists()
    resume_to_end(run)
    assert_same_run(run, whole)
    report = json.loads((run / "training.json").read_text())
    assert report["seconds"]["base training"] > 0.3  # the killed process's too
