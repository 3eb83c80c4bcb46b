"""Exports that are killed leave nothing half written under a file's name, and the next one tidies up after them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from export_formats import formats_here
from killed_exports import export
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands.cli import main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("lab")
    return write_trained(root / "run", write_scene(root / "lab"))


def age(folder: Path, seconds: float) -> None:
    """Make unfinished files look as old as that."""
    for part in folder.glob(".*.part"):
        os.utime(part, (time.time() - seconds,) * 2)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked")
@pytest.mark.slow("kills an export once in each format")
def test_a_killed_export_leaves_whole_files_and_no_manifest_in_any_format(trained, tmp_path):
    formats = formats_here()
    assert len(formats) >= 5
    for name in formats:  # an older export has a manifest of other files
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_text("{}")
    program = [sys.executable, str(ROOT / "tests/support/killed_exports.py"), str(trained), str(tmp_path), *formats]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests/support")])}
    subprocess.run(program, check=True, env=environment, timeout=900)
    for name in formats:
        folder = tmp_path / name
        left = {path.name for path in folder.iterdir()}
        (part,) = (each for each in left if each.startswith("."))
        assert part.endswith(".part") and "manifest.json" not in left
        age(folder, 60.0)
        whole = {each: (folder / each).read_bytes() for each in left - {part}}
        assert len(whole) == 1
        export(trained, folder, name)
        there = {path.name for path in folder.iterdir()}
        assert not any(each.startswith(".") for each in there) and part[1:].removesuffix(".part") in there
        objects = json.loads((folder / "manifest.json").read_text())["objects"]
        assert there == {file["path"] for one in objects for file in one["files"]} | {"manifest.json"}
        for each, content in whole.items():
            assert (folder / each).read_bytes() == content


def test_unfinished_files_of_other_formats_go_but_not_those_that_are_being_written(trained, tmp_path):
    for name in (".cup.glb.part", ".manifest.json.part", ".now.spz.part", ".film.mkv.part"):
        (tmp_path / name).write_bytes(b"half")
    age(tmp_path, 60.0)
    os.utime(tmp_path / ".now.spz.part", (time.time() + 3600.0,) * 2)
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper/.cup.glb.part").write_bytes(b"half")
    age(tmp_path / "deeper", 60.0)
    (tmp_path / "cup.part").write_bytes(b"of somebody else")
    age_of_all = {"cup.part", ".now.spz.part", ".film.mkv.part", "deeper"}
    main(["export", "--load-config", str(trained), "--object", "cup", "--output", str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == age_of_all | {"cup.ply"}
    assert (tmp_path / "deeper/.cup.glb.part").exists()


def test_a_manifest_goes_before_a_file_that_it_lists_is_written_again(trained, tmp_path, monkeypatch):
    main(["export", "--load-config", str(trained), "--all", "--output", str(tmp_path)])
    manifest = tmp_path / "manifest.json"
    main(["export", "--load-config", str(trained), "--object", "cup", "--format", "spz", "--output", str(tmp_path)])
    assert manifest.exists()  # It lists other files.
    seen = []

    def fail(self, path, item):
        seen.append(manifest.exists())
        raise KeyboardInterrupt

    monkeypatch.setattr("beags_plugin.export.splats.PlyExporter.write", fail)
    for choice in (["--object", "cup"], ["--all"]):
        manifest.write_text(manifest.read_text() if manifest.exists() else "{}")
        with pytest.raises(SystemExit):
            main(["export", "--load-config", str(trained), *choice, "--output", str(tmp_path)])
    assert seen == [False, False] and not manifest.exists()


def test_a_mistake_leaves_the_manifest(trained, tmp_path):
    main(["export", "--load-config", str(trained), "--all", "--output", str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["export", "--load-config", str(trained), "--all", "--format", "3mf", "--output", str(tmp_path)])
    assert (tmp_path / "manifest.json").exists()
