"""The kill test notices what differs, and kills where it says; the runs themselves are its own."""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path

import pytest
import torch

from beags_plugin.system import whole_files

if sys.platform != "linux":
    pytest.skip("processes are forked, and looked at in /proc", allow_module_level=True)

import forked
import same_bits


def write_run(folder: Path, value: float = 1.0, seconds: float = 3.0) -> Path:
    """What stands for a complete run."""
    for name in ("nerfstudio_models/step-000000009.ckpt", "base/nerfstudio_models/step-000000004.ckpt"):
        (folder / name).parent.mkdir(parents=True)
        torch.save({"a": [torch.tensor([value, torch.nan])], "seconds": seconds}, folder / name)
    (folder / "prepared/masks").mkdir(parents=True)
    torch.save({"keys": torch.arange(3)}, folder / "prepared/grid.pt")
    (folder / "prepared/masks/a.png").write_bytes(b"picture")
    (folder / "held_out.json").write_text(json.dumps([{"psnr": value, "seconds": seconds}]))
    return folder


def test_runs_are_the_same_but_for_clocks(tmp_path):
    one = write_run(tmp_path / "one")
    assert same_bits.run_differences(one, write_run(tmp_path / "other", seconds=4.0)) == []
    found = same_bits.run_differences(one, write_run(tmp_path / "third", value=1.0000001))
    assert [name.split("/")[-1] for name in found] == ["0", "0", "psnr"]  # two tensors and the curve
    negative = write_run(tmp_path / "fourth", value=0.0), write_run(tmp_path / "fifth", value=-0.0)
    assert len(same_bits.run_differences(*negative)) == 2  # equal numbers, other bits


@pytest.mark.parametrize("name", ["prepared/masks/a.png", "prepared/grid.pt", "held_out.json"])
def test_what_is_missing_or_left_is_found(tmp_path, name):
    one, other = write_run(tmp_path / "one"), write_run(tmp_path / "other")
    (other / name).unlink()
    assert same_bits.run_differences(one, other) == [f"only in one: {name}"]
    (one / ".b.part").touch()
    assert f"left behind: {one}/.b.part" in same_bits.run_differences(other, one)


def test_half_an_exported_file_is_found_and_a_hidden_one_is_not(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        folder.mkdir()
        (folder / "cup.ply").write_bytes(b"0123456789")
        (folder / "box.ply").write_bytes(b"0123456789")
    (other / "box.ply").unlink()
    (other / ".box.ply.part").write_bytes(b"012")
    assert same_bits.half_written(one, other) == []
    (other / "box.ply").write_bytes(b"012")
    assert same_bits.half_written(one, other) == [str(other / "box.ply")]
    found = same_bits.export_differences(one, other)
    assert any("box.ply has other bytes" in told for told in found) and any("left behind" in told for told in found)


@pytest.mark.parametrize("share, part", [(0.5, 500), (1.1, 1000)])
def test_a_process_ends_in_the_write_that_is_chosen(tmp_path, share, part):
    def write() -> None:
        with forked.killed_in_write(".ckpt", 2, share):
            for name in ("one.ckpt", "between.json", "two.ckpt", "three.ckpt"):
                whole_files.write_whole(tmp_path / name, lambda file: [file.write(bytes(100)) for _ in range(10)])

    assert forked.run(write, tmp_path / "log") == -signal.SIGKILL
    there = {path.name: path.stat().st_size for path in tmp_path.iterdir() if path.name != "log"}
    assert there == {"one.ckpt": 1000, "between.json": 1000, ".two.ckpt.part": part}


def test_a_process_ends_before_a_file_of_another_library_takes_its_place(tmp_path):
    def write() -> None:
        from beags_plugin.extraction.files import whole_file

        with forked.killed_in_write("", 2, 0.5):
            whole_files.write_whole(tmp_path / "one", lambda file: file.write(bytes(10)))
            for name in ("two", "three"):
                with whole_file(tmp_path / name) as part:
                    part.write_bytes(bytes(20))

    assert forked.run(write, tmp_path / "log") == -signal.SIGKILL
    there = {path.name: path.stat().st_size for path in tmp_path.iterdir() if path.name != "log"}
    assert there == {"one": 10, ".two.part": 20}


def test_a_process_ends_in_the_call_that_is_chosen(tmp_path):
    class Work:
        def step(self, number: int) -> int:
            (tmp_path / str(number)).touch()
            time.sleep(0.0 if number < 3 else 60.0)
            return number

    def work() -> None:
        with forked.killed_in_call(Work, "step", 3, 0.01):
            assert [Work().step(number) for number in (1, 2)] == [1, 2]
            Work().step(3)

    assert forked.run(work, tmp_path / "log") == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == {"1", "2", "3", "log"}


def test_a_process_is_killed_after_its_cpu_time_or_ends_itself(tmp_path):
    def work() -> None:
        while True:
            pass

    code, used = forked.kill_after(work, tmp_path / "log", 0.1)
    assert code == -signal.SIGKILL and used >= 0.1
    assert forked.kill_after(lambda: sys.exit(7), tmp_path / "log", 100.0)[0] == 7
    assert forked.kill_after(lambda: None, tmp_path / "log", 100.0)[0] == 0
    assert forked.run(lambda: {}["missing"], tmp_path / "log") == 1 and "KeyError" in (tmp_path / "log").read_text()
