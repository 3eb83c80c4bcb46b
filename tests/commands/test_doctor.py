"""The doctor finds missing parts and never fails itself."""

from __future__ import annotations

import io
import sys
from importlib import metadata

import pytest
from rich.console import Console

pytest.importorskip("nerfstudio")

from run_folders import write_scene

from beags_plugin.commands.doctor import backends, diagnosis
from beags_plugin.commands.doctor.check import Check, print_check
from beags_plugin.rasterizers import RASTERIZERS
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def checks() -> dict[str, Check]:
    return {check.name: check for check in diagnosis.diagnose()}


def test_everything_is_checked(checks):
    expected = {"python", "torch", "CUDA device", "nvcc", "nerfstudio", "opencv contrib", "open3d", "presets"}
    expected.add("masks of photos")
    assert expected | {f"rasterizer {name}" for name in RASTERIZERS.names()} <= set(checks)
    assert all(check.sentence and "\n" not in check.sentence for check in checks.values())
    assert not any(check.repair for check in checks.values() if check.ok)
    for name in ("python", "torch", "nerfstudio", "opencv contrib", "rasterizer torch"):
        assert checks[name].ok, checks[name].sentence


@pytest.mark.parametrize("module", ["torch", "nerfstudio", "cv2", "open3d"])
def test_a_missing_package_is_a_finding(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)  # Importing it then fails.
    name = {"cv2": "opencv"}.get(module, module)
    found = diagnosis._safely(getattr(diagnosis, f"_{name}"))
    assert not found.ok and module in found.sentence
    assert found.repair.startswith("pip install") and name in found.repair


def test_missing_parts_of_packages_are_findings(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "ximgproc", type(sys)("cv2.ximgproc"))  # an empty shell, as plain opencv leaves it
    found = diagnosis._opencv()
    assert not found.ok and "guidedFilter" in found.sentence
    assert found.repair == "pip install --force-reinstall --no-deps opencv-contrib-python-headless==4.10.0.84"
    monkeypatch.setattr(metadata, "entry_points", lambda group: [])
    presets = diagnosis._presets()
    assert not presets.ok and presets.required and presets.repair == "pip install -c constraints.txt -e ."


def test_what_masks_of_photos_need_is_named_before_they_are_made(monkeypatch, tmp_path):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    monkeypatch.setattr("beags_plugin.masks.sources.salient.find_spec", lambda name: None)
    without = diagnosis._masks()
    assert not without.ok and not without.required and without.repair == "pip install onnxruntime"
    assert without.sentence == "the library onnxruntime is not installed"
    monkeypatch.setattr("beags_plugin.masks.sources.salient.find_spec", lambda name: object())
    assert not (fetched := diagnosis._masks()).ok and fetched.repair == "beags masks weights"
    (tmp_path / "u2netp.onnx").touch()
    assert diagnosis._masks().ok


def test_a_check_that_breaks_in_any_way_is_reported():
    def broken() -> Check:
        raise SystemExit("a library that\ngives up")

    found = diagnosis._safely(broken)
    assert not found.ok and found.sentence == "cannot be used: SystemExit: a library that"


def test_a_backend_that_kills_its_process_is_a_finding(monkeypatch):
    monkeypatch.setattr(backends, "TRIAL", "import os, signal; os.kill(os.getpid(), signal.SIGILL)")
    found = backends.rasterizer("native")
    assert not found.ok and not found.required and found.name == "rasterizer native"
    assert "SIGILL" in found.sentence and "BEAGS_NATIVE=0" in found.sentence
    assert found.repair == "pip install --force-reinstall --no-deps ."
    monkeypatch.setattr(backends, "TRIAL", "raise ValueError('odd')")
    odd = backends.rasterizer("native").sentence
    assert "it fails when it renders: ValueError: odd" in odd and "BEAGS_NATIVE=0" in odd
    odd = backends.rasterizer("cuda").sentence
    assert "ValueError: odd" in odd and "--machine.device-type cpu" in odd and "BEAGS_NATIVE" not in odd


def test_an_absent_extension_has_a_repair_and_a_substitute(monkeypatch):
    hidden = "import sys; sys.modules['beags_plugin._native'] = None\n"  # Importing it then fails.
    monkeypatch.setattr(backends, "TRIAL", hidden + backends.TRIAL)
    found = backends.rasterizer("native")
    assert not found.ok and not found.required and "\n" not in found.sentence
    assert "install a C++ compiler and reinstall beags; until then the torch reference renders" in found.sentence
    assert found.repair


def test_a_scene_is_read_and_free_memory_and_disk_are_reported(tmp_path, monkeypatch):
    found = {check.name: check for check in diagnosis.checks_of_data(write_scene(tmp_path))}
    assert list(found) == ["data", "memory", "disk", "temporary disk"]
    assert found["data"].sentence == "7 views to train on, 2 held out"
    assert found["memory"].ok and "GB are free beside this program" in found["memory"].sentence
    monkeypatch.setattr("beags_plugin.system.memory.available_mb", lambda: 20.0)
    assert not list(diagnosis.checks_of_data(tmp_path))[1].ok
    with pytest.raises(UserError, match="nowhere"):
        list(diagnosis.checks_of_data(tmp_path / "nowhere"))


def test_the_native_rasterizer_is_tried_with_its_kernels(checks):
    found = checks["rasterizer native"]
    if not found.ok:
        pytest.skip(found.sentence)
    from beags_plugin import _native

    assert f"with {_native.instruction_set()} kernels" in found.sentence


def test_the_report_marks_missing_and_absent_and_folds_long_sentences():
    out = io.StringIO()
    found = [
        Check("a", True, "fine"),
        Check("b", False, "[gone]"),
        Check("c", False, "optional", required=False, repair="apt install c"),
        Check("d", True, "x" * 200),
    ]
    console = Console(file=out, width=60)
    for check in found:
        print_check(check, console)
    lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    assert lines[:4] == ["ok a fine", "missing b [gone]", "absent c optional", "repair: apt install c"]
    assert out.getvalue().count("x") == 200
