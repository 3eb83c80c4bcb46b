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

from beags_plugin.plugin.presets import preset_config
from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.plugin.training import memory_guard as forecasts
from beags_plugin.plugin.training.memory_guard import (
    MemoryWatch,
    check_memory,
    checks_of_run,
    forecast,
    is_out_of_memory,
)
from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import available_mb, memory_mb

VIEWS = [(1000, 750)] * 100


def of(preset: str, sizes=VIEWS, **overrides):
    return forecast(preset_config(preset, overrides, Path("test")), sizes, sizes[:10], seeds=5000)


def test_surfels_are_bounded_by_pixels_by_number_or_by_nothing():
    assert of("beags-fast").grown == 750_000  # one for 100 pixels
    assert of("beags-tiny").grown == 10_000
    assert of("beags").grown is of("beags").surfels is None
    assert of("beags-refine").grown == 5000  # nothing grows


def test_splits_at_borders_count():
    tiny, base = of("beags-tiny"), of("beags-tiny", **{"pipeline.model.refine_steps": 0})
    assert tiny.surfels == int(10_000 * forecasts.GROWTH_OF_SPLIT**2) and base.surfels == base.grown == 10_000
    unsplit = of("beags-tiny", **{"pipeline.model.split.rounds": 0})
    assert unsplit.surfels == 10_000 and "before those at borders" not in unsplit.told()
    more = of("beags-tiny", **{"pipeline.model.refine_rounds": 2})
    assert more.surfels == int(10_000 * forecasts.GROWTH_OF_SPLIT**4)


def test_disk_holds_the_base_the_prepared_masks_and_temporary_files_too():
    run, base = of("beags-tiny"), of("beags-tiny", **{"pipeline.model.refine_steps": 0})
    pixels = 75.0  # MB at a byte each
    assert base.temporary == 0 and base.disk == pytest.approx(forecasts.RUN_MB + 0.01 * base.disk_bytes_of_surfel)
    assert run.temporary == pytest.approx(forecasts.TEMPORARY_BYTES_OF_PIXEL * pixels)
    kept = forecasts.PREPARED_BYTES_OF_PIXEL + forecasts.DEPTH_BYTES_OF_PIXEL
    assert run.run_disk - base.run_disk == pytest.approx(kept * pixels)
    assert run.disk_bytes_of_surfel > base.disk_bytes_of_surfel > 2 * 3 * 4 * 23
    unbounded = of("beags")
    assert unbounded.disk == pytest.approx(unbounded.run_disk + 0.005 * unbounded.disk_bytes_of_surfel)
    assert f"room for {unbounded.room_on_disk:,} of them" in unbounded.told_of_disk()


def test_memory_grows_with_surfels_and_photos_and_not_with_streamed_ones():
    few, many = (
        of("beags-tiny", **{"pipeline.model.densify.max_surfels": n, "pipeline.model.split.rounds": 0})
        for n in (10_000, 1_010_000)
    )
    assert many.peak - few.peak == pytest.approx(few.bytes_of_surfel)  # a million of them, in MB
    assert 4 * 4 * 23 < few.bytes_of_surfel < 1000  # a gradient and two moments beside each of 23 numbers, and more
    kept = of("beags-tiny", VIEWS, **{"pipeline.datamanager.stream": "never"})
    assert kept.views >= 110 * 0.75 * 3 and of("beags-tiny", **{"pipeline.datamanager.stream": "always"}).views == 0
    pairwise = of("beags-tiny", **{"pipeline.model.prepare.reprojection": "pairwise"})
    assert pairwise.preparation - of("beags-tiny", **{"pipeline.model.prepare.reprojection": "voxel"}).preparation == (
        pytest.approx(75 * forecasts.PAIRWISE_BYTES_OF_PIXEL)
    )


def test_what_does_not_fit_is_refused_with_a_remedy():
    found = replace(of("beags-fast"), available=100_000.0, free_disk=1e6, free_temporary=1e6, one_disk=True)
    check_memory(found)
    told = r"with 1,920,000 Gaussians, 750,000 before .*; 1.0 GB are free.*downscale-factor 2.*check-memory"
    with pytest.raises(UserError, match=told):
        check_memory(replace(found, available=1000.0))
    with pytest.raises(
        UserError, match=r"the run needs about 4.06 GB at most .*; 0.5 GB are free: free some space, or"
    ):
        check_memory(replace(found, free_disk=500.0))
    with pytest.raises(UserError, match=r"temporary files need 0.60 GB and 0.10 GB are free there: .* TMPDIR"):
        check_memory(replace(found, free_temporary=100.0))
    enough = found.run_disk + 750_000 * found.disk_bytes_of_surfel / 1e6 + 1.0
    check_memory(replace(found, free_disk=enough, one_disk=False))
    with pytest.raises(UserError, match="the run needs"):  # temporary files lie there too
        check_memory(replace(found, free_disk=enough, one_disk=True))
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

    monkeypatch.setattr("beags_plugin.system.memory.Path", path)
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
    assert "50,000 before those at borders are split" in memory.sentence and memory.ok and disk.ok
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
