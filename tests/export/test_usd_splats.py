"""USD of splats: Pixar's library opens it, its validators find nothing, and places, scales and colours come back."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")
volumes = pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (pip install beags[usd])")
if not hasattr(volumes, "ParticleField3DGaussianSplat"):
    pytest.skip("usd-core is older than 26.3 and knows no splats", allow_module_level=True)

from disc_meshes import discs_on
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdValidation, Vt
from random_surfels import random_surfels
from run_folders import discs
from test_closing import a_box, item_of
from written_splats import differences, write

from beags_plugin.core.flattening import flatten
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export import usdz
from beags_plugin.export.base import make_exporter
from beags_plugin.importers.base import read_scene
from beags_plugin.splat_io.ply import THICKNESS
from beags_plugin.surfaces.closing_gaussians import with_closing
from beags_plugin.surfaces.item import ExportItem, NothingToExport
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.errors import UserError

NAMES = {0: "background", 1: "a naïve cup", 2: "a-naïve cup"}
KINDS = pytest.mark.parametrize("kind", ["usdz-splats", "usda-splats"])


def path_of(folder, kind: str):
    return folder / f"scene.splats.{kind[:4]}"


def issues(path) -> list[str]:
    """Return what Pixar's validators, those of usdchecker, find in a file."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetMessage() for error in found]


@KINDS
@pytest.mark.parametrize("kernel", ["ellipsoid", "surflet"])
@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_a_prim_for_each_object_under_one_root(tmp_path, kind, kernel, up_axis):
    surfels, ids = discs()
    path, item = path_of(tmp_path, kind), ExportItem("whole scene", surfels, ids, class_names=NAMES)
    assert make_exporter(kind, kernel=kernel, up_axis=up_axis).write(path, item) == {"prims": 3, "kernel": kernel}
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == up_axis.upper() and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    (root,) = stage.GetPseudoRoot().GetChildren()
    assert root == stage.GetDefaultPrim() and root.GetDisplayName() == "whole scene"
    objects = root.GetChildren()
    assert [prim.GetDisplayName() for prim in objects] == list(NAMES.values())
    assert len({prim.GetName() for prim in objects}) == 3
    for class_id, prim in enumerate(objects):
        (splats,) = prim.GetChildren()
        assert splats.GetTypeName() == {"ellipsoid": "ParticleField3DGaussianSplat", "surflet": "ParticleField"}[kernel]
        kernels = [name for name in splats.GetAppliedSchemas() if "Gaussian" in name]
        assert kernels == [f"ParticleFieldKernelGaussian{kernel.capitalize()}API"]
        assert UsdGeom.PrimvarsAPI(splats).GetPrimvar("class_id").Get() == class_id
    assert issues(path) == []
    scene = read_scene(path)
    assert scene.kind == ("USD of splats" if kernel == "ellipsoid" else "USD of surflets")
    order = torch.argsort(ids, stable=True)
    assert max(differences(flatten(scene.gaussians)[0], surfels[order]).values()) < 1e-4


def test_places_scales_and_colours_are_read_back_by_pixars_library(tmp_path):
    surfels = random_surfels(count=40)
    stage = Usd.Stage.Open(str(write(tmp_path / "cup.splats.usdz", "usdz-splats", surfels, up_axis="z")))
    field = volumes.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/cup/Splats"))
    assert np.allclose(field.GetPositionsAttr().Get(), surfels.means)
    lengths = surfels.log_scales.exp()
    thin = THICKNESS * lengths.amin(dim=1, keepdim=True)
    assert np.allclose(field.GetScalesAttr().Get(), torch.cat([lengths, thin], dim=1), rtol=1e-5)
    assert np.allclose(field.GetOpacitiesAttr().Get(), opacities(surfels.opacity_logits), atol=1e-6)
    unit = torch.nn.functional.normalize(surfels.quats, dim=1)
    found = [[quat.GetReal(), *quat.GetImaginary()] for quat in field.GetOrientationsAttr().Get()]
    assert np.allclose(found, unit, atol=1e-6)
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3
    coefficients = np.reshape(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(), (40, 16, 3))
    assert np.allclose(coefficients, surfels.sh, atol=1e-6)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < surfels.means.numpy()).all() and (high > surfels.means.numpy()).all()


@KINDS
def test_the_same_bytes_again(tmp_path, kind):
    """A package keeps the times of its files."""
    first = write(tmp_path / f"a.{kind[:4]}", kind, random_surfels()).read_bytes()
    time.sleep(2.1)  # the times of a package count every second one
    assert write(tmp_path / f"b.{kind[:4]}", kind, random_surfels()).read_bytes() == first


