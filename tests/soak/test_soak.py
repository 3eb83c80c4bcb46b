"""The soak scripts run and notice what they look for; ``make soak`` runs them at length."""

from __future__ import annotations

import signal
import sys
from itertools import islice
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")
if sys.platform != "linux":
    pytest.skip("processes are forked, and looked at in /proc", allow_module_level=True)

import forked
import fuzz_parsers
import long_run
import same_bits
from parser_targets import TARGETS, Target, examine

from beags_plugin.system import whole_files

pytestmark = pytest.mark.slow("a training of thousands of steps, for its memory")


@pytest.mark.parametrize("name", TARGETS)
def test_changed_files_are_taken_or_refused(name):
    contents = islice(fuzz_parsers.changed(TARGETS[name].seeds(), 1), 40)
    assert [failure for failure in (fuzz_parsers.failure_of(name, content) for content in contents) if failure] == []
    answers = [examine(TARGETS[name], content) for content in TARGETS[name].seeds()]
    assert None in answers or name in ("run config", "seed points"), answers  # the files to begin with are good


def test_a_parser_that_fails_or_takes_forever_is_noticed(monkeypatch):
    def read(path: Path) -> None:
        if b"x" in path.read_bytes():
            raise KeyError("x")
        while b"y" in path.read_bytes():
            pass

    assert tuple(TARGETS) == fuzz_parsers.NAMES
    monkeypatch.setattr(fuzz_parsers, "SECONDS", 0.2)
    monkeypatch.setitem(TARGETS, "mask", Target("a", read, lambda: [b"a"]))
    assert fuzz_parsers.failure_of("mask", b"a") is None
    assert "KeyError" in (fuzz_parsers.failure_of("mask", b"x") or "")
    assert "TimeoutError: more than 0.2 s" in (fuzz_parsers.failure_of("mask", b"y") or "")


def write_run(folder: Path, value: float = 1.0, seconds: float = 3.0) -> Path:
    """Write what stands for a complete run."""
    for name in ("nerfstudio_models/step-000000009.ckpt", "base/nerfstudio_models/step-000000004.ckpt"):
        (folder / name).parent.mkdir(parents=True)
        torch.save({"a": [torch.tensor([value, torch.nan])], "seconds": seconds}, folder / name)
    (folder / "prepared/masks").mkdir(parents=True)
    torch.save({"keys": torch.arange(3)}, folder / "prepared/grid.pt")
    (folder / "prepared/masks/a.png").write_bytes(b"picture")
    return folder


def test_runs_are_the_same_but_for_clocks(tmp_path):
    one = write_run(tmp_path / "one")
    assert same_bits.run_differences(one, write_run(tmp_path / "other", seconds=4.0)) == []
    found = same_bits.run_differences(one, write_run(tmp_path / "third", value=1.0000001))
    assert [name.split("/")[-1] for name in found] == ["0", "0"]  # two tensors
    (tmp_path / "other/prepared/masks/a.png").unlink()
    (tmp_path / "other/.b.part").touch()
    found = same_bits.run_differences(one, tmp_path / "other")
    assert f"left behind: {tmp_path}/other/.b.part" in found and "only in one: prepared/masks/a.png" in found


@pytest.mark.parametrize("share, part", [(0.5, 500), (1.1, 1000)])
def test_a_process_ends_in_the_write_that_is_chosen(tmp_path, share, part):
    def write() -> None:
        with forked.killed_in_write(".ckpt", 2, share):
            for name in ("one.ckpt", "between.json", "two.ckpt", "three.ckpt"):
                whole_files.write_whole(tmp_path / name, lambda file: [file.write(bytes(100)) for _ in range(10)])

    assert forked.run(write, tmp_path / "log") == -signal.SIGKILL
    there = {path.name: path.stat().st_size for path in tmp_path.iterdir() if path.name != "log"}
    assert there == {"one.ckpt": 1000, "between.json": 1000, ".two.ckpt.part": part}


def test_a_training_leaves_nothing_behind(tmp_path):
    """Train 150 steps, with curves, checkpoints and pictures among them."""
    options = ("--steps-per-save", "40", "--steps-per-eval-image", "30")
    record = long_run.trained(tmp_path, 60, 90, 5, *options)
    _, failures = long_run.judged(record)
    # The run is too short to say how memory goes on.
    assert [line for line in failures if not line.startswith("memory")] == []
    assert record[-2]["step"] == 149 and record[-1]["phase"] == "after"
    assert any(".lock" in file for file in record[5]["files"])  # it sees what is held meanwhile


def test_a_kilobyte_a_step_and_what_is_left_behind_are_noticed():
    still = {"threads": ["a", "b"], "python_threads": ["a"], "files": ["/dev/null"], "children": []}
    lines = [{"step": 10 * i, "phase": "refinement", "memory_mb": 900.0 + (i % 3) / 10, **still} for i in range(100)]
    ends = [{"step": None, "phase": phase, "memory_mb": 800.0, **still} for phase in ("before", "after")]
    assert long_run.judged([ends[0], *lines, ends[1]])[1] == []
    leaking = [{**line, "memory_mb": line["memory_mb"] + 0.005 * line["step"]} for line in lines]
    growth, failures = long_run.judged([ends[0], *leaking, {**ends[1], "children": [77]}])
    assert growth == pytest.approx(2.45, abs=0.1)
    assert any("memory grows" in line for line in failures) and any("left behind" in line for line in failures)
