"""Gaussians as binary glTF with KHR_gaussian_splatting, ratified in 2026: a node for each object, with its name.

In the extension, scales are lengths, opacities 0..1, rotations quaternions xyzw; the coefficients of the bands are
those of splat .ply files, sign for sign. A viewer without the extension shows points in ``COLOR_0``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.sh import SH_C0
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import Exporter
from beags_plugin.export.glb import add_mesh
from beags_plugin.export.gltf import FLOAT, UNSIGNED_BYTE, Document, glb_to_world, positions
from beags_plugin.export.mesh import TexturedExporter
from beags_plugin.export.splat_parts import SplatPart, splat_parts, without_invented, y_up_gaussians
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.splat_io.ply import thin_log_scales
from beags_plugin.surfaces.item import ExportItem

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0
_FACTS = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}  # projection and sorting are the defaults


@dataclass(frozen=True)
class GltfSplatsExporter(Exporter):
    """Splats as .glb: three.js, CesiumJS, and other programs that support KHR_gaussian_splatting."""

    suffix: ClassVar[str] = "splats.glb"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        document = Document()
        document.roots += [add_splats(document, part) for part in splat_parts(item)]
        write_bytes(path, document.to_bytes())
        return {"nodes": len(document.roots)}

    def to_world(self, path: Path, origin: Tensor) -> bool:
        return glb_to_world(path, origin)


@dataclass(frozen=True)
class GltfBothExporter(TexturedExporter):
    """An object's splats and its mesh in one .glb: a node with its name, and below it one for each."""

    suffix: ClassVar[str] = "both.glb"
    holds_gaussians: ClassVar[bool] = True

    def without_mesh(self) -> Exporter:
        return _WithoutMesh()

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        own = without_invented(item)
        made = self.made(own)
        texture, facts = self.texture_of(made.mesh, own)
        document = Document()
        children = _splats(document, item)
        children.append(add_mesh(document, made.mesh, f"{item.name} mesh", texture, made.invented))
        document.roots.append(document.add("nodes", name=item.name, children=children))
        write_bytes(path, document.to_bytes())
        return made.facts() | {"texture": facts}

    def to_world(self, path: Path, origin: Tensor) -> bool:
        return glb_to_world(path, origin)


@dataclass(frozen=True)
class _WithoutMesh(GltfSplatsExporter):
    """The file of ``GltfBothExporter`` with the splats alone, at the same places in the tree."""

    suffix: ClassVar[str] = GltfBothExporter.suffix

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        document = Document()
        document.roots.append(document.add("nodes", name=item.name, children=_splats(document, item)))
        write_bytes(path, document.to_bytes())
        return {}


def _splats(document: Document, item: ExportItem) -> list[int]:
    """Append a node for each part of an item; return their indices."""
    return [add_splats(document, part, f"{part.name} splats") for part in splat_parts(item)]


def add_splats(document: Document, part: SplatPart, name: str = "") -> int:
    """Append a node with the Gaussians of an object, called ``name`` or as the object is; return its index.

    They have z up and the file y: positions, rotations and colours are turned.
    """
    turned = y_up_gaussians(part.surfels)
    floats = {
        "ROTATION": (torch.nn.functional.normalize(turned.quats.double(), dim=1)[:, [1, 2, 3, 0]], "VEC4"),
        "SCALE": (thin_log_scales(turned.log_scales.detach().double()).exp(), "VEC3"),
        "OPACITY": (opacities(turned.opacity_logits.double()), "SCALAR"),
        "SH_DEGREE_0_COEF_0": (turned.sh_dc, "VEC3"),
    }
    for degree in range(1, turned.sh_degree + 1):
        for index in range(2 * degree + 1):
            band = turned.sh_rest[:, degree**2 - 1 + index]
            floats[f"SH_DEGREE_{degree}_COEF_{index}"] = band, "VEC3"
    attributes = {"POSITION": positions(turned.means.cpu().numpy(), document)}
    attributes["COLOR_0"] = document.accessor(_points_colors(turned), UNSIGNED_BYTE, "VEC4", normalized=True)
    for key, (values, shape) in floats.items():
        attributes[f"{EXTENSION}:{key}"] = document.accessor(values.cpu().numpy().astype("<f4"), FLOAT, shape)
    if part.invented is not None:
        attributes["_INVENTED"] = document.accessor(part.invented.cpu().numpy().astype("<f4"), FLOAT, "SCALAR")
    document.extensions.add(EXTENSION)
    name = name or part.name
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _FACTS}}
    mesh = document.add("meshes", name=name, primitives=[primitive])
    return document.add("nodes", mesh=mesh, name=name, extras={"class_id": part.class_id})


def _points_colors(surfels: Surfels) -> np.ndarray:
    """Return [N, 4] uint8, red, green, blue and opacity, for viewers that draw points."""
    rgb = surfels.sh_dc.double() * SH_C0 + 0.5
    rgba = torch.cat([rgb, opacities(surfels.opacity_logits.double())[:, None]], dim=1)
    return (255.0 * rgba.clamp(0.0, 1.0)).round().to(torch.uint8).cpu().numpy()
