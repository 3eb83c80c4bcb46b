"""Ctrl-C, locks, folders that hold another run, and what cannot be resumed."""

from __future__ import annotations

import os
import shutil
import signal
import threading

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import (
    STEPS,
    assert_same_run,
    checkpoint_of,
    interrupted,
    kill_at,
    resume_to_end,
    run_to_end,
    short_config,
)

from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.runs.read import read_run
from beags_plugin.system.errors import UserError

LAST = sum(STEPS) - 1


@pytest.fixture
def data(short_run):
    return short_run / "data"


@pytest.fixture
def whole(short_run):
    """The run without a break; tests that change it copy it."""
    return short_run / "run"


def test_ctrl_c_saves_the_step_and_a_resume_goes_on(data, whole, tmp_path, monkeypatch):
    run, train = tmp_path / "run", BeagsTrainer.train_iteration
    with monkeypatch.context() as patch:

        def iteration(self, step):
            if step == 24:
                signal.raise_signal(signal.SIGTERM)
            return train(self, step)

        patch.setattr(BeagsTrainer, "train_iteration", iteration)
        with pytest.raises(KeyboardInterrupt):
            run_to_end(short_config(data, run))
    assert checkpoint_of(run)["step"] == 24
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    resume_to_end(run)
    assert_same_run(run, whole)


def test_a_new_run_into_the_folder_of_another_is_not_taken_for_it(data, whole, tmp_path, monkeypatch):
    run = tmp_path / "run"
    run_to_end(short_config(data, run, **{"machine.seed": 7}))
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 5), overwrite=True)
    assert [path.name for path in (run / "replaced_models").iterdir()] == [f"step-{LAST:09d}.ckpt"]
    resume_to_end(run)
    assert_same_run(run, whole)
    assert not (run / "replaced_models").exists()


def test_a_finished_run_is_replaced_only_if_asked_for(data, whole, tmp_path, monkeypatch):
    run = shutil.copytree(whole, tmp_path / "my run")
    before = contents(run)
    with pytest.raises(UserError, match=r"my run holds a run: .*beags resume '.*/my run'.*--overwrite.*--run-dir"):
        run_to_end(short_config(data, run))
    assert contents(run) == before
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 5), overwrite=True)
    with pytest.raises(UserError, match="holds a run"):  # its checkpoint is in replaced_models
        run_to_end(short_config(data, run))
    assert "overwrite: false" in (run / "config.yml").read_text()  # ns-train --load-config reads it.


def test_a_refused_start_in_the_folder_of_another_run_changes_nothing_there(data, whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    before = contents(run)
    config = short_config(data, run, overwrite=True, **{"pipeline.model.refine_steps": 0})
    config.pipeline.model.start_from = tmp_path / "nothing.ply"
    with pytest.raises(UserError, match="nothing.ply"):
        run_to_end(config)
    assert contents(run).keys() == before.keys()
    assert all(after[0] == before[path][0] for path, after in contents(run).items())


def contents(folder):
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("again", ["resume", "ns-train"])
def test_a_run_that_is_training_is_left_alone(data, whole, tmp_path, again):
    """Resuming is refused, and so is ns-train, which writes config.yml first."""
    import fcntl

    from beags_plugin.system.lock import LOCK, run_lock

    run = shutil.copytree(whole, tmp_path / "run")
    (run / ".half.part").touch()
    before = contents(run)
    with open(run / LOCK, "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # Another process would do this.
        with pytest.raises(UserError, match="being trained by another process"):
            resume_to_end(run) if again == "resume" else run_to_end(short_config(data, run, steps_per_save=99))
    assert contents(run) == before
    run_lock(run).release()


def test_the_lock_is_held_from_the_first_file_on(data, tmp_path):
    """Two that start at once: one is refused."""
    from filelock import FileLock, Timeout

    from beags_plugin.system.lock import LOCK, run_lock

    config = short_config(data, tmp_path / "run")
    config.save_config()
    config.save_config()  # It is not refused by itself.
    with pytest.raises(Timeout):
        FileLock(tmp_path / "run" / LOCK).acquire(blocking=False)
    run_lock(tmp_path / "run").release()  # the trainer takes it over so
    run_lock(tmp_path / "run").release()


def test_ctrl_c_after_the_end_is_quiet(data, tmp_path, monkeypatch, capsys):
    """A viewer that stays open after the training is ended so."""
    from nerfstudio.engine.trainer import Trainer

    run = tmp_path / "run"
    config = short_config(data, run, **{"pipeline.model.base_steps": 3, "pipeline.model.refine_steps": 0})
    after = Trainer._after_train

    def waiting(self):
        after(self)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "_after_train", waiting)
    run_to_end(config)
    assert (run / "training.json").exists() and "Stopped" not in capsys.readouterr().out


def test_ctrl_c_ends_a_training_that_the_viewer_has_paused(data, tmp_path, monkeypatch):
    run, train = tmp_path / "run", BeagsTrainer.train_iteration

    def iteration(self, step):
        if step == 4:
            self.training_state = "paused"
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        return train(self, step)

    monkeypatch.setattr(BeagsTrainer, "train_iteration", iteration)
    with pytest.raises(KeyboardInterrupt):
        run_to_end(short_config(data, run))
    assert checkpoint_of(run)["step"] == 4


def edit_checkpoint(run, edit):
    (path,) = (run / "nerfstudio_models").iterdir()
    content = torch.load(path, weights_only=True)
    edit(content)
    torch.save(content, path)
    return path


def test_what_cannot_be_resumed_is_refused_in_one_sentence(data, whole, tmp_path, monkeypatch):
    with pytest.raises(UserError, match="complete run"):
        resume_to_end(whole)
    with pytest.raises(UserError, match="without the state of its training"):
        resume_to_end(whole / "base")
    with pytest.raises(UserError, match="cannot be read"):
        resume_to_end(tmp_path / "nowhere")
    run = tmp_path / "run"
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, 50))
    path = edit_checkpoint(run, lambda content: content["beags"].update(version=99))
    with pytest.raises(UserError, match="newer version of beags: update"):
        resume_to_end(run)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="is damaged"):
        resume_to_end(run)
    with pytest.raises(UserError, match="is damaged"):
        read_run(run / "config.yml")  # extract, export, render and eval too
