"""The compiled rasterizer on each instruction set: forced by name, equal in what it renders, safe to load."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from places import ROOT, SUPPORT
from raster_scenes import CLASSES, FLOATS, OUTPUTS, make_scene

from beags_plugin.rasterizers import native
from beags_plugin.rasterizers.native import NativeRasterizer
from beags_plugin.rasterizers.rendering import draw_features

needs_native = pytest.mark.skipif(
    NativeRasterizer.unavailable() is not None, reason=str(NativeRasterizer.unavailable())
)
NAMES = ("avx512", "avx2", "neon", "baseline", "scalar")
HERE = Path(__file__).parent
OBJECTS = {  # files compiled for one instruction set: their namespace and a symbol that each must define
    **{f"tiles_{name}": (f"beags::{name}::", "kKernelsF32") for name in NAMES},
    "build_avx2": ("beags::ops::avx2::", "table<beags::ops::OpKernels<float> >()::all"),
}
DRAW = """
import os, sys; sys.path[:0] = sys.argv[3:]
import pytest, raster_scenes, torch
from beags_plugin.rasterizers import native
assert "beags_plugin._native" not in sys.modules
for name in sys.argv[1].split(","):
    if (child := os.fork()) == 0:
        os.environ["BEAGS_ISA"] = name
        from test_native_isa import draw
        assert native.instruction_set() == name
        torch.save(draw(), f"{sys.argv[2]}/{name}.pt")
        os._exit(0)
    os.waitpid(child, 0)
"""
"""The instruction set is chosen once in each process: forks of one that has not loaded it save its start."""


def run(program, *args, **environment):
    command = [sys.executable, "-c", program, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, check=False)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A folder with what each instruction set of this processor has drawn, NAME.pt, and what was said."""
    folder = tmp_path_factory.mktemp("drawn")
    return folder, run(DRAW, ",".join(native.instruction_sets()), folder, HERE, SUPPORT).stderr


def draw():
    """Images, channels, gradients, contributions and pixel counts of a scene across tiles, in float32 and float64."""
    results = []
    for dtype in (torch.float32, torch.float64):
        scene = make_scene(count=120, width=71, height=51, seed=3, size=-1.8).to(dtype)
        leaves = {name: getattr(scene.inputs, name).clone().requires_grad_() for name in FLOATS}
        render = scene.draw(NativeRasterizer(), **leaves)
        images = [getattr(render, name) for name in OUTPUTS]
        inputs = replace(scene.inputs, **leaves)
        what, features = (scene.camera, scene.settings), inputs.quats.repeat(1, 4)[:, :13]
        images.append(NativeRasterizer().class_channels(inputs, *what, CLASSES))
        images.append(draw_features(NativeRasterizer(), inputs, features, *what))
        alone = draw_features(NativeRasterizer(), inputs.detached(), features, *what)
        tables = [torch.autograd.grad(alone.square().sum(), leaves["quats"], retain_graph=True)[0]]
        grads = torch.autograd.grad(sum(image.square().sum() for image in images), list(leaves.values()))
        what = (scene.inputs, scene.camera, scene.settings, scene.target, CLASSES)
        tables += NativeRasterizer().sparse_class_contributions(*what)
        for least in (0.0, 0.1):
            tables += NativeRasterizer().sparse_class_pixel_counts(*what, least)
        tables += NativeRasterizer().sparse_top_contributions(*what, 3, 100)
        results.append([image.detach() for image in images] + list(grads) + tables)
    return results


def error(a, b):
    return ((a - b).abs().max().double() / b.abs().max().clamp_min(1.0)).item()


@needs_native
@pytest.mark.parametrize("name", NAMES)
def test_every_instruction_set_renders_the_same(name, drawn):
    if name not in native.instruction_sets():
        pytest.skip(f"{name} is not built or not in this processor")
    folder, said = drawn
    assert (folder / f"{name}.pt").exists(), said
    for found, expected, band in zip(torch.load(folder / f"{name}.pt"), draw(), (1e-4, 1e-12), strict=True):
        assert all(error(a, b) < band for a, b in zip(found, expected, strict=True))


@needs_native
def test_a_forced_instruction_set_that_cannot_run_is_reported_in_a_sentence():
    names = [name for name in (*NAMES, "mmx") if name not in native.instruction_sets()]
    program = """
import os, sys
from beags_plugin.system.errors import UserError
from beags_plugin.rasterizers import make_rasterizer
for name in sys.argv[1:]:
    os.environ["BEAGS_ISA"] = name
    try:
        make_rasterizer("auto")
    except UserError as error:
        print(error)
"""
    done = run(program, *names, BEAGS_ISA=names[0])
    assert done.returncode == 0, done.stderr
    reported = done.stdout.splitlines()
    assert len(reported) == len(names)
    for name, sentence in zip(names, reported, strict=True):
        assert re.fullmatch(rf"BEAGS_ISA asks for the instruction set '{name}', which .* or unset it\.", sentence)


@needs_native
def test_the_best_instruction_set_is_taken():
    if not os.environ.get("BEAGS_ISA"):
        assert native.instruction_set() == native.instruction_sets()[0]
    assert native.instruction_sets()[-1] == "scalar"


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_hold_nothing_that_other_processors_may_run(name):
    """The linker merges weak symbols, and static initialisers run at load: either would be an illegal instruction."""
    if shutil.which("nm") is None:
        pytest.skip("nm is missing")
    space, kernels = OBJECTS[name]
    objects = sorted(ROOT.glob(f"build/**/{name}.cpp.o"))
    objects = [
        file for file in objects if "sanitize" not in file.parts
    ]  # Those files hold the sanitizer's own functions.
    if not objects:
        pytest.skip(f"there is no object of {name}.cpp in build/")
    for built in objects:
        lines = subprocess.run(["nm", "-C", built], capture_output=True, text=True, check=True).stdout.splitlines()
        symbols = [line[17:].split(" ", 1) for line in lines]  # The address takes 17 characters.
        defined = [text for kind, text in symbols if kind not in "Ur"]
        assert space + kernels in defined
        assert [text for text in defined if space not in text] == []
        assert not any("_GLOBAL__sub_I" in text or "std::" in text for text in defined)
        sections = subprocess.run(["nm", "-a", built], capture_output=True, text=True, check=True).stdout
        assert ".init_array" not in sections
