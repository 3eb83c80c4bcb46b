"""Importer of USD with the particle fields of OpenUSD 26.03: 3D Gaussians, or surflets, which are discs.

All fields of the stage are read and moved by their transforms, and the scene is turned to z up.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.sh import num_sh_bases
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import Z_UP, cut_bands, gaussians_of, in_world, log_lengths, moved_by, reading
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.stand_ins import stand_in

_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
_SURFLET = "ParticleFieldKernelGaussianSurfletAPI"


class UsdImporter(Importer):
    """A stage with splats; Pixar's library reads it."""

    marks: ClassVar[str] = "a USD of splats"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in _SUFFIXES

    def read(self, path: Path) -> ImportedScene:
        if (cause := stand_in(path)) is not None:
            raise UserError(f"{path} is no USD file ({cause}).")
        try:
            Usd, UsdGeom, Tf = (import_module(f"pxr.{name}") for name in ("Usd", "UsdGeom", "Tf"))
        except ImportError as error:
            raise UserError(f"{path} needs Pixar's USD library ({error}): pip install 'usd-core>=26.3'.") from error
        with reading(path, "USD of splats"):
            try:
                stage = Usd.Stage.Open(str(path))
            except Tf.ErrorException as error:
                raise ValueError(str(error).splitlines()[0]) from None
            parts, highest, flat = [], 0, set()
            for prim in stage.Traverse():
                if prim.GetTypeName() not in ("ParticleField", "ParticleField3DGaussianSplat"):
                    continue
                gaussians, degree = _gaussians(prim)
                matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
                parts.append(moved_by(gaussians, matrix))
                flat.add(_SURFLET in prim.GetAppliedSchemas())
                highest = max(highest, degree)
            if not parts:
                raise ValueError("it has no particle field with places: OpenUSD 26.03 and later write them")
            kind = "USD of surflets" if flat == {True} else "USD of splats"
            turn = Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else None
            scene = in_world(kind, parts, turn, cut_bands(highest))
        if flat != {True}:
            return scene
        return replace(
            scene, gaussians=replace(scene.gaussians, log_scales=scene.gaussians.log_scales[:, :2].contiguous())
        )


def _gaussians(prim: Any) -> tuple[Gaussians, int]:
    """Return the Gaussians of a field in its own frame, and the degree of its bands."""

    def values(name: str, width: int) -> np.ndarray | None:
        for each in (name, f"{name}h"):  # the name with h holds half floats
            attribute = prim.GetAttribute(each)
            if attribute and (content := attribute.Get()) is not None and len(content):
                return np.array(content, np.float64).reshape(-1, width)
        return None

    means = values("positions", 3)
    if means is None:
        raise ValueError(f"{prim.GetPath()} has no positions")
    count = len(means)

    def of_each(name: str, width: int, rows: int, default: list[float]) -> np.ndarray:
        column = values(name, width)
        if column is None or len(column) < rows:  # the schemas define this default
            return np.tile(np.array(default), (rows, 1))
        return column[:rows]

    degree = int(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() or 0)
    bases = num_sh_bases(degree)
    sh = values("radiance:sphericalHarmonicsCoefficients", 3)
    if sh is None or len(sh) < count * bases:
        degree, bases, sh = 0, 1, np.zeros((count, 3))
    sh = sh[: count * bases].reshape(count, bases, 3)
    scales = of_each("scales", 3, count, [1.0, 1.0, 1.0])
    quats = of_each("orientations", 4, count, [0.0, 0.0, 0.0, 1.0])
    alphas = of_each("opacities", 1, count, [1.0])[:, 0]
    if _SURFLET in prim.GetAppliedSchemas():
        scales = scales.copy()
        scales[:, 2] = 0.0
    log_scales = log_lengths(scales)
    return gaussians_of(means, quats[:, [3, 0, 1, 2]], log_scales, alphas, sh[:, 0], sh[:, 1:]), degree
