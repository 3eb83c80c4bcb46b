"""The benchmark runs end to end, says which goals are met, and measures what it says."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch
from places import ROOT

from beags_plugin.rasterizers import native
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import UserError
from benchmarks import goals, scenes
from benchmarks.measure import Result
from benchmarks.training_step import TrainingStep

KEYS = {
    "n", "width", "height", "backend", "isa", "threads", "forward_ms", "backward_ms", "ratio_to_torch",
    "lanes_per_pair", "peak_mb",
}  # fmt: skip
NATIVE = native.NativeRasterizer.unavailable() is None


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The file and the text that a quick run gives."""
    target = tmp_path_factory.mktemp("benchmark") / "result.json"
    done = subprocess.run(
        bound([sys.executable, ROOT / "benchmarks" / "rasterizer.py", "--quick", "--no-gsplat", "--json", target]),
        capture_output=True, text=True, cwd=target.parent, env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(target.read_text()), done.stdout


def test_rows_have_their_keys_and_positive_figures_and_goals_a_line(quick):
    result, text = quick
    assert result["rows"] and {row["backend"] for row in result["rows"]} == (
        {"native", "torch"} if NATIVE else {"torch"}
    )
    for row in result["rows"]:
        assert set(row) >= KEYS
        assert row["n"] > 0 and row["width"] > 0 and row["height"] > 0 and row["threads"] in (1, 2)
        assert row["forward_ms"] > 0 and row["backward_ms"] > 0 and row["ratio_to_torch"] > 0
        assert row["forward_median_ms"] >= row["forward_ms"] and row["calls"] >= 1
        assert row["peak_mb"] is None or row["peak_mb"] >= 0
        assert row["isa"] is None if row["backend"] == "torch" else row["isa"]
        assert row["lanes_per_pair"] >= 1 if row["backend"] == "native" else row["lanes_per_pair"] is None
    for row in result["rows"]:
        if row["backend"] == "torch":
            assert row["ratio_to_torch"] == 1
    assert not NATIVE or any(row["peak_mb"] is not None for row in result["rows"])
    lines = [line for line in text.splitlines() if line.startswith("goal ")]
    assert len(lines) == len(result["goals"]) >= 15
    assert all(
        goal["name"] in line and goal["bound"] in line for goal, line in zip(result["goals"], lines, strict=True)
    )


def test_the_file_names_machine_commit_and_command(quick):
    result, text = quick
    assert result["machine"]["cpu"] and result["machine"]["cores"] >= 1 and result["commit"] and result["torch"]
    assert result["command"].startswith("benchmarks/rasterizer.py --quick")
    assert result["command"] in text.replace("\n", " ") and result["machine"]["cpu"] in text


@pytest.mark.skipif(not NATIVE, reason=str(native.NativeRasterizer.unavailable()))
def test_the_step_is_measured_in_parts(quick):
    step = quick[0]["step"]
    assert set(step["whole_ms"]) == set(step["parts_ms"]) == {"base", "refinement", "many samples"}
    for kind, parts in step["parts_ms"].items():
        assert all(value > 0 for value in parts.values())
        assert ("occupancy loss" in parts) == (kind != "base")
    assert 0 <= step["sampled_share"] <= 1
    assert all(value > 0 for name, value in step["overhead"].items() if name != "size")


def test_a_wrong_size_is_a_sentence():
    for text in ("7q", "0/10x10", "5/10", "x"):
        with pytest.raises(UserError, match="there is no size"):
            scenes.parse_size(text)
    assert scenes.parse_size("3k/40x30") == scenes.Size(3000, 40, 30)
    assert [scenes.parse_size(size.name) for size in scenes.SIZES] == list(scenes.SIZES)


def test_a_step_in_parts_learns_what_a_whole_one_does():
    scene = scenes.make_scene(scenes.parse_size("150/40x30"))
    whole, parts = TrainingStep(scene, samples=5), TrainingStep(scene, samples=5)
    whole.run()
    assert {"SH colours", "occupancy loss", "Adam"} <= set(parts.run_parts())
    for name, parameter in whole.parameters.items():
        other = parts.parameters[name].grad
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
        assert torch.allclose(parameter.grad, other, rtol=1e-4, atol=1e-6 * float(parameter.grad.abs().max())), name


def _row(size, backend, isa, threads, ms, **more):
    where = {"n": size.n, "width": size.width, "height": size.height, "backend": backend, "isa": isa}
    return {
        **where,
        "threads": threads,
        "forward_ms": ms / 2,
        "backward_ms": ms / 2,
        "wall_ms": ms,
        "peak_mb": None,
        **more,
    }


def test_goals_are_judged_by_the_figures():
    large, medium = scenes.SIZES[2], scenes.SIZES[1]
    rows = [
        _row(large, "native", "avx512", 1, 90.0, peak_mb=120.0),
        _row(large, "native", "avx512", 2, 48.0),
        _row(large, "native", "scalar", 1, 720.0),
        _row(large, "native", "avx2", 1, 180.0),
        _row(large, "torch", None, 1, 9900.0),
        _row(medium, "torch", None, 1, 500.0),
        _row(medium, "native", "avx512", 1, 10.0),
    ]
    work = {"lanes": 140, "contributing": 100, "tile_pairs": 90, "box_pairs": 100}
    found = {g.name: g for g in goals.check_goals(Result(rows=rows, scenes=[{"size": "a", "work": work}]), "avx512")}
    verdicts = {name: goal.met for name, goal in found.items() if goal.met is not None}
    assert verdicts == {
        f"native against the torch reference, {medium.name}, 1 thread": False,  # 50x
        f"native against the torch reference, {large.name}, 1 thread": True,  # 110x
        f"avx2 against the scalar build, {large.name}, 1 thread": False,  # 4x
        f"avx512 against the scalar build, {large.name}, 1 thread": True,  # 8x
        f"2 threads against 1, {large.name}": True,  # 1.875x
        f"{large.name}, AVX-512, 1 thread (on a machine like the specification's)": True,
        "evaluated lanes per contributing pair": True,
        "(tile, surfel) pairs over those of 3.33-sigma boxes": False,
        f"extra memory at {large.name}": False,
    }
    assert "the aim is reached" in found[f"native against the torch reference, {large.name}, 1 thread"].line()
