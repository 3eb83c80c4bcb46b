"""A training leaves nothing behind: the script that looks at long runs, over a short one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")
if sys.platform != "linux":
    pytest.skip("/proc tells what a process holds, on Linux", allow_module_level=True)

sys.path.insert(0, str(Path(__file__).parent.parent / "scripts"))
import long_run


def test_a_training_leaves_nothing_behind(tmp_path):
    """150 steps, with curves, checkpoints, pictures and held-out measurements among them."""
    options = ("--steps-per-save", "40", "--steps-per-eval-image", "30", "--steps-per-held-out", "50")
    record = long_run.trained(tmp_path, 60, 90, 5, *options)
    _, failures = long_run.judged(record)
    assert [told for told in failures if not told.startswith("memory")] == []  # too short to say how memory goes on
    assert record[-2]["step"] == 149 and record[-1]["phase"] == "after"
    assert any(".lock" in file for file in record[5]["files"])  # it sees what is held meanwhile
    assert len(record[5]["python_threads"]) > len(record[-1]["python_threads"])
