"""The benchmark of rasterizers runs end to end; programs outside the package find what they import from it."""

from __future__ import annotations

import ast
import importlib
import json
import os
import runpy
import subprocess
import sys

import pytest
from places import ROOT

from beags_benchmarks.provenance import with_these_packages
from beags_plugin.system.child_processes import bound

PACKAGE = ROOT / "benchmarks" / "beags_benchmarks"


@pytest.mark.slow("measures in processes of their own")
def test_a_quick_benchmark_measures_rows_and_a_step(tmp_path):
    target = tmp_path / "result.json"
    done = subprocess.run(
        bound([sys.executable, "-m", "beags_benchmarks.kernels.rasterizer", "--quick", "--json", target]),
        capture_output=True, text=True, cwd=tmp_path,
        env=with_these_packages({**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(target.read_text())
    assert result["machine"]["cpu"] and result["commit"] and result["torch"]
    assert "torch" in {row["backend"] for row in result["rows"]}
    for row in result["rows"]:
        assert row["forward_ms"] > 0 and row["backward_ms"] > 0 and row["ratio_to_torch"] > 0
    assert result["scenes"][0]["same_bits"] and min(result["step"]["whole_ms"].values()) > 0


FOLDERS = (PACKAGE / "kernels", PACKAGE / "studies", ROOT / "docs/pictures", ROOT / "scripts")
PROGRAMS = sorted(path for folder in FOLDERS for path in folder.glob("*.py"))


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.name)
def test_a_program_finds_what_it_imports_from_us(path):
    """A name that was moved or renamed shows here, and not when somebody needs the program."""
    for node in ast.walk(ast.parse(path.read_text("utf8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in (
            "beags_plugin",
            "beags_benchmarks",
        ):
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.import_module(f"{node.module}.{alias.name}"), alias.name


@pytest.mark.parametrize(
    "name", ["kernels.rasterizer", "kernels.accuracy", "kernels.cuda", "studies.answers", "studies.page_tables"]
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python warns of modules that are imported already.
def test_a_program_says_what_it_takes(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module(f"beags_benchmarks.{name}", run_name="__main__", alter_sys=True)
    said = capsys.readouterr().out
    assert not end.value.code and "usage:" in said and "--" in said
