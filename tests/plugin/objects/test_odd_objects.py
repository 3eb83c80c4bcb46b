"""Objects without Gaussians, and of a few: what is written of them, or what is said instead."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_folders import rename_classes, write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands.cli import main


def manifest_in(folder: Path) -> dict:
    return json.loads((folder / "manifest.json").read_text())


def last_line(capsys) -> str:
    return capsys.readouterr().out.strip().splitlines()[-1]


def test_objects_without_gaussians_are_named(tmp_path, capsys):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    rename_classes(config, {0: "background", 1: "cup", 2: "box", 3: "lid", 7: "spoon"})
    main(["export", "--load-config", str(config), "--all", "--output", str(tmp_path / "files")])
    assert last_line(capsys) == "no Gaussian belongs to 'lid', 'spoon': nothing is exported of them."
    assert manifest_in(tmp_path / "files")["empty"] == [
        {"name": "lid", "class_id": 3}, {"name": "spoon", "class_id": 7},
    ]  # fmt: skip
    assert {path.name for path in (tmp_path / "files").glob("*.ply")} == {"background.ply", "cup.ply", "box.ply"}
    main(["extract", "--load-config", str(config), "--output", str(tmp_path / "runs")])
    assert last_line(capsys) == "no Gaussian belongs to 'lid', 'spoon': nothing is extracted of them."
    with pytest.raises(SystemExit):
        main(["export", "--load-config", str(config), "--object", "lid", "--output", str(tmp_path / "none")])
    assert "no Gaussian belongs to 'lid': its masks cover too little" in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "none").exists()


def test_where_all_have_gaussians_or_are_not_asked_for_nothing_is_said(tmp_path, capsys):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    main(["export", "--load-config", str(config), "--all", "--output", str(tmp_path / "files")])
    assert manifest_in(tmp_path / "files")["empty"] == []
    rename_classes(config, {0: "background", 1: "cup", 2: "box", 3: "lid"})
    main(["export", "--load-config", str(config), "--object", "cup", "--output", str(tmp_path / "one")])
    main(["extract", "--load-config", str(config), "--object", "cup", "--output", str(tmp_path / "runs")])
    main(["export", "--load-config", str(tmp_path / "runs/cup/config.yml"), "--all"])  # which lacks all but the cup
    assert "no Gaussian belongs" not in capsys.readouterr().out
    assert manifest_in(tmp_path / "runs/cup/exports")["empty"] == []


def test_one_object_without_gaussians_is_named(tmp_path, capsys):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    rename_classes(config, {0: "background", 1: "cup", 2: "box", 3: "lid"})
    main(["export", "--load-config", str(config), "--all", "--output", str(tmp_path / "files")])
    assert last_line(capsys) == "no Gaussian belongs to 'lid': nothing is exported of it."
