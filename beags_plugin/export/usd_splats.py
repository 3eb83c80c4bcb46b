"""Gaussians as USD, by the schemas of OpenUSD 26.03 (UsdVol, ParticleField): a prim for each object under one root.

Pixar's library writes it. Scales are lengths and opacities 0..1, as the schemas demand; the coefficients of the bands
are those of splat .ply files. A closed object has its closed mesh beside its splats, as a collider.
"""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.sh import SH_C0
from beags_plugin.core.surfels import opacities
from beags_plugin.export.base import Exporter
from beags_plugin.export.gltf import y_up
from beags_plugin.export.mesh import MOST
from beags_plugin.export.splat_parts import SplatPart, splat_parts, without_invented, y_up_gaussians
from beags_plugin.export.usdz import define_mesh, modules, packed
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.splat_io.ply import thin_log_scales
from beags_plugin.surfaces.closing import Closed
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.item import ExportItem, NothingToExport
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.meshing import closed_mesh, placed_surface
from beags_plugin.system.errors import check_choice

ROOT = "/Scene"
_REACH = 3.0  # standard deviations that the extent covers
_SURFLET_APIS = ("PositionAttribute", "OrientationAttribute", "ScaleAttribute", "OpacityAttribute")
_SURFLET_APIS += ("KernelGaussianSurflet", "SphericalHarmonicsAttribute")


@dataclass(frozen=True)
class UsdSplatsExporter(Exporter):
    """USD of splats, as a package or as text.

    kernel: "ellipsoid", thin 3D Gaussians, or "surflet", discs that are invisible from the side. up_axis: "y" or "z".
    mesh: how the surface of a collider is made. layer: the name of the layer in the file.
    """

    layer: ClassVar[str]
    kernel: str = "ellipsoid"
    up_axis: str = "y"
    mesh: MeshOptions = MeshOptions()

    def __post_init__(self) -> None:
        check_choice(self.kernel, ("ellipsoid", "surflet"), "kernel")
        check_choice(self.up_axis, ("y", "z"), "up axis")

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            import pxr.UsdVol as volumes  # pyright: ignore[reportMissingImports]  (an extra)
        except ImportError as error:
            return f"Pixar's USD library cannot be loaded ({error}); pip install 'usd-core>=26.3'."
        if not hasattr(volumes, "ParticleField3DGaussianSplat"):
            return "Pixar's USD library is older than 26.3 and has no splats; pip install 'usd-core>=26.3'."
        return None

    def _write_layer(self, layer: Path, item: ExportItem) -> dict[str, Any]:
        Usd, UsdGeom = modules("Usd", "UsdGeom")
        parts = splat_parts(item)
        collider, doubt = _collider(item, self.mesh)
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if self.up_axis == "y" else UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
        root.SetDisplayName(item.name)
        stage.SetDefaultPrim(root)
        for part in parts:
            place = _named_child(stage, part.name)
            self._define_splats(stage, f"{place}/Splats", part)
            if collider is not None:
                self._define_collider(stage, f"{place}/Collider", collider)
        stage.GetRootLayer().Save()
        facts: dict[str, Any] = {"prims": len(parts), "kernel": self.kernel}
        if item.close:
            facts["collider"] = doubt or f"{len(collider.mesh.faces) if collider else 0} triangles"
        return facts

    def _define_splats(self, stage: Any, place: str, part: SplatPart) -> None:
        Gf, Sdf, UsdGeom, Vt = modules("Gf", "Sdf", "UsdGeom", "Vt")
        surfels = y_up_gaussians(part.surfels) if self.up_axis == "y" else part.surfels
        scales = _floats(thin_log_scales(surfels.log_scales.detach().double()).exp())
        prim = self._field(stage, place)
        quats = torch.nn.functional.normalize(surfels.quats.double(), dim=1)[:, [1, 2, 3, 0]]  # The real part is last.
        prim.GetAttribute("positions").Set(Vt.Vec3fArray.FromNumpy(_floats(surfels.means)))
        prim.GetAttribute("orientations").Set(Vt.QuatfArray.FromNumpy(_floats(quats)))
        prim.GetAttribute("scales").Set(Vt.Vec3fArray.FromNumpy(scales))
        prim.GetAttribute("opacities").Set(Vt.FloatArray.FromNumpy(_floats(opacities(surfels.opacity_logits.double()))))
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(surfels.sh_degree)
        coefficients = _floats(surfels.sh.reshape(-1, 3))
        prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Set(Vt.Vec3fArray.FromNumpy(coefficients))
        reach = _REACH * scales.max(axis=1, keepdims=True)
        means = _floats(surfels.means)
        ends = ((means - reach).min(axis=0), (means + reach).max(axis=0))
        prim.GetAttribute("extent").Set([Gf.Vec3f(*map(float, end)) for end in ends])
        primvars, kinds = UsdGeom.PrimvarsAPI(prim), Sdf.ValueTypeNames
        primvars.CreatePrimvar("class_id", kinds.Int, UsdGeom.Tokens.constant).Set(part.class_id)
        colors = linear_from_srgb(_floats((surfels.sh_dc * SH_C0 + 0.5).clamp(0.0, 1.0))).astype(np.float32)
        display = primvars.CreatePrimvar("displayColor", kinds.Color3fArray, UsdGeom.Tokens.vertex)
        display.Set(Vt.Vec3fArray.FromNumpy(colors))
        if part.invented is not None:
            marks = Vt.FloatArray.FromNumpy(_floats(part.invented))
            primvars.CreatePrimvar("invented", kinds.FloatArray, UsdGeom.Tokens.vertex).Set(marks)

    def _field(self, stage: Any, place: str) -> Any:
        """Define a prim with the attributes of splats, and return it."""
        if self.kernel == "ellipsoid":
            return stage.DefinePrim(place, "ParticleField3DGaussianSplat")
        prim = stage.DefinePrim(place, "ParticleField")
        for name in _SURFLET_APIS:
            prim.ApplyAPI(f"ParticleField{name}API")
        return prim

    def _define_collider(self, stage: Any, place: str, collider: Closed) -> None:
        """Add an invisible mesh for collisions; physics engines split it into convex parts, so that it may move."""
        UsdGeom, UsdPhysics = modules("UsdGeom", "UsdPhysics")
        mesh = collider.mesh
        vertices = y_up(mesh.vertices) if self.up_axis == "y" else mesh.vertices
        shape = define_mesh(stage, place, vertices, mesh.faces)
        shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        convex = UsdPhysics.MeshCollisionAPI.Apply(shape.GetPrim())
        convex.CreateApproximationAttr(UsdPhysics.Tokens.convexDecomposition)

    def to_world(self, path: Path, origin: Tensor) -> bool:
        Gf, Usd, UsdGeom = modules("Gf", "Usd", "UsdGeom")
        x, y, z = origin.tolist()
        with tempfile.TemporaryDirectory() as folder:
            layer = self._unpacked(path, Path(folder))
            stage = Usd.Stage.Open(str(layer))
            root = UsdGeom.Xform(stage.GetDefaultPrim())
            root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(
                Gf.Vec3d(x, z, -y) if self.up_axis == "y" else Gf.Vec3d(x, y, z)
            )
            stage.GetRootLayer().Save()
            del stage, root
            write_bytes(path, self._content(layer))
        return True

    @abstractmethod
    def _unpacked(self, path: Path, folder: Path) -> Path:
        """Extract the layer of a file that ``write`` made into ``folder``; return its path."""

    @abstractmethod
    def _content(self, layer: Path) -> bytes:
        """Return the content of the file that holds a layer."""

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            layer = Path(folder) / self.layer
            facts = self._write_layer(layer, item)
            write_bytes(path, self._content(layer))
        return facts


