"""A vertex-coloured mesh as binary glTF 2.0.

No library at hand writes what photographed colours need: unlit, and finer than 8 bits, since 8 bits of glTF's linear
vertex colours leave too few dark tones. (glTF 2.0, sections 3.7.2, 4.4; KHR_materials_unlit)
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from beags_plugin.export.fusion import Mesh

_UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT = 5123, 5125, 5126
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def glb_bytes(mesh: Mesh, name: str) -> bytes:
    """Return the file's content: one node, one mesh, one unlit material; float32 places, linear 16-bit colours.

    The mesh has z up and the file y, as glTF demands: the places are turned, as some readers ignore nodes' matrices.
    """
    positions = (mesh.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]).astype("<f4")
    colors = np.full((len(positions), 4), 65535, dtype="<u2")
    colors[:, :3] = np.round(linear_from_srgb(mesh.colors) * 65535)
    indices = mesh.faces.astype("<u4").reshape(-1)
    parts = (positions.tobytes(), colors.tobytes(), indices.tobytes())  # each a multiple of 4 bytes long
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    targets = (_ARRAY_BUFFER, _ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER)
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "beags"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [
            {
                "name": name,
                "primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}],
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
        "accessors": [
            {
                "bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3",
                "min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist(),
            },
            {
                "bufferView": 1, "componentType": _UNSIGNED_SHORT, "normalized": True, "count": len(colors),
                "type": "VEC4",
            },
            {"bufferView": 2, "componentType": _UNSIGNED_INT, "count": len(indices), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
            for start, part, target in zip(starts, parts, targets, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + starts[-1]
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", starts[-1], b"BIN\0"),
            *parts,
        ]
    )


def linear_from_srgb(colors: np.ndarray) -> np.ndarray:
    """Return light intensities 0..1 of sRGB values 0..1 (IEC 61966-2-1)."""
    colors = np.clip(np.asarray(colors, dtype=np.float64), 0.0, 1.0)
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
