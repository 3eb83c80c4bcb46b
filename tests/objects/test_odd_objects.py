"""Objects without Gaussians, and of a few: what is written of them, or what is said instead."""

from __future__ import annotations

import gzip
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from export_formats import formats_here
from run_folders import discs, rename_classes, state_of, write_scene, write_trained

pytest.importorskip("nerfstudio")

from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.importers.base import read_scene
from beags_plugin.runs.relocation import open_run
from beags_plugin.runs.write import write_run
from beags_plugin.system.reading.ply import read_vertices


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
    main(["export", "--load-config", str(tmp_path / "runs/cup/config.yml"), "--all"])  # This run has the cup alone.
    assert "no Gaussian belongs" not in capsys.readouterr().out
    assert manifest_in(tmp_path / "runs/cup/exports")["empty"] == []


def test_one_object_without_gaussians_is_named(tmp_path, capsys):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    rename_classes(config, {0: "background", 1: "cup", 2: "box", 3: "lid"})
    main(["export", "--load-config", str(config), "--all", "--output", str(tmp_path / "files")])
    assert last_line(capsys) == "no Gaussian belongs to 'lid': nothing is exported of it."


def opened_mesh(path: Path) -> bool:
    import trimesh

    mesh = trimesh.load(path, process=False)
    mesh = mesh.to_mesh() if hasattr(mesh, "to_mesh") else mesh
    return len(mesh.faces) > 3 and bool((mesh.extents > 0).all())


def opened_package(path: Path) -> bool:
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
    return bool(stage.GetDefaultPrim())


OPENED: dict[str, Callable[[Path], bool]] = {
    "ply": lambda path: len(read_ply(path)[0]) == 10,
    "ply-2dgs": lambda path: len(read_vertices(path)) == 10,
    "compressed-ply": lambda path: (
        path.read_bytes().startswith(b"ply\n") and b"element vertex 10\n" in path.read_bytes()
    ),
    "spz": lambda path: gzip.decompress(path.read_bytes())[8:12] == (10).to_bytes(4, "little"),
    "sog": lambda path: json.loads(zipfile.ZipFile(path).read("meta.json"))["count"] == 10,
    "html": lambda path: path.read_text("utf8").startswith("<!doctype html>"),
    "gltf-splats": lambda path: len(read_scene(path).gaussians) == 10,
    "gltf-both": lambda path: len(read_scene(path).gaussians) == 10,
    "usdz-splats": lambda path: len(read_scene(path).gaussians) == 10,
    "glb": opened_mesh,
    "obj": opened_mesh,
    "stl": opened_mesh,
    "3mf": opened_mesh,
    "usdz": opened_package,
}  # each says whether a file of the ten Gaussians can be opened, by another project's reader where there is one


@pytest.mark.parametrize("kind", ["a clump", "far apart", "faint"])
@pytest.mark.parametrize("close", [(), ("--close",)])
def test_an_object_of_ten_gaussians_is_a_file_that_opens_or_a_sentence(tmp_path, capsys, kind, close):
    pytest.importorskip("open3d")
    pytest.importorskip("trimesh")
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    surfels, ids = discs()
    few = surfels[ids == 1][:10]
    if kind == "far apart":
        few = replace(few, means=4.0 * few.means, log_scales=few.log_scales - 2.0)
    elif kind == "faint":
        few = replace(few, opacity_logits=torch.full((10,), -3.0))
    write_run(open_run(config), config.parent, state_of(few, torch.ones(10, dtype=torch.int32)), 299)
    formats = [name for name in formats_here() if name in OPENED]
    assert {"ply", "glb", "3mf", "html"} <= set(formats)
    arguments = ["--all", "--format", *formats, "--scale-by", "0,0,0 1,0,0 1 m", "--resolution", "32", *close]
    main(["export", "--load-config", str(config), "--output", str(tmp_path / "files"), *arguments])
    said = " ".join(capsys.readouterr().out.split())
    (one,) = manifest_in(tmp_path / "files")["objects"]
    written = {file["format"]: tmp_path / "files" / file["path"] for file in one["files"]}
    refused = {each["format"]: each["reason"] for each in one["left_out"]}
    assert written.keys() | refused.keys() == set(formats) and not written.keys() & refused.keys()
    assert one["closing_gaussians"]["gaussians"] == 0 if close else "closing_gaussians" not in one
    for name, path in written.items():
        assert OPENED[name](path), name
    for name, reason in refused.items():
        assert name in ("gltf-both", "glb", "usdz", "obj", "stl", "3mf") and f"no {name}: {reason}" in said
        assert "'cup'" in reason and reason.endswith(".") and ("is seen in 3" in reason or "encloses nothing" in reason)
    if kind == "a clump":
        assert {"glb", "3mf"} <= written.keys()
    if kind == "faint":
        assert {"glb", "3mf"} <= refused.keys()
