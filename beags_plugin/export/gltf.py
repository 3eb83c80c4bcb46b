"""Build binary glTF 2.0: nodes, meshes, materials and one buffer (sections 3.6 and 4.4 of its specification)."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from beags_plugin.splat_io.files import write_bytes

UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5121, 5123, 5125, 5126
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
_LISTS = ("nodes", "meshes", "materials", "textures", "samplers", "images", "accessors", "bufferViews")


@dataclass
class Document:
    """A scene and the data it refers to; every part of the buffer starts at a multiple of 4 bytes.

    lists: glTF's arrays by name. roots: indices of the top nodes. extensions: names of the extensions in use.
    """

    binary: bytearray = field(default_factory=bytearray)
    lists: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {name: [] for name in _LISTS})
    roots: list[int] = field(default_factory=list)
    extensions: set[str] = field(default_factory=set)

    def add(self, kind: str, **facts: Any) -> int:
        """Append an entry to one of the arrays; return its index."""
        self.lists[kind].append(facts)
        return len(self.lists[kind]) - 1

    def view(self, data: bytes, **facts: Any) -> int:
        """Append bytes; return the index of their bufferView."""
        number = self.add("bufferViews", buffer=0, byteOffset=len(self.binary), byteLength=len(data), **facts)
        self.binary += data + b"\0" * (-len(data) % 4)
        return number

    def accessor(self, values: np.ndarray, kind: int, shape: str, target: int = ARRAY_BUFFER, **facts: Any) -> int:
        """Append an array; return the index of its accessor."""
        number = self.view(values.tobytes(), target=target)
        return self.add("accessors", bufferView=number, componentType=kind, count=len(values), type=shape, **facts)

    def to_bytes(self) -> bytes:
        """Return the content of a .glb: a header and two chunks."""
        content: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "beags"},
            "scene": 0,
            "scenes": [{"nodes": self.roots}],
            **{name: entries for name, entries in self.lists.items() if entries},
            **({"extensionsUsed": sorted(self.extensions)} if self.extensions else {}),
            "buffers": [{"byteLength": len(self.binary)}],
        }
        return _glb(content, bytes(self.binary))


def shifted(content: bytes, offset: Sequence[float]) -> bytes:
    """Return a .glb of ``Document`` with its top nodes, which had no translation, at ``offset``: JSON holds doubles."""
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    for number in document["scenes"][0]["nodes"]:
        document["nodes"][number]["translation"] = list(offset)
    return _glb(document, content[20 + length + 8 :])


def _glb(document: dict[str, Any], binary: bytes) -> bytes:
    """Return a header and two chunks."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary]
    )


def positions(places: np.ndarray, document: Document) -> int:
    """Append positions [V, 3] with their bounds, which glTF demands; return the index of their accessor."""
    places = places.astype("<f4")
    bounds = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    return document.accessor(places, FLOAT, "VEC3", **bounds)


def y_up(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [V, 3] of a frame with z up in one with y up: z becomes y, and y becomes -z."""
    return vectors[:, [0, 2, 1]] * [1.0, 1.0, -1.0]


def glb_to_world(path: Path, origin: Tensor) -> bool:
    """Move the nodes of a .glb that was made relative to ``origin`` [3] float64, z up, to the world; return True."""
    write_bytes(path, shifted(path.read_bytes(), y_up(origin.numpy()[None])[0].tolist()))
    return True
