"""A training keeps no more with every step, and leaves nothing behind; and the script that says so would notice it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip("nerfstudio")
if sys.platform != "linux":
    pytest.skip("/proc tells what a process holds, on Linux", allow_module_level=True)

import long_run


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """150 steps, with curves, checkpoints, pictures and held-out measurements among them."""
    options = ("--steps-per-save", "40", "--steps-per-eval-image", "30", "--steps-per-held-out", "50")
    return long_run.trained(tmp_path_factory.mktemp("run"), 60, 90, 5, *options)


def test_a_training_leaves_nothing_behind(record):
    _, failures = long_run.judged(record)
    assert [told for told in failures if not told.startswith("memory")] == []  # too short to say how memory goes on
    assert record[-2]["step"] == 149 and record[-1]["phase"] == "after"
    assert any(".lock" in file for file in record[5]["files"])  # it sees what is held meanwhile
    assert len(record[5]["python_threads"]) > len(record[-1]["python_threads"])


def made_up(change=lambda line: line) -> list[dict]:
    """A record of 100 looks at a refinement; ``change`` gets each line."""
    still = {"threads": ["a", "b"], "python_threads": ["a"], "files": ["/dev/null"], "children": []}
    lines = [{"step": 10 * i, "phase": "refinement", "memory_mb": 900.0 + (i % 3) / 10, **still} for i in range(100)]
    ends = [{"step": None, "phase": phase, "memory_mb": 800.0, **still} for phase in ("before", "after")]
    return [change(dict(line)) for line in (ends[0], *lines, ends[1])]


def test_a_flat_run_passes():
    growth, failures = long_run.judged(made_up())
    assert abs(growth) < 0.1 and failures == []


def test_one_jump_is_no_growth_and_a_kilobyte_a_step_is():
    def jump(line):
        return {**line, "memory_mb": line["memory_mb"] + 30.0 * (line["step"] == 700)}

    def leak(line):
        return {**line, "memory_mb": line["memory_mb"] + 0.005 * (line["step"] or 0)}

    assert long_run.judged(made_up(jump))[1] == []
    growth, failures = long_run.judged(made_up(leak))
    assert growth == pytest.approx(2.45, abs=0.1) and len(failures) == 1 and "memory grows" in failures[0]


@pytest.mark.parametrize(
    "name, what", [("files", "/tmp/a"), ("python_threads", "Thread-3"), ("children", 77), ("files", "/dev/null")]
)
def test_what_is_left_behind_is_named(name, what):
    def left(line):
        return {**line, name: [*line[name], what]} if line["phase"] == "after" else line

    (told,) = long_run.judged(made_up(left))[1]
    assert "left behind" in told and repr(what) in told


def test_a_thread_for_every_step_is_noticed():
    def more(line):
        return {**line, "threads": ["a"] * (line["step"] or 1)}

    assert any("number of threads" in told for told in long_run.judged(made_up(more))[1])


def test_processes_of_a_session_are_found():
    command = ["sh", "-c", "sleep 100 & wait"]
    with subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL) as leader:
        try:
            while len(found := long_run.in_session(leader.pid)) < 2:
                assert leader.poll() is None
            assert sorted(found) in (["sh", "sh"], ["sh", "sleep"])  # it may not be another program yet
            leader.kill()
            leader.wait()
            assert len(long_run.in_session(leader.pid)) == 1  # the orphan
        finally:
            os.killpg(leader.pid, signal.SIGKILL)