@dataclass(frozen=True)
class UsdzSplatsExporter(UsdSplatsExporter):
    """A package: Quick Look and RealityKit since version 27, Isaac Sim 6, Houdini."""

    suffix: ClassVar[str] = "splats.usdz"
    layer: ClassVar[str] = "splats.usdc"

    def _unpacked(self, path: Path, folder: Path) -> Path:
        with zipfile.ZipFile(path) as package:
            return Path(package.extract(self.layer, folder))

    def _content(self, layer: Path) -> bytes:
        return packed(layer)


@dataclass(frozen=True)
class UsdaSplatsExporter(UsdSplatsExporter):
    """Text, to read and to compose."""

    suffix: ClassVar[str] = "splats.usda"
    layer: ClassVar[str] = "splats.usda"

    def _unpacked(self, path: Path, folder: Path) -> Path:
        return Path(shutil.copyfile(path, folder / self.layer))

    def _content(self, layer: Path) -> bytes:
        return layer.read_bytes()


def _collider(item: ExportItem, options: MeshOptions) -> tuple[Closed | None, str]:
    """Return the closed mesh of an item to be closed, with few triangles, or None and the reason why there is none."""
    if not item.close or item.views is None:
        return None, ""
    own = without_invented(item)
    try:
        return closed_mesh(own, placed_surface(own, options)[0], options.smallest_part, MOST), ""
    except NothingToExport as error:
        return None, f"none, as {str(error).partition(':')[0]}"


def _named_child(stage: Any, name: str) -> str:
    """Define an Xform for an object below the root, called ``name`` as far as USD allows; return its path."""
    Tf, UsdGeom = modules("Tf", "UsdGeom")
    plain = Tf.MakeValidIdentifier(name)
    word, number = plain, 1
    while stage.GetPrimAtPath(f"{ROOT}/{word}"):
        number += 1
        word = f"{plain}_{number}"
    UsdGeom.Xform.Define(stage, f"{ROOT}/{word}").GetPrim().SetDisplayName(name)
    return f"{ROOT}/{word}"


def _floats(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().cpu().numpy(), dtype=np.float32)
