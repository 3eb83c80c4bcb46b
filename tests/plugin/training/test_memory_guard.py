"""A training that finds hardly any memory or disk stops with a sentence, and saves what it has."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import psutil
import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, checkpoint_of, resume_to_end, run_to_end, short_config
from run_folders import write_scene

from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.plugin.training import memory_guard
from beags_plugin.plugin.training.memory_guard import MemoryWatch, is_out_of_memory
from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import available_mb, memory_mb, peak_memory_mb


def test_the_system_reports_what_is_left():
    assert 0 < available_mb() < psutil.virtual_memory().total / 1e6
    assert 0 < memory_mb() <= peak_memory_mb() < psutil.virtual_memory().total / 1e6


def test_groups_limit_what_is_left(tmp_path, monkeypatch):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    for folder, limit, used in ((inner, "max", 5), (tmp_path / "a", "700000000", 500_000_000)):
        (folder / "memory.max").write_text(limit)
        (folder / "memory.current").write_text(str(used))
        (folder / "memory.stat").write_text("anon 1\ninactive_file 50000000\n")
    real = Path
    places = {"/proc/self/cgroup": tmp_path / "cgroup"}
    (tmp_path / "cgroup").write_text("0::/a/b\n")

    def path(first, *rest):
        return real(tmp_path, *rest) if first == "/sys/fs/cgroup" else places.get(first, real(first, *rest))

    monkeypatch.setattr("beags_plugin.system.memory.Path", path)
    assert available_mb() == pytest.approx(250.0)


def test_the_watch_reports_only_when_little_is_left(monkeypatch):
    watch = MemoryWatch("cpu")
    for left, speaks in ((memory_guard.LEAST_FREE_MB + 1, False), (memory_guard.LEAST_FREE_MB - 1, True)):
        monkeypatch.setattr(memory_guard, "available_mb", lambda left=left: left)
        assert (watch.short_of(MemoryWatch.EVERY) is not None) == speaks
    assert watch.short_of(MemoryWatch.EVERY + 1) is None and MemoryWatch("cuda").short_of(0) is None


def test_errors_of_memory_are_known():
    with pytest.raises(RuntimeError) as torchs:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert is_out_of_memory(torchs.value) and is_out_of_memory(MemoryError())
    assert is_out_of_memory(OSError(errno.ENOMEM, "Cannot allocate memory"))
    assert not is_out_of_memory(RuntimeError("shapes differ")) and not is_out_of_memory(OSError(errno.ENOSPC, "full"))


def test_a_training_stops_and_saves_when_memory_runs_out_and_goes_on_later(tmp_path, monkeypatch):
    data, run = write_scene(tmp_path / "data"), tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(MemoryWatch, "short_of", lambda self, step: "2 MB are left" if step == 20 else None)
        with pytest.raises(UserError) as stopped:
            run_to_end(short_config(data, run))
    message = f"2 MB are left: saved and stopped after step 19. Close other programs and go on with beags resume {run}"
    assert message in str(stopped.value)
    assert checkpoint_of(run)["step"] == 19
    resume_to_end(run)
    run_to_end(short_config(data, tmp_path / "whole"))
    assert_same_run(run, tmp_path / "whole")


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_a_training_that_gets_no_memory_reports_it_and_keeps_its_checkpoint(tmp_path, monkeypatch, error):
    data, run = write_scene(tmp_path / "data"), tmp_path / "run"
    save = BeagsTrainer.save_checkpoint

    def saved_and_no_more(self, step):
        save(self, step)
        if step >= 14:
            raise error

    monkeypatch.setattr(BeagsTrainer, "save_checkpoint", saved_and_no_more)
    with pytest.raises(UserError, match="memory ran out after step 14 .*the last checkpoint is whole.*beags resume"):
        run_to_end(short_config(data, run))
    assert checkpoint_of(run)["step"] == 14


@pytest.mark.parametrize(
    "name, message",
    [
        ("available_mb", "the machine has 20 MB of memory left: .*downscale-factor 2.*--no-check-memory"),
        ("free_disk_mb", "the disk of .*run has 20 MB left: .* choose another folder with --run-dir, or try"),
    ],
)
def test_a_run_without_room_is_refused_before_its_first_step(tmp_path, monkeypatch, name, message):
    data, run = write_scene(tmp_path / "data"), tmp_path / "run"
    monkeypatch.setattr(memory_guard, name, lambda *_: 20.0)
    with pytest.raises(UserError, match=message):
        run_to_end(short_config(data, run))
    assert not run.exists()


def test_temporary_files_need_room_too(tmp_path, monkeypatch):
    monkeypatch.setattr(memory_guard, "free_disk_mb", lambda folder: 1e6 if folder == tmp_path / "run" else 20.0)
    with pytest.raises(UserError, match="choose one for temporary files with TMPDIR"):
        memory_guard.check_room(tmp_path / "run", "cuda")


def test_the_disk_of_a_folder_yet_to_be_made_is_known(tmp_path):
    assert memory_guard.free_disk_mb(tmp_path / "a/b") == pytest.approx(shutil.disk_usage(tmp_path).free / 1e6, abs=100)
