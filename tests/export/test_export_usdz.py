"""A .usdz is read back by Pixar's library, whose validators find nothing."""

from __future__ import annotations

import io
import sys
import zipfile

import numpy as np
import pytest

pytest.importorskip("open3d")
pytest.importorskip("trimesh")
pytest.importorskip("pxr", reason="usd-core is not installed (pip install beags[usdz])")

from PIL import Image
from pxr import Usd, UsdGeom, UsdShade, UsdValidation
from textured_balls import a_ball, texture_of

from beags_plugin.export.base import make_exporter
from beags_plugin.export.usdz import usdz_bytes
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.surface import vertex_normals
from beags_plugin.system.errors import UserError


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("closed", [False, True])
def test_pixars_library_reads_it(tmp_path, textured, closed):
    mesh, path = a_ball(), tmp_path / "ball.usdz"
    texture = texture_of(mesh) if textured else None
    invented = mesh.vertices[:, 2] < 2.9 if closed else None
    path.write_bytes(usdz_bytes(mesh, "a naïve ball", texture, invented))
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetDisplayName() == "a naïve ball"
    shape, source = UsdGeom.Mesh.Get(stage, "/Object/Mesh"), slice(None) if texture is None else texture.atlas.source
    y_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert np.allclose(shape.GetPointsAttr().Get(), (mesh.vertices @ y_up)[source], atol=1e-6)
    assert np.allclose(shape.GetNormalsAttr().Get(), (vertex_normals(mesh) @ y_up)[source], atol=1e-6)
    faces = mesh.faces if texture is None else texture.atlas.faces
    assert np.array_equal(np.reshape(shape.GetFaceVertexIndicesAttr().Get(), (-1, 3)), faces)
    primvars = UsdGeom.PrimvarsAPI(shape)
    if texture is None:
        colors = primvars.GetPrimvar("displayColor").Get()
        assert np.allclose(colors, linear_from_srgb(mesh.colors), atol=1e-6)
    else:
        assert np.allclose(primvars.GetPrimvar("st").Get(), texture.atlas.uv * [1, -1] + [0, 1], atol=1e-6)
        with zipfile.ZipFile(path) as package:
            (name,) = (name for name in package.namelist() if name.endswith(".png"))
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(package.read(name)))), texture.image)
    assert primvars.HasPrimvar("invented") == closed
    if invented is not None:
        assert np.array_equal(primvars.GetPrimvar("invented").Get(), np.float32(invented[source]))
    material, _ = UsdShade.MaterialBindingAPI(shape.GetPrim()).ComputeBoundMaterial()
    assert material.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"


def issues(path) -> list[str]:
    """Return what Pixar's validators find in a file."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert validators
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetMessage() for error in found]


@pytest.mark.parametrize("textured", [False, True])
def test_the_validators_find_nothing(tmp_path, textured):
    mesh, path = a_ball(), tmp_path / "ball.usdz"
    path.write_bytes(usdz_bytes(mesh, "ball", texture_of(mesh) if textured else None))
    assert issues(path) == []


def test_the_validators_find_what_is_wrong(tmp_path):
    """Else the test above would say nothing."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    UsdGeom.Mesh.Define(stage, "/Mesh").CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.GetRootLayer().Save()
    assert issues(tmp_path / "bare.usda")


def test_the_same_content_again():
    mesh = a_ball()
    first, second = (zipfile.ZipFile(io.BytesIO(usdz_bytes(mesh, "ball", texture_of(mesh)))) for _ in range(2))
    assert first.namelist() == second.namelist()
    assert all(first.read(name) == second.read(name) for name in first.namelist())


def test_without_the_library_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.UsdUtils", None)
    with pytest.raises(UserError, match="pip install usd-core"):
        make_exporter("usdz")
