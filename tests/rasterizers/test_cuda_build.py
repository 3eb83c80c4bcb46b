"""The kernels as nvcc compiles them, on machines without a GPU too."""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

import pytest
from places import ROOT

from beags_plugin.ops import extension

KERNELS = ROOT / "beags_plugin/native"


def nvcc() -> str | None:
    from_pip = sorted(Path(sysconfig.get_path("purelib")).glob("nvidia/cu*/bin/nvcc"))
    return shutil.which("nvcc") or shutil.which("/usr/local/cuda/bin/nvcc") or (str(from_pip[-1]) if from_pip else None)


needs_nvcc = pytest.mark.skipif(nvcc() is None, reason="there is no nvcc")


@needs_nvcc
@pytest.mark.skipif(extension.load() is None, reason="nothing was compiled")
def test_the_module_has_the_kernels_that_nvcc_compiled():
    cuda = getattr(extension.load(), "cuda", None)
    assert cuda is not None, (
        "nvcc is here, but the compiled module has no kernels: build it again, and read what CMake says"
    )
    assert not cuda.EMULATED


def resources(source: Path, architecture: int, folder: Path) -> dict[str, dict[str, int]]:
    """Return what each kernel of a file takes: bytes that registers spill, registers a thread, shared bytes a block."""
    done = subprocess.run(
        [str(nvcc()), "-std=c++17", "-O3", "--fmad=false", "--expt-relaxed-constexpr", f"-arch=sm_{architecture}"]
        + ["-cubin", "-Xptxas", "-v", "-I", str(KERNELS), "-o", str(folder / "kernels.cubin"), str(source)],
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, dict[str, int]] = {}
    for part in done.stderr.split("Compiling entry function ")[1:]:
        spills = re.findall(r"(\d+) bytes spill", part)
        shared = re.search(r"(\d+) bytes smem", part)
        found[part.split("'")[1]] = {
            "spilled": sum(map(int, spills)),
            "registers": int(re.search(r"Used (\d+) registers", part)[1]),  # type: ignore[index]
            "shared": int(shared[1]) if shared else 0,
        }
    return found


@needs_nvcc
@pytest.mark.parametrize("source", ["cuda/rasterizer/forward.cu", "cuda/rasterizer/backward.cu"])
def test_kernels_that_render_in_float32_fit_into_registers(source, tmp_path):
    # Of the supported GPUs, sm_75 has the least shared memory; a multiprocessor shall hold two blocks of 256 threads.
    in_float32 = re.compile(r"kernelI(L[ij]\d+E)?fE")
    kernels = {
        name: used for name, used in resources(KERNELS / source, 75, tmp_path).items() if in_float32.search(name)
    }
    assert len(kernels) >= 4
    for name, used in kernels.items():
        assert used["spilled"] <= 32, (name, used)  # some versions spill a number or two, for a block more
        assert used["registers"] <= 128, (name, used)
        assert used["shared"] <= 32 << 10, (name, used)
