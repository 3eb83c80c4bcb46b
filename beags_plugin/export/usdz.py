"""A mesh as .usdz, for Apple's devices and programs that read USD; Pixar's library writes it.

The content is that of a .glb: y up, normals, and a texture or colours of the vertices. UsdPreviewSurface has no unlit
material, so the mesh emits the photos' colours.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.export.glb import png_bytes
from beags_plugin.export.gltf import y_up
from beags_plugin.export.mesh import TexturedExporter
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.surfaces.surface import vertex_normals
from beags_plugin.surfaces.texture import Texture

_PICTURE = "colors.png"
_LONG_AGO = 631152000  # 1990, in seconds since 1970; a package cannot hold times before 1980


@dataclass(frozen=True)
class UsdzExporter(TexturedExporter):
    """A package of USD: Quick Look on iPhone, iPad and Mac, and programs that read USD."""

    suffix: ClassVar[str] = "usdz"

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            import pxr.UsdShade  # pyright: ignore[reportMissingImports]  (an extra)
            import pxr.UsdUtils  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            return f"Pixar's USD library cannot be loaded ({error}); pip install usd-core."
        return super().unavailable()

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        made = self.made(item)
        texture, facts = self.texture_of(made.mesh, item)
        write_bytes(path, usdz_bytes(made.mesh, item.name, texture, made.invented))
        return made.facts() | {"texture": facts}


def packed(layer: Path) -> bytes:
    """Return the content of a .usdz that holds a layer and the files beside it that it refers to."""
    Sdf, UsdUtils = modules("Sdf", "UsdUtils")
    package = layer.with_suffix(".usdz")
    for file in layer.parent.iterdir():
        os.utime(file, (_LONG_AGO, _LONG_AGO))  # A package holds times, which would change the bytes.
    if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package)):
        raise RuntimeError("Pixar's USD library packed nothing")
    return package.read_bytes()


def usdz_bytes(mesh: Mesh, name: str, texture: Texture | None = None, invented: np.ndarray | None = None) -> bytes:
    """Return the file's content; the mesh has z up and the file y. Its unit is the metre.

    invented: [V] bool; with it vertices have the primvar ``invented``, 1 where only closing put them.
    """
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / "mesh.usdc"
        if texture is not None:
            (layer.parent / _PICTURE).write_bytes(png_bytes(texture.image))
        _write_layer(layer, mesh, name, texture, invented)
        return packed(layer)


def modules(*names: str) -> list[Any]:
    """Return modules of Pixar's library, which has no types."""
    return [import_module(f"pxr.{name}") for name in names]


def _write_layer(path: Path, mesh: Mesh, name: str, texture: Texture | None, invented: np.ndarray | None) -> None:
    Sdf, Usd, UsdGeom, Vt = modules("Sdf", "Usd", "UsdGeom", "Vt")
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/Object")
    root.GetPrim().SetDisplayName(name)
    stage.SetDefaultPrim(root.GetPrim())
    source = np.arange(len(mesh.vertices)) if texture is None else texture.atlas.source
    faces = mesh.faces if texture is None else texture.atlas.faces
    shape = define_mesh(stage, "/Object/Mesh", y_up(mesh.vertices)[source], faces)
    shape.CreateDoubleSidedAttr(True)
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(y_up(vertex_normals(mesh))[source].astype(np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars, of_vertex = UsdGeom.PrimvarsAPI(shape), UsdGeom.Tokens.vertex
    if texture is None:
        colors = linear_from_srgb(mesh.colors).astype(np.float32)
        primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, of_vertex).Set(
            Vt.Vec3fArray.FromNumpy(colors)
        )
    else:
        uv = (texture.atlas.uv * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32)  # USD counts v from the bottom.
        primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, of_vertex).Set(Vt.Vec2fArray.FromNumpy(uv))
    if invented is not None:
        marks = Vt.FloatArray.FromNumpy(invented[source].astype(np.float32))
        primvars.CreatePrimvar("invented", Sdf.ValueTypeNames.FloatArray, of_vertex).Set(marks)
    _bind_material(stage, shape, texture is not None)
    stage.GetRootLayer().Save()


def define_mesh(stage: Any, path: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Define a mesh in a stage, of vertices [V, 3] in its frame and triangles [F, 3], and return it."""
    Gf, UsdGeom, Vt = modules("Gf", "UsdGeom", "Vt")
    shape, places = UsdGeom.Mesh.Define(stage, path), vertices.astype(np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(places))
    shape.CreateExtentAttr([Gf.Vec3f(*map(float, bound)) for bound in (places.min(axis=0), places.max(axis=0))])
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return shape


def _bind_material(stage: Any, shape: Any, textured: bool) -> None:
    """Bind a material to a mesh that emits its texture, or without one the colours of its vertices."""
    Gf, Sdf, UsdShade = modules("Gf", "Sdf", "UsdShade")
    kinds = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/Object/Material")

    def shader(name: str, of: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"/Object/Material/{name}")
        made.CreateIdAttr(of)
        return made

    surface = shader("Surface", "UsdPreviewSurface")
    surface.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(0.0))
    surface.CreateInput("useSpecularWorkflow", kinds.Int).Set(1)  # Otherwise the mesh would shine at its rims.
    surface.CreateInput("specularColor", kinds.Color3f).Set(Gf.Vec3f(0.0))
    surface.CreateInput("roughness", kinds.Float).Set(1.0)
    if textured:
        reader = shader("Places", "UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set("st")
        colors = shader("Colors", "UsdUVTexture")
        colors.CreateInput("file", kinds.Asset).Set(_PICTURE)
        colors.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
        for side in ("wrapS", "wrapT"):
            colors.CreateInput(side, kinds.Token).Set("clamp")
        places = reader.CreateOutput("result", kinds.Float2)
        colors.CreateInput("st", kinds.Float2).ConnectToSource(places)
        emitted = colors.CreateOutput("rgb", kinds.Float3)
    else:
        reader = shader("Colors", "UsdPrimvarReader_float3")
        reader.CreateInput("varname", kinds.String).Set("displayColor")
        emitted = reader.CreateOutput("result", kinds.Float3)
    surface.CreateInput("emissiveColor", kinds.Color3f).ConnectToSource(emitted)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
