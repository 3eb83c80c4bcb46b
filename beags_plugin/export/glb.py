"""A mesh as binary glTF 2.0, with a texture or with colours of its vertices.

Photographed colours need an unlit material, and vertex colours of 16 bits, because 8 bits of glTF's linear colours
leave too few dark tones; no library at hand writes both. (glTF 2.0, sections 3.7.2, 3.8, 3.9; KHR_materials_unlit)
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from beags_plugin.export.gltf import (
    ELEMENT_ARRAY_BUFFER,
    FLOAT,
    UNSIGNED_INT,
    UNSIGNED_SHORT,
    Document,
    positions,
    y_up,
)
from beags_plugin.surfaces.color import linear_from_srgb
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.surface import vertex_normals
from beags_plugin.surfaces.texture import Texture

_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071


def glb_bytes(mesh: Mesh, name: str, texture: Texture | None = None, invented: np.ndarray | None = None) -> bytes:
    """Return the content of a .glb with one mesh: see ``add_mesh``."""
    document = Document()
    document.roots.append(add_mesh(document, mesh, name, texture, invented))
    return document.to_bytes()


def add_mesh(
    document: Document, mesh: Mesh, name: str, texture: Texture | None = None, invented: np.ndarray | None = None
) -> int:
    """Append a node, its mesh with normals, and an unlit material; return the index of the node.

    Colours are those of the texture, a .png, or without it linear 16-bit colours of the vertices. The mesh has z up and
    the file y, as glTF demands; the positions themselves are turned, because some readers ignore nodes' matrices.
    invented: [V] bool; with it vertices have the attribute ``_INVENTED``, 1 where only closing put them.
    """
    source = np.arange(len(mesh.vertices)) if texture is None else texture.atlas.source
    faces = mesh.faces if texture is None else texture.atlas.faces
    attributes = {
        "POSITION": positions(y_up(mesh.vertices)[source], document),
        "NORMAL": document.accessor(y_up(vertex_normals(mesh))[source].astype("<f4"), FLOAT, "VEC3"),
    }
    material: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if texture is None:
        colors = np.full((len(source), 4), 65535, dtype="<u2")
        colors[:, :3] = np.round(linear_from_srgb(mesh.colors) * 65535)
        attributes["COLOR_0"] = document.accessor(colors, UNSIGNED_SHORT, "VEC4", normalized=True)
    else:
        attributes["TEXCOORD_0"] = document.accessor(texture.atlas.uv.astype("<f4"), FLOAT, "VEC2")
        clamp = {"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
        sampler = document.add("samplers", magFilter=_LINEAR, minFilter=_LINEAR_MIPMAP_LINEAR, **clamp)
        image = document.add("images", bufferView=document.view(png_bytes(texture.image)), mimeType="image/png")
        material["baseColorTexture"] = {"index": document.add("textures", sampler=sampler, source=image)}
    if invented is not None:
        # Every reader accepts floats; names of an application's own attributes begin with an underscore.
        attributes["_INVENTED"] = document.accessor(invented[source].astype("<f4"), FLOAT, "SCALAR")
    indices = document.accessor(faces.astype("<u4").reshape(-1), UNSIGNED_INT, "SCALAR", target=ELEMENT_ARRAY_BUFFER)
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    document.extensions.add("KHR_materials_unlit")
    number = document.add("materials", pbrMetallicRoughness=material, **unlit)
    primitive = {"attributes": attributes, "indices": indices, "material": number}
    return document.add("nodes", mesh=document.add("meshes", name=name, primitives=[primitive]), name=name)


def png_bytes(image: np.ndarray) -> bytes:
    """Return an image [H, W, 3] uint8 as a .png.

    Pillow's ``optimize`` would take five times as long for a file 3 % smaller.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG")
    return file.getvalue()
