"""The doctor finds what is missing and never falls ill itself."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from beags_plugin.commands.doctor import backends, building, diagnosis
from beags_plugin.commands.doctor.check import Check, print_report
from beags_plugin.rasterizers import RASTERIZERS


@pytest.fixture(scope="module")
def checks() -> dict[str, Check]:
    return {check.name: check for check in diagnosis.diagnose()}


def test_everything_is_looked_at(checks):
    expected = {"python", "torch", "CUDA device", "nerfstudio", "opencv contrib", "open3d", "C++ compiler", "ffmpeg"}
    expected |= {"Chromium"}
    expected |= {"CPU", "presets", "codecs png, jpg", "codec mp4", "export formats"}
    assert expected | {f"rasterizer {name}" for name in RASTERIZERS.names()} <= set(checks)
    assert all(check.sentence and "\n" not in check.sentence for check in checks.values())
    assert not any(check.repair for check in checks.values() if check.ok)


def test_what_the_tests_use_is_there(checks):
    for name in ("python", "torch", "nerfstudio", "opencv contrib", "rasterizer torch"):
        assert checks[name].ok, checks[name].sentence


@pytest.mark.parametrize("module", ["torch", "nerfstudio", "cv2", "open3d"])
def test_a_missing_package_is_a_finding(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)  # what makes an import fail
    name = {"cv2": "opencv"}.get(module, module)
    found = diagnosis._safely(getattr(diagnosis, f"_{name}"))
    assert not found.ok and module in found.sentence
    assert found.repair.startswith("pip install") and name in found.repair


def test_opencv_without_contrib_is_told_from_opencv_with_it(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "ximgproc", type(sys)("cv2.ximgproc"))  # an empty shell, as plain opencv leaves it
    found = diagnosis._opencv()
    assert not found.ok and "guidedFilter" in found.sentence
    assert found.repair == "pip install --force-reinstall --no-deps opencv-contrib-python-headless==4.10.0.84"


def test_a_check_that_breaks_in_any_way_is_reported():
    def broken() -> Check:
        raise SystemExit("a library that\ngives up")

    found = diagnosis._safely(broken)
    assert not found.ok and found.sentence == "cannot be used: SystemExit: a library that"


def test_no_programs_on_the_path(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    for check in (building.compiler(), diagnosis._ffmpeg(), diagnosis._browser()):
        assert not check.ok and not check.required and "install" in check.sentence
        assert check.repair in (
            "apt install g++", "apt install ffmpeg", "apt install chromium", "xcode-select --install",
        )  # fmt: skip


def test_a_backend_that_kills_its_process_is_a_finding(monkeypatch):
    monkeypatch.setattr(backends, "TRIAL", "import os, signal; os.kill(os.getpid(), signal.SIGILL)")
    found = backends.rasterizer("native")
    assert not found.ok and not found.required and found.name == "rasterizer native"
    assert "SIGILL" in found.sentence and "reinstall beags from source" in found.sentence
    assert found.repair == "pip install --force-reinstall --no-deps ."
    monkeypatch.setattr(backends, "TRIAL", "raise ValueError('odd')")
    odd = backends.rasterizer("native").sentence
    assert "it fails when it draws: ValueError: odd" in odd and "BEAGS_NATIVE=0" in odd
    odd = backends.rasterizer("cuda").sentence
    assert "ValueError: odd" in odd and "--machine.device-type cpu" in odd and "BEAGS_NATIVE" not in odd


def test_an_absent_extension_says_what_to_install_and_what_draws_instead(monkeypatch):
    hidden = "import sys; sys.modules['beags_plugin._native'] = None\n"  # what makes an import fail
    monkeypatch.setattr(backends, "TRIAL", hidden + backends.TRIAL)
    found = backends.rasterizer("native")
    assert not found.ok and not found.required and "\n" not in found.sentence
    assert "install a C++ compiler and reinstall beags; until then the torch reference draws" in found.sentence
    assert found.repair and backends.rasterizer("torch").ok


def test_missing_codecs_and_presets_are_findings(monkeypatch):
    from importlib import metadata

    from beags_plugin.export.mesh import GlbExporter
    from beags_plugin.pictures import video

    monkeypatch.setattr(video, "encoder", lambda: None)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [])
    monkeypatch.setattr(GlbExporter, "unavailable", classmethod(lambda cls: "Open3D cannot be loaded."))
    films, presets, formats = diagnosis._films(), diagnosis._presets(), diagnosis._formats()
    assert not films.ok and not films.required and "pip install" in films.repair
    assert not presets.ok and presets.required and presets.repair == "pip install -c constraints.txt -e ."
    assert not formats.ok and formats.sentence == "obj, ply, ply-2dgs, spz; not glb: Open3D cannot be loaded."
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "imencode", lambda suffix, image: (False, None))
    assert not diagnosis._pictures().ok and "opencv" in diagnosis._pictures().repair


def test_the_native_rasterizer_is_tried_with_its_kernels(checks):
    found = checks["rasterizer native"]
    if not found.ok:
        pytest.skip(found.sentence)
    from beags_plugin import _native

    assert f"with {_native.instruction_set()} kernels" in found.sentence


def _compiler_that(folder, script: str) -> str:
    path = folder / "cxx"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize(
    ("script", "ok", "words"),
    [
        ("exit 1", False, "does not know C++17"),
        ('! grep -q "Python.h"', False, "apt install python3-dev"),
        ('! grep -q "omp.h"', True, "without OpenMP"),
        ("cat > /dev/null", True, "cxx"),
    ],
)
def test_the_compiler_is_tried(monkeypatch, tmp_path, script, ok, words):
    monkeypatch.setenv("CXX", _compiler_that(tmp_path, script) + " -O2")
    found = building.compiler()
    assert found.ok == ok and not found.required and words in found.sentence


def test_a_compiler_that_is_named_but_not_there(monkeypatch):
    monkeypatch.setenv("CXX", "/nonexistent/c++ -O2")
    found = building.compiler()
    assert not found.ok and "CXX names /nonexistent/c++" in found.sentence and "install" in found.sentence


def test_long_sentences_are_folded_not_cut():
    out = io.StringIO()
    print_report([Check("a", True, "x" * 200)], Console(file=out, width=60))
    assert out.getvalue().count("x") == 200


def test_the_report_tells_missing_from_absent():
    out = io.StringIO()
    found = [
        Check("a", True, "fine"),
        Check("b", False, "[gone]"),
        Check("c", False, "optional", required=False, repair="apt install c"),
    ]
    print_report(found, Console(file=out, width=80))
    lines = [line.split() for line in out.getvalue().splitlines()]
    assert lines == [
        ["ok", "a", "fine"],
        ["missing", "b", "[gone]"],
        ["absent", "c", "optional"],
        ["repair:", "apt", "install", "c"],
    ]
