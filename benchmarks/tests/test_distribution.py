"""The distribution: what is in its wheel, and what its trials' digests are of."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.metadata import Distribution, EntryPoint
from zipfile import ZipFile

import pytest
from places import ROOT

from beags_benchmarks.experiments import trials


def test_the_wheel_has_every_file_and_adds_a_command(tmp_path):
    pytest.importorskip("setuptools", "77")
    source = tmp_path / "benchmarks"  # a copy: a build leaves files beside what it builds
    shutil.copytree(ROOT / "benchmarks", source, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
    ]
    subprocess.run([*pip, "--no-index", "-w", tmp_path, source], check=True, timeout=300)
    (wheel,) = tmp_path.glob("beags_benchmarks-*-py3-none-any.whl")
    with ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        (points,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        text = archive.read(points).decode()
    package = source / "beags_benchmarks"
    assert names == {path.relative_to(source).as_posix() for path in package.rglob("*") if path.is_file()}
    assert text.split("\n\n")[0] == "[beags.commands]\nbench = beags_benchmarks.experiments.commands:Bench"
    assert "[beags.sample_families]\nroom = beags_benchmarks.samples.room:ROOM\n" in text


def test_a_package_that_extends_beags_is_in_the_digest_of_trials(tmp_path, monkeypatch):
    """Else a trial would be taken for done although the refiner that it trained has changed."""
    (tmp_path / "others").mkdir()
    (tmp_path / "others/__init__.py").write_text("")
    (tmp_path / "others/refiner.py").write_text("one")
    monkeypatch.syspath_prepend(tmp_path)

    class Installed(Distribution):
        entry_points = [EntryPoint("mine", "others.refiner:Mine", "beags.refiners")]
        read_text = locate_file = None

    before = trials.code_of_trials()
    monkeypatch.setattr(trials, "distributions", lambda: [Installed()])
    joined = trials.code_of_trials()
    (tmp_path / "others/refiner.py").write_text("two")
    assert len({before, joined, trials.code_of_trials()}) == 3
