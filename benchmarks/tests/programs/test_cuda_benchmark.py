"""The benchmark for GPUs runs on the emulation; the check for GPUs reports a missing GPU."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time

import pytest
from cuda_backends import EmulatedCudaRasterizer
from places import ROOT

from beags_benchmarks.kernels import cuda
from beags_benchmarks.kernels.scenes import Size
from beags_plugin.ops import extension

SCRIPT = ROOT / "scripts" / "gpu_check.sh"


def test_rows_of_renderings_and_steps(monkeypatch, tmp_path, capsys):
    """Tiny scenes are measured on the CPU; the clock only calls what it is given."""
    if (reason := EmulatedCudaRasterizer.unavailable()) or (reason := extension.status()[1]):
        pytest.skip(reason)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(cuda, "CudaRasterizer", EmulatedCudaRasterizer)
    monkeypatch.setattr(cuda, "milliseconds", lambda call, repeats: call() and None or 4.0)
    monkeypatch.setattr(cuda, "peak_mb", lambda call: call() and None or 2.0)
    monkeypatch.setattr(cuda, "copy_rate", lambda: 1000.0)
    monkeypatch.setattr(cuda, "COUNTS", (40, 90))
    monkeypatch.setattr(cuda, "IMAGES", ((48, 32), (32, 32)))
    monkeypatch.setattr(cuda, "SAMPLES", (1, 20))
    monkeypatch.setattr(cuda, "case", lambda count, width, height: Size(min(count, 100), width, height))
    file = tmp_path / "cuda.json"
    chosen = argparse.Namespace(quick=False, json=str(file), gsplat_seconds=0.0)
    code = cuda.measure({"gpu": "none"}, chosen, time.monotonic() + 60.0)
    found = json.loads(file.read_text())
    assert code == 0 and found["gpu"] == "none" and found["gsplat"] == "left out: --gsplat-seconds is 0"
    assert [row["n"] for row in found["rows"]] == [40, 40, 90, 90]
    assert all(row["both_ms"] == 4.0 and row["pairs"] > 0 for row in found["rows"])
    assert [row["samples"] for row in found["steps"]][:3] == [None, 1, 20]
    assert "none, a copy moves 1000 GB/s" in capsys.readouterr().out


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="it looks for a GPU, and may find one here")
def test_the_check_reports_a_missing_gpu(tmp_path):
    command = ["bash", str(SCRIPT), "--out", str(tmp_path), "tests"]
    done = subprocess.run(command, capture_output=True, text=True, env={"PATH": "/usr/bin:/bin"}, timeout=60)
    assert done.returncode == 1
    assert (done.stdout + done.stderr).strip() == "gpu_check: there is no NVIDIA GPU, or no driver for it"


ABSENT = """
import sys
import pytest
for name in sys.argv[1].split(","):
    sys.modules[name] = None
sys.exit(pytest.main(["--collect-only", "-q", *sys.argv[2:]]) or __import__("beags_benchmarks.kernels.cuda") is None)
"""


def test_the_check_needs_no_package_that_it_does_not_name():
    script = SCRIPT.read_text()
    needed = re.search(r"for package in (.+); do", script)
    files = re.findall(r"tests/\w+/test_(?:\{[\w,]+\}|\w+)\.py", script)
    assert needed is not None and len(files) == 4
    named = subprocess.run(["bash", "-c", f"echo {' '.join(files)}"], capture_output=True, text=True, check=True)
    absent = {"nerfstudio", "tyro", "cv2", "open3d", "tensorboard", "torchvision", "xatlas", "skimage", "trimesh"}
    absent |= {"PIL", "zstandard", "psutil", "matplotlib", "pycocotools", "pycolmap", "onnxruntime", "sklearn", "viser"}
    assert not absent & set(needed[1].split())
    command = [sys.executable, "-c", ABSENT, ",".join(sorted(absent)), *named.stdout.split()]
    env = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=env)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
