"""Memory and disk of a run are told before it begins; a run that does not fit stops with a sentence, and saves."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import assert_same_run, checkpoint_of, resume_to_end, run_to_end, short_config
from run_folders import write_scene

from beags_plugin.errors import UserError
from beags_plugin.plugin import forecast as forecasts
from beags_plugin.plugin.forecast import MemoryWatch, check_memory, checks_of_run, forecast, is_out_of_memory
from beags_plugin.plugin.memory import available_mb, memory_mb
from beags_plugin.plugin.presets import preset_config
from beags_plugin.plugin.trainer import BeagsTrainer

VIEWS = [(1000, 750)] * 100


def of(preset: str, sizes=VIEWS, **overrides):
    return forecast(preset_config(preset, overrides, Path("test")), sizes, sizes[:10], seeds=5000)


def test_surfels_are_bounded_by_pixels_by_number_or_by_nothing():
    assert of("beags-fast").surfels == 750_000  # one for 100 pixels
    assert of("beags-tiny").surfels == 10_000
    assert of("beags").surfels is None
    assert of("beags-refine").surfels == 5000  # nothing grows


def test_memory_grows_with_surfels_and_photos_and_not_with_streamed_ones():
    few, many = (of("beags-tiny", **{"pipeline.model.densify.max_surfels": n}) for n in (10_000, 1_010_000))
    assert many.peak - few.peak == pytest.approx(few.bytes_of_surfel)  # a million of them, in MB
    assert 4 * 4 * 23 < few.bytes_of_surfel < 1000  # a gradient and two moments beside each of 23 numbers, and more
    kept = of("beags-tiny", VIEWS, **{"pipeline.datamanager.stream": "never"})
    assert kept.views >= 110 * 0.75 * 3 and of("beags-tiny", **{"pipeline.datamanager.stream": "always"}).views == 0
    pairwise = of("beags-tiny", **{"pipeline.model.prepare.reprojection": "pairwise"})
    assert pairwise.preparation - of("beags-tiny", **{"pipeline.model.prepare.reprojection": "voxel"}).preparation == (
        pytest.approx(75 * forecasts.PAIRWISE_BYTES_OF_PIXEL)
    )


def test_what_does_not_fit_is_refused_with_a_remedy():
    found = replace(of("beags-fast"), available=100_000.0, free_disk=1e6)
    check_memory(found)
    with pytest.raises(UserError, match=r"with 750,000 Gaussians; 1.0 GB are free.*downscale-factor 2.*check-memory"):
        check_memory(replace(found, available=1000.0))
    with pytest.raises(UserError, match=r"checkpoints need 1.1 GB of disk and 0.5 GB are free"):
        check_memory(replace(found, free_disk=500.0))
    check_memory(replace(found, available=None))  # nobody knows


def test_without_a_bound_the_room_is_told():
    found = replace(of("beags"), available=5000.0)
    assert found.room == int((5000.0 - (found.peak - found.program)) * 1e6 / found.bytes_of_surfel) > 0
    assert f"there is room for {found.room:,} of them" in found.told()
    check_memory(found)
    with pytest.raises(UserError, match="pixels-per-surfel"):
        check_memory(replace(found, available=100.0))


def test_the_system_tells_what_is_left():
    left = available_mb()
    if left is None:
        pytest.skip("this system does not tell how much memory is free")
    import psutil

    everywhere = psutil.virtual_memory()
    assert 0 < left < everywhere.total / 1e6
    assert left < everywhere.available / 1e6 + 2000  # other programs come and go; a control group may leave less
    assert memory_mb() == pytest.approx(psutil.Process().memory_info().rss / 1e6, rel=0.1)


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

    monkeypatch.setattr("beags_plugin.plugin.memory.Path", path)
    assert available_mb() == pytest.approx(250.0)


def test_the_watch_speaks_only_when_little_is_left(monkeypatch):
    watch = MemoryWatch("cpu")
    for left, speaks in ((None, False), (forecasts.LEAST_FREE_MB + 1, False), (forecasts.LEAST_FREE_MB - 1, True)):
        monkeypatch.setattr(forecasts, "available_mb", lambda left=left: left)
        assert (watch.short_of(MemoryWatch.EVERY) is not None) == speaks
    assert watch.short_of(MemoryWatch.EVERY + 1) is None and MemoryWatch("cuda").short_of(0) is None


def test_errors_of_memory_are_known():
    with pytest.raises(RuntimeError) as torchs:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert is_out_of_memory(torchs.value) and is_out_of_memory(MemoryError())
    assert is_out_of_memory(OSError(errno.ENOMEM, "Cannot allocate memory"))
    assert not is_out_of_memory(RuntimeError("shapes differ")) and not is_out_of_memory(OSError(errno.ENOSPC, "full"))


def test_the_doctor_tells_of_a_run(tmp_path):
    write_scene(tmp_path)
    memory, disk = checks_of_run(tmp_path, "beags-tiny")
    assert "50,000 Gaussians" in memory.sentence and memory.ok and disk.ok
    assert checks_of_run(tmp_path, "beags")[0].sentence.count("room for") == 1
    with pytest.raises(UserError, match="nowhere"):
        checks_of_run(tmp_path / "nowhere", "beags")


def test_a_training_stops_and_saves_when_memory_runs_out_and_goes_on_later(tmp_path, monkeypatch):
    data, run = write_scene(tmp_path / "data"), tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(MemoryWatch, "short_of", lambda self, step: "2 MB are left" if step == 20 else None)
        with pytest.raises(UserError) as stopped:
            run_to_end(short_config(data, run))
    told = f"2 MB are left: saved and stopped after step 19. Close other programs and go on with beags resume {run}"
    assert told in str(stopped.value)
    assert checkpoint_of(run)["step"] == 19
    resume_to_end(run)
    run_to_end(short_config(data, tmp_path / "whole"))
    assert_same_run(run, tmp_path / "whole")


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_a_training_that_gets_no_memory_says_so_and_keeps_its_checkpoint(tmp_path, monkeypatch, error):
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


def test_a_run_that_does_not_fit_is_refused_before_its_first_step(tmp_path, monkeypatch):
    data, run = write_scene(tmp_path / "data"), tmp_path / "run"
    monkeypatch.setattr(forecasts, "available_mb", lambda: 20.0)
    with pytest.raises(UserError, match="this run would take about .*0.0 GB are free"):
        run_to_end(short_config(data, run))
    assert not list(run.rglob("*.ckpt"))
