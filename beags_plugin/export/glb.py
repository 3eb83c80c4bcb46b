"""A mesh as binary glTF 2.0, with a texture or with colours of its vertices.

No library at hand writes what photographed colours need: unlit, and where vertices have them finer than 8 bits, since
8 bits of glTF's linear vertex colours leave too few dark tones. (glTF 2.0, sections 3.7.2, 3.8, 3.9, 4.4;
KHR_materials_unlit)
"""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beags_plugin.export.color import linear_from_srgb
from beags_plugin.export.fusion import Mesh
from beags_plugin.export.surface import vertex_normals
from beags_plugin.export.texture import Texture

_UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT = 5123, 5125, 5126
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071


def glb_bytes(mesh: Mesh, name: str, texture: Texture | None = None, invented: np.ndarray | None = None) -> bytes:
    """Return the file's content: one node, one mesh with normals, one unlit material.

    Colours are those of the texture, a .png, or without it linear 16-bit ones of the vertices. The mesh has z up and
    the file y, as glTF demands: the places are turned, as some readers ignore nodes' matrices.
    invented: [V] bool; with it vertices have the attribute ``_INVENTED``, 1 where nothing but closing put them.
    """
    parts = _Parts()
    source = np.arange(len(mesh.vertices)) if texture is None else texture.atlas.source
    faces = mesh.faces if texture is None else texture.atlas.faces
    positions = y_up(mesh.vertices)[source].astype("<f4")
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {
        "POSITION": parts.accessor(positions, _FLOAT, "VEC3", **bounds),
        "NORMAL": parts.accessor(y_up(vertex_normals(mesh))[source].astype("<f4"), _FLOAT, "VEC3"),
    }
    material: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    pictures: dict[str, Any] = {}
    if texture is None:
        colors = np.full((len(positions), 4), 65535, dtype="<u2")
        colors[:, :3] = np.round(linear_from_srgb(mesh.colors) * 65535)
        attributes["COLOR_0"] = parts.accessor(colors, _UNSIGNED_SHORT, "VEC4", normalized=True)
    else:
        attributes["TEXCOORD_0"] = parts.accessor(texture.atlas.uv.astype("<f4"), _FLOAT, "VEC2")
        material["baseColorTexture"] = {"index": 0}
        clamp = {"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
        pictures = {
            "textures": [{"sampler": 0, "source": 0}],
            "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, **clamp}],
            "images": [{"bufferView": parts.view(png_bytes(texture.image)), "mimeType": "image/png"}],
        }
    if invented is not None:
        # floats, as every reader takes them; names of an application's own begin with an underscore
        attributes["_INVENTED"] = parts.accessor(invented[source].astype("<f4"), _FLOAT, "SCALAR")
    indices = parts.accessor(faces.astype("<u4").reshape(-1), _UNSIGNED_INT, "SCALAR", target=_ELEMENT_ARRAY_BUFFER)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "beags"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": material, **unlit}],
        **pictures,
        "extensionsUsed": ["KHR_materials_unlit"],
        "accessors": parts.accessors,
        "bufferViews": parts.views,
        "buffers": [{"byteLength": len(parts.content)}],
    }
    return _container(content, bytes(parts.content))


@dataclass
class _Parts:
    """The binary buffer and what describes it, as it grows; every part starts at a multiple of 4 bytes."""

    content: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, data: bytes, **facts: Any) -> int:
        """Append bytes; return the number of their bufferView."""
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(data), **facts})
        self.content += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: int, shape: str, target: int = _ARRAY_BUFFER, **facts: Any) -> int:
        """Append an array; return the number of its accessor."""
        number = self.view(values.tobytes(), target=target)
        self.accessors.append(
            {"bufferView": number, "componentType": kind, "count": len(values), "type": shape, **facts}
        )
        return len(self.accessors) - 1


def y_up(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [V, 3] of a frame with z up in one with y up; z of ours is its y, and y its -z."""
    return vectors[:, [0, 2, 1]] * [1.0, 1.0, -1.0]


def png_bytes(image: np.ndarray) -> bytes:
    """Return a picture [H, W, 3] uint8 as a .png."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG", optimize=True)
    return file.getvalue()


def _container(content: dict[str, Any], binary: bytes) -> bytes:
    """Return the two chunks of a .glb."""
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary]
    )
