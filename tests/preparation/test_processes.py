"""The stages before refinement, split over processes: what one process finds, bit for bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import preparation_in_processes
import pytest
import steps_in_processes
import torch
import torch.distributed as dist
from places import ROOT

from beags_plugin.system import processes
from beags_plugin.system.child_processes import bound
from beags_plugin.system.processes import each_view

PROGRAM = Path(preparation_in_processes.__file__)
needs_gloo = pytest.mark.skipif(not dist.is_gloo_available(), reason="torch was built without gloo")


def test_alone_views_come_one_after_the_other():
    calls, told = [], []

    def work(index):
        calls.append(index)
        return index * index

    views = each_view(4, work, lambda done, count: told.append((done, count)))
    assert next(views) == 0 and calls == [0]  # nothing is done before it is asked for
    assert list(views) == [1, 4, 9]
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert list(each_view(0, work)) == []


def test_tensors_of_a_gpu_travel_over_the_cpu():
    """There is no GPU here: the device "meta" stands for this process's, and a copy on the CPU for what was sent."""
    values = torch.arange(3.0)
    result = {"a": [values, 1], "b": (processes._FromGpu(values), "text")}
    there = processes._unpacked(result, torch.device("meta"))
    assert there["a"][0] is values and there["a"][1] == 1 and there["b"][1] == "text"
    assert there["b"][0].is_meta and isinstance(there["b"], tuple)
    assert processes._gpu_of(there) == torch.device("meta") and processes._gpu_of(result) is None
    packed = processes._packed((values, None))
    assert packed[0] is values and packed[1] is None
    if torch.cuda.is_available():
        sent = processes._packed([values.cuda()])[0]
        assert isinstance(sent, processes._FromGpu) and sent.values.is_cpu and torch.equal(sent.values, values)


def in_two_processes(program: Path, folder: Path, *more: Path) -> list:
    """What each of two processes finds; ``more`` arguments of theirs."""
    root = str(ROOT)
    folder.mkdir()

    def start(rank):
        files = [str(path) for path in (folder / "meeting", folder / str(rank), *more)]
        command = [sys.executable, str(program), str(rank), "2", *files]
        return subprocess.Popen(bound(command, signal.SIGKILL), cwd=root, env=environment(root))

    running = [start(0), start(1)]
    try:
        assert [process.wait(timeout=300) for process in running] == [0, 0]
    finally:
        for process in running:
            process.kill()
    return [torch.load(folder / str(rank)) for rank in (0, 1)]


@needs_gloo
def test_steps_of_two_processes_are_those_of_one_that_sees_both_views(tmp_path):
    alone = steps_in_processes.trained(0, 1)
    for found in in_two_processes(Path(steps_in_processes.__file__), tmp_path / "steps"):
        *exact, total = zip(found, alone, strict=True)
        assert all(torch.equal(a, b) for a, b in exact)
        torch.testing.assert_close(*total)  # a sum over all steps, in another order
    start = steps_in_processes.labelled_views(4, 0.15)[0]
    assert (alone[0] - start.means).abs().max() > 0.01  # they did move


@needs_gloo
def test_two_processes_find_what_one_finds_and_reuse_it_together(tmp_path):
    fresh = in_two_processes(PROGRAM, tmp_path / "first", tmp_path / "kept")
    for file in (tmp_path / "kept/voxel").glob("voxel grids-*"):
        file.unlink()  # done again, by both
    again = in_two_processes(PROGRAM, tmp_path / "again", tmp_path / "kept")
    for mean, total in (result["exchanged"] for result in (*fresh, *again)):
        assert mean.tolist() == [0.0, 1.5, 3.0] and total.tolist() == [3]
    for method in preparation_in_processes.METHODS:
        alone, told = preparation_in_processes.found(method)
        assert len(alone[-3]) > 10  # voxels
        for found, findings in (result[method] for result in (*fresh, *again)):
            assert len(found) == len(alone)
            assert all(torch.equal(a, b) for a, b in zip(found, alone, strict=True))
            assert [line.removesuffix(" (kept from before)") for line in findings] == told
        assert not any("kept from before" in line for result in fresh for line in result[method][1])
        for result in again:
            kept = [line for line in result[method][1] if "kept from before" in line]
            assert len(kept) == len(told) - (method == "voxel")
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["pairwise", "voxel"]


def environment(root: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
