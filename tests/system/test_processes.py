"""Steps of two processes, whose gradients are averaged: those of one process that sees both views."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import steps_in_processes
import torch
import torch.distributed as dist
from places import ROOT

from beags_plugin.system.child_processes import bound
from beags_plugin.system.processes import each_view

PROGRAM = Path(steps_in_processes.__file__)
needs_gloo = pytest.mark.skipif(not dist.is_gloo_available(), reason="torch was built without gloo")


def test_alone_views_come_one_after_the_other():
    calls, reported = [], []

    def work(index):
        calls.append(index)
        return index * index

    views = each_view(4, work, lambda done, count: reported.append((done, count)))
    assert next(views) == 0 and calls == [0]  # nothing is done before it is asked for
    assert list(views) == [1, 4, 9]
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert list(each_view(0, work)) == []


def in_two_processes(folder: Path) -> list:
    """Return the results of two processes."""
    root = str(ROOT)
    environment = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    folder.mkdir()

    def start(rank):
        files = [str(path) for path in (folder / "meeting", folder / str(rank))]
        command = [sys.executable, str(PROGRAM), str(rank), "2", *files]
        return subprocess.Popen(bound(command, signal.SIGKILL), cwd=root, env=environment)

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
    for found in in_two_processes(tmp_path / "steps"):
        *exact, total = zip(found, alone, strict=True)
        assert all(torch.equal(a, b) for a, b in exact)
        torch.testing.assert_close(*total)  # a sum over all steps, in another order
    start = steps_in_processes.labelled_views(4, 0.15)[0]
    assert (alone[0] - start.means).abs().max() > 0.01  # they did move
