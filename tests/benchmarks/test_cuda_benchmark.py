"""The benchmark and the check for GPUs, as far as they run without one: on the emulation, and with stubs for tools."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import stat
import subprocess
import time
from pathlib import Path

import pytest
from cuda_backends import EmulatedAheadRasterizer, EmulatedCudaRasterizer
from places import ROOT

from beags_plugin.ops import extension
from benchmarks import cuda
from benchmarks.scenes import Size

SCRIPT = ROOT / "scripts" / "gpu_check.sh"


@pytest.fixture
def dry(monkeypatch):
    """The benchmark on the CPU, of tiny scenes; its clock only calls what it is given."""
    if (reason := EmulatedCudaRasterizer.unavailable()) or (reason := extension.found()[1]):
        pytest.skip(reason)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    backends = {False: EmulatedCudaRasterizer, True: EmulatedAheadRasterizer}
    monkeypatch.setattr(cuda, "make_cuda", lambda ahead=False: backends[ahead]())
    monkeypatch.setattr(cuda, "milliseconds", lambda call, repeats: call() and None or 4.0)
    monkeypatch.setattr(cuda, "peak_mb", lambda call: call() and None or 2.0)
    monkeypatch.setattr(cuda, "copy_rate", lambda: 1000.0)
    monkeypatch.setattr(cuda, "COUNTS", (40, 90))
    monkeypatch.setattr(cuda, "IMAGES", ((48, 32), (32, 32)))
    monkeypatch.setattr(cuda, "SAMPLES", (1, 20))
    monkeypatch.setattr(cuda, "case", lambda count, width, height: Size(min(count, 100), width, height))


def measured(folder: Path) -> tuple[int, dict]:
    file = folder / "cuda.json"
    chosen = argparse.Namespace(quick=False, json=str(file), gsplat_seconds=0.0)
    code = cuda.measure({"gpu": "none"}, chosen, time.monotonic() + 600.0)
    return code, json.loads(file.read_text())


def test_rows_of_drawings_and_steps(dry, tmp_path, capsys):
    code, found = measured(tmp_path)
    assert code == 0 and found["gpu"] == "none" and found["gsplat"] == "left out: --gsplat-seconds is 0"
    assert [row["n"] for row in found["rows"]] == [40, 40, 90, 90]
    for row in found["rows"]:
        assert row["backend"] == "beags" and row["both_ms"] == 4.0 and row["pairs"] > 0
        least = 3 * 52 * row["n"] + 2 * 36 * row["width"] * 32 + 200 * row["pairs"]  # bytes
        assert row["least_ms"] == pytest.approx(least / 1000e9 * 1e3)
        assert row["share_of_copy_rate"] == pytest.approx(row["least_ms"] / 4.0)
    assert [row["samples"] for row in found["steps"]] == [None, 1, 20, None]
    assert [row["ahead"] for row in found["steps"]] == [False, False, False, True]
    assert all(row["ratio_to_base"] == 1.0 and row["extra_ms"] == 0.0 for row in found["steps"][1:])
    told = capsys.readouterr().out
    assert "none, a copy moves 1000 GB/s" in told and "48x32" in told


def test_what_fails_stands_in_its_row(dry, tmp_path, monkeypatch, capsys):
    def breaks(*_):
        raise RuntimeError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr(cuda, "drawing_row", breaks)
    code, found = measured(tmp_path)
    assert code == 1
    assert [row["failed"] for row in found["rows"]] == ["RuntimeError: CUDA out of memory."] * 4
    assert "step_ms" in found["steps"][0] and "failed: RuntimeError" in capsys.readouterr().out


def check(*stages: str, tools: Path | None = None, **variables: str) -> tuple[int, str]:
    path = f"{tools}:{os.environ['PATH']}" if tools else "/usr/bin:/bin"
    environment = {**os.environ, "PATH": path, **variables}
    done = subprocess.run(["bash", str(SCRIPT), *stages], capture_output=True, text=True, env=environment, timeout=600)
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def tools(tmp_path):
    """Stubs of what the check calls; the Python says yes to every question, and fails where a stage is to fail."""
    calls = tmp_path / "calls"
    stubs = {
        "nvidia-smi": "echo 'GPU 0: a stub'",
        "nvcc": "exit 0",
        "cmake": "exit 0",
        "compute-sanitizer": 'while [ "$1" != stub-python ]; do shift; done; exec "$@"',
        "stub-python": f'echo "$@" >> {calls}; case "$*" in *pytest*tests/*) echo "1 failed"; exit 1 ;; esac; exit 0',
    }
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, body in stubs.items():
        file = folder / name
        file.write_text(f"#!/usr/bin/env bash\n{body}\n")
        file.chmod(file.stat().st_mode | stat.S_IEXEC)
    return folder, calls


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="it looks for a GPU, and may find one here")
def test_the_check_says_what_is_missing(tmp_path):
    code, told = check("--out", str(tmp_path / "out"), "tests")
    assert code == 1 and told.strip() == "gpu_check: there is no NVIDIA GPU, or no driver for it"
    code, told = check("--out", str(tmp_path / "out"), "test")
    assert code == 1 and told.strip() == "gpu_check: there is no stage test"


@pytest.mark.skipif(not list(ROOT.glob("beags_plugin/_native*.so")), reason="nothing was built in place")
def test_the_check_goes_on_after_a_stage_that_fails(tools, tmp_path):
    folder, calls = tools
    out = tmp_path / "out"
    stages = ("tests", "memcheck", "benchmark")
    variables = {"PYTHON": "stub-python", "BENCHMARK_SECONDS": "7", "GSPLAT_SECONDS": "3"}
    code, told = check("--out", str(out), *stages, tools=folder, **variables)
    assert code == 1 and told.strip().endswith("gpu_check: failed: tests")
    assert "== tests: FAILED" in told and "== memcheck: ok" in told and "== benchmark: ok" in told
    assert (out / "tests.log").read_text().strip() == "1 failed"
    asked = calls.read_text()
    assert "-m benchmarks.cuda --smoke" in asked
    assert f"-m benchmarks.cuda --json {out}/cuda.json --seconds 7 --gsplat-seconds 3" in asked
