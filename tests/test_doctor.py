"""The doctor finds what is missing and never falls ill itself."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from beags_plugin import doctor
from beags_plugin.rasterizers import RASTERIZERS


@pytest.fixture(scope="module")
def checks() -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.diagnose()}


def test_everything_is_looked_at(checks):
    expected = {"python", "torch", "CUDA device", "nerfstudio", "opencv contrib", "open3d", "C++ compiler", "ffmpeg"}
    assert expected | {f"rasterizer {name}" for name in RASTERIZERS.names()} <= set(checks)
    assert all(check.sentence and "\n" not in check.sentence for check in checks.values())


def test_what_the_tests_use_is_there(checks):
    for name in ("python", "torch", "nerfstudio", "opencv contrib", "rasterizer torch"):
        assert checks[name].ok, checks[name].sentence


@pytest.mark.parametrize("module", ["torch", "nerfstudio", "cv2", "open3d"])
def test_a_missing_package_is_a_finding(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)  # what makes an import fail
    check = {"torch": doctor._torch, "nerfstudio": doctor._nerfstudio, "cv2": doctor._opencv, "open3d": doctor._open3d}
    found = doctor._safely(check[module])
    assert not found.ok and module in found.sentence


def test_opencv_without_contrib_is_told_from_opencv_with_it(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "ximgproc", type(sys)("cv2.ximgproc"))  # an empty shell, as plain opencv leaves it
    found = doctor._opencv()
    assert not found.ok and "guidedFilter" in found.sentence


def test_a_check_that_breaks_in_any_way_is_reported():
    def broken() -> doctor.Check:
        raise SystemExit("a library that\ngives up")

    found = doctor._safely(broken)
    assert not found.ok and found.sentence == "cannot be used: SystemExit: a library that"


def test_no_programs_on_the_path(monkeypatch):
    monkeypatch.setenv("PATH", "")
    for check in (doctor._compiler(), doctor._ffmpeg()):
        assert not check.ok and not check.required and "install" in check.sentence


def test_the_report_tells_missing_from_absent():
    out = io.StringIO()
    found = [
        doctor.Check("a", True, "fine"),
        doctor.Check("b", False, "[gone]"),
        doctor.Check("c", False, "optional", required=False),
    ]
    doctor.print_report(found, Console(file=out, width=80))
    lines = [line.split() for line in out.getvalue().splitlines()]
    assert lines == [["ok", "a", "fine"], ["missing", "b", "[gone]"], ["absent", "c", "optional"]]
