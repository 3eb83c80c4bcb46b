"""Khronos' own validator of glTF finds nothing in the .glb files, where npm has installed it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("open3d")
pytest.importorskip("trimesh")

from photographed_box import EYES, a_box, camera_from, photo_of
from textured_balls import a_ball, texture_of

from beags_plugin.export.base import make_exporter
from beags_plugin.export.glb import glb_bytes
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.texture import textured

_PROGRAM = """
const validator = require(process.argv[1]);
validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[2])))
    .then((report) => console.log(JSON.stringify(report)));
"""


@cache
def validator() -> Path | None:
    """Return the folder of Khronos' package: that of GLTF_VALIDATOR, or one that npm has installed for all."""
    if named := os.environ.get("GLTF_VALIDATOR"):
        return Path(named).absolute()
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        return None
    root = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=60).stdout.strip()
    return found if root and (found := Path(root) / "gltf-validator").is_dir() else None


VALIDATED = pytest.mark.skipif(
    validator() is None,
    reason="Khronos' gltf-validator is missing, so nothing says whether .glb files are valid "
    "(npm install -g gltf-validator, or name its folder in GLTF_VALIDATOR)",
)


def report(path: Path) -> dict:
    """Return what the validator says of a file."""
    command = ["node", "-e", _PROGRAM, str(validator()), str(path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def with_slivers(mesh: Mesh) -> Mesh:
    """Return the mesh with a face of no area, as decimation may leave one; its vertices have no normal of their own."""
    count = len(mesh.vertices)
    line = np.array([[2.0, 0.0, 0.0], [3.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, line]),
        faces=np.concatenate([mesh.faces, [[count, count + 1, count + 2]]]),
        colors=np.concatenate([mesh.colors, np.zeros((3, 3), np.float32)]),
    )


@VALIDATED
@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("closed", [False, True])
def test_the_validator_finds_nothing(tmp_path, textured, closed):
    mesh = a_ball()
    invented = mesh.vertices[:, 2] < 2.9 if closed else None
    path = tmp_path / "ball.glb"
    path.write_bytes(glb_bytes(mesh, 'a "cup" of naïve tea', texture_of(mesh) if textured else None, invented))
    if closed:  # The file also stands where map coordinates put it.
        assert make_exporter("glb").to_world(path, torch.tensor([453_211.37, 5_411_873.94, 512.25]).double())
    found = report(path)
    assert found["issues"]["messages"] == [], found["issues"]
    assert found["info"]["totalTriangleCount"] == len(mesh.faces) and found["info"]["hasTextures"] == textured


@VALIDATED
def test_the_validator_finds_nothing_in_a_texture_as_large_as_photos_need(tmp_path):
    box = a_box()
    texture = textured(box, [photo_of(box, camera_from(eye)) for eye in EYES], 0)
    (tmp_path / "box.glb").write_bytes(glb_bytes(box, "box", texture))
    found = report(tmp_path / "box.glb")
    assert found["issues"]["messages"] == [], found["issues"]


@VALIDATED
def test_the_validator_finds_nothing_wrong_with_slivers(tmp_path):
    mesh = with_slivers(a_ball())
    (tmp_path / "slivers.glb").write_bytes(glb_bytes(mesh, "slivers"))
    assert report(tmp_path / "slivers.glb")["issues"]["numErrors"] == 0


@VALIDATED
def test_the_validator_finds_what_is_wrong(tmp_path):
    """Else the tests above would say nothing."""
    raw = glb_bytes(a_ball(), "wrong")
    (tmp_path / "wrong.glb").write_bytes(raw.replace(b'"SCALAR"', b'"SCALES"'))
    assert report(tmp_path / "wrong.glb")["issues"]["numErrors"] > 0
