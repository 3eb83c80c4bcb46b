"""Exports of two blocks that touch and stand on a floor, from a run on disk that has kept its masks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from random_surfels import a_rotation
from solid_runs import COLOURED, write_kept_masks, write_solids, write_solids_run

pytest.importorskip("nerfstudio")
trimesh = pytest.importorskip("trimesh")
open3d = pytest.importorskip("open3d")

from beags_plugin.commands.cli import main
from beags_plugin.splat_io.frames import TRANSFORM_FILE
from beags_plugin.surfaces.color import srgb_from_linear
from beags_plugin.system.reading.ply import read_vertices

PAINTED = {0: (0.6, 0.6, 0.6), 1: (0.2, 0.7, 0.3), 2: (0.7, 0.7, 0.2)}  # colours of the photos, which the splats lack
BOXES = {
    "low": np.array([[-0.4, -0.2, 0.0], [0.0, 0.2, 0.25]]),
    "high": np.array([[0.0, -0.35, 0.0], [0.3, 0.35, 0.5]]),
}
RESOLUTION = 32


def points_of(path: Path) -> np.ndarray:
    table = read_vertices(path)
    return np.stack([table[axis] for axis in "xyz"], axis=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("solids")
    config, _ = write_solids_run(root / "run", write_solids(root / "lab", PAINTED), assigned=True, spilled=False)
    write_kept_masks(root / "run")
    return config


def export(config: Path, folder: Path, *options: str) -> dict[str, dict[str, Any]]:
    """Export all objects; return the manifest's entries by name, but the background's."""
    resolution = ("--resolution", str(RESOLUTION))
    main(["export", "--load-config", str(config), "--all", "--output", str(folder), *resolution, *options])
    objects = json.loads((folder / "manifest.json").read_text())["objects"]
    return {one["name"]: one for one in objects if one["name"] != "background"}


def mesh_in(path: Path) -> Any:
    """Return the mesh of a .glb, turned to z up."""
    (read,) = trimesh.load(path, process=False).geometry.values()
    read.vertices = read.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    return read


def on_top(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return which points [P, 3] are in the middle of a box's upper side."""
    middle, half = box.mean(axis=0), np.ptp(box, axis=0) / 2
    return (np.abs(points[:, 2] - box[1, 2]) < 0.03) & (np.abs(points - middle)[:, :2] < 0.6 * half[:2]).all(axis=1)


def shown_on_top(read: Any, box: np.ndarray) -> np.ndarray:
    """Return the mean colour, 0..1, that the texture has in the middle of the faces of a mesh's upper side."""
    picture = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
    top = on_top(read.triangles_center, box)
    uv = read.visual.uv[read.faces[top]].mean(axis=1)
    size = len(picture)
    column, row = (uv * [size, -size] + [0, size]).astype(int).clip(0, size - 1).T
    return picture[row, column].mean(axis=0) / 255.0


def test_a_glb_has_a_texture_of_the_photos(trained, tmp_path, capsys):
    """The photos are of another paint than the splats, whose colours the same mesh has without a texture."""
    textured = export(trained, tmp_path / "photos", "--format", "glb")
    said = " ".join(capsys.readouterr().out.split())
    plain = export(trained, tmp_path / "splats", "--format", "glb", "--texture", "none")
    for class_id, name in enumerate(BOXES, start=1):
        (file,), box = textured[name]["files"], BOXES[name]
        size, share = file["texture"]["size"], file["texture"]["from_photos"]
        assert size >= 128 and share > 0.4
        assert f"{name}.glb ({file['triangles']:,} triangles, a texture of {size} x {size}, {share:.0%} of it" in said
        read = mesh_in(tmp_path / f"photos/{name}.glb")
        assert np.abs(shown_on_top(read, box) - PAINTED[class_id]).max() < 0.03
        assert plain[name]["files"][0]["texture"] == "none"
        plain_read = open3d.io.read_triangle_mesh(str(tmp_path / f"splats/{name}.glb"))
        top = on_top(np.asarray(plain_read.vertices)[:, [0, 2, 1]] * [1.0, -1.0, 1.0], box)
        splats = srgb_from_linear(np.asarray(plain_read.vertex_colors)[top].mean(axis=0))
        assert np.abs(splats - COLOURED[class_id]).max() < 0.03


def test_what_stands_on_a_plane_is_turned_upright(trained, tmp_path):
    """The input's world is tilted against the run's; the plane is what the run's own views show."""
    tilt = a_rotation(3)
    transform = torch.cat([tilt, torch.tensor([[0.4], [-0.2], [0.1]], dtype=torch.float64)], dim=1)
    (trained.parent / TRANSFORM_FILE).write_text(json.dumps({"transform": transform.tolist(), "scale": 0.5}))
    try:
        as_it_is = export(trained, tmp_path / "tilted", "--centre")
        upright = export(trained, tmp_path / "upright", "--up", "plane", "--centre")
    finally:
        (trained.parent / TRANSFORM_FILE).unlink()
    for name, box in BOXES.items():
        sides = 2.0 * np.ptp(box, axis=0)  # The run is half as large as the input.
        up = np.array(upright[name]["up"])
        assert up @ tilt.numpy().T[:, 2] > np.cos(np.radians(1.0))
        points, tilted = (points_of(tmp_path / folder / f"{name}.ply") for folder in ("upright", "tilted"))
        assert points[:, 2].min() > -0.02 and abs(points[:, 2].max() - sides[2]) < 0.02
        top = points[np.abs(points[:, 2] - sides[2]) < 0.02]  # a level sheet
        assert len(top) > 40 and np.abs(top[:, :2].mean(axis=0)).max() < 0.02  # the origin is under its middle
        assert abs(np.ptp(tilted[:, 2]) - sides[2]) > 0.2 and np.array(as_it_is[name]["up"])[2] == pytest.approx(1.0)


def test_blocks_that_touch_are_closed_where_they_do(trained, tmp_path):
    """None reaches into the other. The hole at the side joins the one underneath, and one sheet cuts across both."""
    found = export(trained, tmp_path, "--format", "ply", "glb", "--close")
    for name, least, towards in (("low", 0.35, 1.0), ("high", 0.7, -1.0)):
        low, high = BOXES[name]
        read, beyond = mesh_in(tmp_path / f"{name}.glb"), 0.07  # Discs at its rims reach that far.
        solid = trimesh.Trimesh(read.vertices, read.faces)
        assert solid.is_watertight and least < solid.volume / np.prod(high - low) < 1.1
        assert (towards * read.vertices[:, 0]).max() < beyond
        invented = read.vertices[np.ravel(read.vertex_attributes["_INVENTED"]) > 0]
        assert ((np.abs(invented[:, 1]) < 0.15) & (invented[:, 2] > 0.05)).sum() > 10  # The floor hid nothing up there.
        assert found[name]["closing_gaussians"]["gaussians"] > 20
        table = read_vertices(tmp_path / f"{name}.ply")
        added = points_of(tmp_path / f"{name}.ply")[table["invented"] == 1]
        assert (towards * added[:, 0]).max() < beyond and (added[:, 2] > 0.05).sum() > 5