def test_y_up_turns_places_rotations_and_colours(tmp_path):
    surfel = Surfels(
        torch.tensor([[1.0, 2.0, 3.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[-2.0, -1.0]]),
        torch.tensor([0.0]),
        torch.zeros(1, 3),
        torch.tensor([[[0.1] * 3, [0.4] * 3, [0.7] * 3]]),
    )
    stage = Usd.Stage.Open(str(write(tmp_path / "cup.splats.usda", "usda-splats", surfel)))
    field = volumes.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/cup/Splats"))
    assert np.allclose(field.GetPositionsAttr().Get(), [[1, 3, -2]])
    s = math.sqrt(0.5)
    quat = field.GetOrientationsAttr().Get()[0]
    assert np.allclose([quat.GetReal(), *quat.GetImaginary()], [s, -s, 0, 0], atol=1e-6)
    assert np.allclose(
        field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()[1:], [[-0.4] * 3, [0.1] * 3, [0.7] * 3]
    )


@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_a_closed_object_has_its_closed_mesh_as_collider(tmp_path, up_axis):
    options = MeshOptions(resolution=48)
    item, added = with_closing(item_of(discs_on(a_box(bottom=False))), options)
    path = tmp_path / "box.splats.usdz"
    facts = make_exporter("usdz-splats", up_axis=up_axis, mesh=options).write(path, item)
    assert added.gaussians > 0 and facts["collider"].endswith("triangles")
    stage = Usd.Stage.Open(str(path))
    shape = UsdGeom.Mesh.Get(stage, "/Scene/box/Collider")
    assert shape.GetPrim().HasAPI(UsdPhysics.CollisionAPI) and shape.GetPurposeAttr().Get() == "guide"
    assert UsdPhysics.MeshCollisionAPI(shape.GetPrim()).GetApproximationAttr().Get() == "convexDecomposition"
    faces = np.reshape(shape.GetFaceVertexIndicesAttr().Get(), (-1, 3))
    mesh = trimesh.Trimesh(np.array(shape.GetPointsAttr().Get()), faces)
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.8**3, rel=0.1)
    splats = stage.GetPrimAtPath("/Scene/box/Splats")
    assert sum(UsdGeom.PrimvarsAPI(splats).GetPrimvar("invented").Get()) == added.gaussians
    assert issues(path) == []
    make_exporter("usdz-splats").write(tmp_path / "open.splats.usdz", replace(item, close=False))
    assert not Usd.Stage.Open(str(tmp_path / "open.splats.usdz")).GetPrimAtPath("/Scene/box/Collider")


def test_what_encloses_nothing_has_no_collider_but_its_splats(tmp_path):
    surfels = random_surfels(count=12)
    facts = make_exporter("usdz-splats").write(tmp_path / "box.splats.usdz", item_of(surfels))
    assert facts["collider"].startswith("none, as ")
    assert len(read_scene(tmp_path / "box.splats.usdz").gaussians) == 12


def test_half_floats_transforms_and_what_is_missing_are_read(tmp_path):
    """The file is written by hand, as another program may write it."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "theirs.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    place = UsdGeom.Xform.Define(stage, "/Room")
    place.AddTranslateOp().Set(Gf.Vec3d(10, 0, 0))
    place.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    field = volumes.ParticleField3DGaussianSplat.Define(stage, "/Room/Splats")
    field.GetPrim().GetAttribute("positionsh").Set(Vt.Vec3hArray([Gf.Vec3h(1, 2, 3), Gf.Vec3h(0, 0, 0)]))
    field.GetScalesAttr().Set(Vt.Vec3fArray([(0.5, 0.25, 0.125)] * 2))
    field.GetOpacitiesAttr().Set([0.25])  # The list is too short, so it is ignored.
    stage.GetRootLayer().Save()
    found = read_scene(tmp_path / "theirs.usda").gaussians
    assert found.means.tolist() == [[12, 4, 6], [10, 0, 0]]
    assert torch.allclose(found.log_scales.exp(), torch.tensor([[1.0, 0.5, 0.25]] * 2))
    assert opacities(found.opacity_logits).tolist() == [1, 1] and found.quats.tolist() == [[1, 0, 0, 0]] * 2


def test_what_cannot_be_read_or_written(tmp_path, monkeypatch):
    (tmp_path / "text.usda").write_text("#usda 1.0\nnothing of the kind {")
    with pytest.raises(UserError, match="is no USD of splats file, or damaged"):
        read_scene(tmp_path / "text.usda")
    (tmp_path / "bare.usda").write_text("#usda 1.0\n")
    with pytest.raises(UserError, match="no particle field"):
        read_scene(tmp_path / "bare.usda")
    with pytest.raises(UserError, match="there is no kernel 'cube'"):
        make_exporter("usda-splats", kernel="cube")
    with pytest.raises(NothingToExport):
        write(tmp_path / "none.usda", "usda-splats", random_surfels()[:0])
    monkeypatch.delattr(volumes, "ParticleField3DGaussianSplat")
    with pytest.raises(UserError, match="older than 26.3"):
        make_exporter("usda-splats")
    assert usdz.modules("UsdGeom") == [UsdGeom]


@KINDS
@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_map_coordinates_are_a_shift_of_the_root_in_double_precision(tmp_path, kind, up_axis):
    surfels, ids = discs()
    path, exporter = path_of(tmp_path, kind), make_exporter(kind, up_axis=up_axis)
    exporter.write(path, ExportItem("whole scene", surfels, ids, class_names=NAMES))
    before = read_scene(path).gaussians.means.double()
    origin = torch.tensor([453_211.37, 5_411_873.94, 512.25], dtype=torch.float64)
    assert exporter.to_world(path, origin) and issues(path) == []
    scene = read_scene(path)
    assert scene.exact_means is not None and (scene.exact_means - origin - before).abs().max() < 1e-6
    stage = Usd.Stage.Open(str(path))
    assert isinstance(stage.GetDefaultPrim().GetAttribute("xformOp:translate").Get(), Gf.Vec3d)
