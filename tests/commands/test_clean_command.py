"""``beags clean``: a scene of another program is refined and written back in its own format."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from random_surfels import random_surfels
from run_folders import discs
from start_scenes import write_start_scene
from written_splats import read_back, write

pytest.importorskip("nerfstudio")

import beags_plugin.commands.scene_setup as made_scenes
from beags_plugin.commands.cli import main
from beags_plugin.commands.made_masks import SALIENT
from beags_plugin.importers.base import read_scene
from beags_plugin.objects.written_back import changes, format_of
from beags_plugin.surfaces.closing_gaussians import joined


@pytest.mark.slow("refines a scene of another program")
def test_a_scene_is_refined_and_written_back_in_its_format(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = write_start_scene(tmp_path / "data")
    write(tmp_path / "my scene.spz", "spz", scene.surfels)
    arguments = ["clean", "my scene.spz", "--data", "data", "--polish", "1", "--steps", "2", "--object"]
    with pytest.raises(SystemExit):
        main([*arguments, "cup"])
    assert "there is no object 'cup'" in capsys.readouterr().out and not Path("outputs/my scene_cleaned/run").exists()
    main([*arguments, "class_1"])
    folder = Path("outputs/my scene_cleaned")
    report = json.loads((folder / "clean.json").read_text())
    assert report["files"] == [str(folder / "my scene.cleaned.spz"), str(folder / "my scene.class_1.spz")]
    assert report["polish"] == 1 and report["start"]["psnr"] > 40
    cleaned, alone = (read_scene(folder / f"my scene.{name}.spz") for name in ("cleaned", "class_1"))
    assert cleaned.kind == ".spz version 3" and 0 < len(alone.gaussians) < len(cleaned.gaussians)
    found = report["changes"]
    assert (found["before"], found["after"]) == (75, len(cleaned.gaussians))
    # The result is in the frame of the input file: two steps have hardly moved it.
    before, after = scene.surfels.means, cleaned.gaussians.means
    assert torch.cdist(after, before).amin(dim=1).median() < 0.02
    out = " ".join(capsys.readouterr().out.split())
    assert report["start"]["held_out"]["psnr"] > 40 and f"dB in {report['start']['held_out']['views']} held-out" in out
    assert "75 Gaussians became" in out and "as it came (flattened: thinnest scale" in out and "after it: " in out
    psnr = report["metrics"]["psnr"]
    assert psnr["before"] > 30 and psnr["after"] > 30
    with pytest.raises(SystemExit):
        main([*arguments, "class_1"])
    assert "holds a cleaned scene: add --overwrite" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(SystemExit):
        main(["clean", "my scene.spz", "--data", "data", "--output", "data", "--polish", "-1"])
    (tmp_path / "mine/run").mkdir(parents=True)
    with pytest.raises(SystemExit):
        main(["clean", "my scene.spz", "--data", "data", "--output", "mine"])
    assert "is not of beags clean" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow("refines a scene of another program")
def test_masks_are_made_where_there_are_none_and_gaussians_with_volume_are_polished(tmp_path, monkeypatch, capsys):
    """The photos have poses but no masks: a source of masks, here a given one, finds what stands out in them."""
    monkeypatch.chdir(tmp_path)
    scene = write_start_scene(tmp_path / "data")
    (tmp_path / "made").mkdir()
    (tmp_path / "data/masks").rename(tmp_path / "made/masks")
    asked = []
    monkeypatch.setattr(made_scenes, "check_source", lambda chosen: None)
    monkeypatch.setattr(made_scenes, "made_masks", lambda *where: asked.append(where) or tmp_path / "made")
    write(tmp_path / "scene.ply", "ply", scene.surfels)
    main(["clean", "scene.ply", "--data", "data", "--output", "out", "--polish", "2", "--steps", "2"])
    report = json.loads(Path("out/clean.json").read_text())
    assert asked == [(Path("data"), Path("out/made"), "data", SALIENT)] and report["polish"] == 2
    assert report["start"]["flattening"]["median_ratio"] == pytest.approx(1e-3, rel=1e-3)
    assert report["metrics"]["psnr"]["before"] > 30  # The polish comes first.
    assert read_scene(Path("out/scene.cleaned.ply")).kind == "3DGS .ply"
    assert "were split and" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("kind", "name", "options"),
    [
        ("ply", "a.ply", {}),
        ("ply-2dgs", "a.2dgs.ply", {}),
        ("compressed-ply", "a.compressed.ply", {}),
        ("sog", "a.sog", {}),
        ("splat", "a.splat", {}),
        ("spz", "a.spz", {"version": 3}),
        ("spz", "b.spz", {"version": 4}),
        ("gltf-splats", "a.splats.glb", {}),
        ("usdz-splats", "a.splats.usdz", {"kernel": "ellipsoid"}),
        ("usda-splats", "a.splats.usda", {"kernel": "surflet"}),
    ],
)
def test_every_format_is_written_back_as_it_came(tmp_path, kind, name, options):
    if kind.startswith("usd"):
        pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (pip install beags[usd])")
    if options == {"version": 4}:
        pytest.importorskip("zstandard")
    path = write(tmp_path / name, kind, random_surfels(count=20), **options)
    found = format_of(path, read_scene(path))
    assert (found.exporter, found.options, found.note) == (kind, options, "")
    assert len(read_back(write(tmp_path / f"again.{name}", found.exporter, random_surfels(), **found.options))) == 7


def test_what_is_not_written_becomes_a_ply_and_is_said(tmp_path):
    scene = replace(read_scene(write(tmp_path / "a.ply", "ply", random_surfels())), kind="run of splatfacto")
    found = format_of(tmp_path, scene)
    assert found.exporter == "ply" and found.note == "A run of splatfacto cannot be written, so a .ply of 3DGS is."


def test_changes_are_counted_by_nearest_neighbours():
    before, _ = discs()
    moved = before.means.clone()
    moved[0] += 0.001
    moved[1] += 3.0  # far away: nobody's neighbour but still the same one, as no other is nearer to it
    halves = before[2:3]
    after = joined(replace(before, means=moved)[torch.arange(75) != 5], replace(halves, means=halves.means + 0.01))
    found = changes(before, after)
    assert (found.before, found.after) == (75, 75)
    assert found.new == found.split + found.dropped == 75 - found.kept and found.dropped >= 1
    assert found.kept in (73, 74) and found.moved <= 1 and found.median == 0
    assert "75 Gaussians became 75" in str(found)
    assert changes(before[:0], after).new == 75 and changes(before, after[:0]).dropped == 75


def test_what_is_split_is_told_from_what_is_dropped():
    before, _ = discs()
    sizes = before.log_scales.exp().amax(dim=1, keepdim=True)
    one, shift = before[:1], torch.tensor([[1.0, 0.0, 0.0]])
    halves = [replace(one, means=one.means + sign * 0.5 * sizes[0] * shift) for sign in (1, -1)]
    far = before.means.clone()
    far[1:] += 100.0 * torch.arange(1, 75)[:, None]  # neighbours out of reach
    spread = replace(before, means=far)
    found = changes(spread, joined(joined(halves[0], halves[1]), spread[2:]))
    assert (found.before, found.after, found.moved) == (75, 75, 0)
    assert found.dropped == 1 and found.split + found.kept == 74 and found.new == 75 - found.kept
