"""The script that trains at the paper's length on a GPU: what it calls, and what it says where that cannot be."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from places import ROOT

SCRIPT = ROOT / "scripts" / "gpu_paper.sh"
PYTHON = """#!/bin/bash
case "$*" in
  *"import nerfstudio"*) exit {nerfstudio} ;;
  *"import beags_benchmarks"*) exit {bench} ;;
  *CudaRasterizer*) echo "{reason}"; exit 0 ;;
esac
printf '%s\\n' "$@" > "{folder}/called-$(basename "${{@: -1}}")-$$"
echo "a table of $*"
exit {code}
"""


def called(tmp_path: Path, *arguments: str, nerfstudio: int = 0, bench: int = 0, reason: str = "", code: int = 0):
    """Run the script beside programs that pretend to be a GPU's and Python."""
    bins = tmp_path / "bin"
    bins.mkdir()
    (bins / "nvidia-smi").write_text("#!/bin/sh\necho GPU 0\n")
    (bins / "python3").write_text(
        PYTHON.format(nerfstudio=nerfstudio, bench=bench, reason=reason, folder=tmp_path, code=code)
    )
    for file in bins.iterdir():
        file.chmod(0o755)
    return subprocess.run(
        ["bash", str(SCRIPT), "--out", str(tmp_path / "out"), *arguments],
        capture_output=True,
        text=True,
        env={"PATH": f"{bins}:/usr/bin:/bin"},
        timeout=60,
    )


@pytest.fixture
def data(tmp_path):
    (tmp_path / "truth").mkdir()
    return ["--data-root", str(tmp_path), "--truth", str(tmp_path / "truth")]


def test_each_capture_is_trained_by_the_papers_preset(tmp_path, data):
    done = called(tmp_path, *data, "--size", "500", "fruit", "bear")
    assert done.returncode == 0, done.stderr
    calls = [file.read_text().splitlines() for file in tmp_path.glob("called-*")]
    assert sorted(words[words.index("--scenes") + 1] for words in calls) == ["bear", "fruit"]
    for words in calls:
        assert words[words.index("--preset") + 1] == "beags-paper" and words[words.index("--size") + 1] == "500"
        assert words[-5:] == ["--variants", "as long as the paper, neither loss", "the paper's losses",
                              "as long as beags-refine, neither loss", "beags-refine"]  # fmt: skip
    assert "== fruit\na table of" in done.stdout and done.stdout.endswith(f"the figures are in {tmp_path / 'out'}\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nerfstudio": 1}, "has no nerfstudio: install"),
        ({"bench": 1}, "has no beags bench: call"),
        ({"reason": "no CUDA build"}, "gpu_paper: no CUDA build"),
        ({"code": 3}, "not done: fruit garden; the logs are in"),
        ({"code": 124}, "fruit (out of time: call again to go on)"),
    ],
)
def test_what_cannot_be_is_said(tmp_path, data, change, words):
    done = called(tmp_path, *data, **change)
    assert done.returncode == 1 and words in done.stderr


def test_folders_and_options_are_checked_first(tmp_path):
    done = called(tmp_path, "--data-root", str(tmp_path / "no"))
    assert done.returncode == 1 and "is no folder: name the one that holds fruit garden" in done.stderr
    done = subprocess.run(["bash", str(SCRIPT), "--fast"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "there is no option --fast" in done.stderr
