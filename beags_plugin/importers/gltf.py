"""Importer of glTF 2.0 with KHR_gaussian_splatting, as .glb or .gltf.

All primitives of Gaussians in the scene are read and moved by their nodes. glTF has y up: scenes are turned to z up,
and files of PlayCanvas' splat-transform back to the axes of the .ply files that it read.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote

import numpy as np
import torch

from beags_plugin.core.flattening import Gaussians
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import Z_UP, gaussians_of, in_world, log_lengths, moved_by, reading

EXTENSION = "KHR_gaussian_splatting"
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_DEEPEST = 64  # levels of nodes
_HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))


class GltfImporter(Importer):
    """A .glb or .gltf whose primitives are Gaussians."""

    marks: ClassVar[str] = "a .glb of splats"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in (".glb", ".gltf")

    def read(self, path: Path) -> ImportedScene:
        with reading(path, ".glb of splats"):
            document = _Document.of(path)
            parts, remarks = [], []
            for primitive, matrix in document.placed():
                gaussians, logs = document.gaussians(primitive)
                parts.append(moved_by(gaussians, matrix))
                if logs:
                    remarks.append("Its scales are negative: logs, as a draft of the extension had them, are taken.")
            if not parts:
                raise ValueError(f"no primitive of its scene has the extension {EXTENSION}")
            back = _HALF_TURN if "splat-transform" in document.generator.lower() else Z_UP
            return in_world("glTF of splats", parts, back, tuple(dict.fromkeys(remarks)))


class _Document:
    """The JSON of a glTF and its buffers; methods raise ``ValueError`` and similar errors for damaged files."""

    def __init__(self, content: dict[str, Any], binary: bytes, folder: Path) -> None:
        self._content, self._binary, self._folder = content, binary, folder
        self.generator = str(content.get("asset", {}).get("generator", ""))

    @classmethod
    def of(cls, path: Path) -> _Document:
        data = path.read_bytes()
        if path.suffix.lower() == ".gltf":
            return cls(json.loads(data.decode("utf-8")), b"", path.parent)
        magic, version, _ = struct.unpack_from("<4sII", data)
        if (magic, version) != (b"glTF", 2):
            raise ValueError("it does not start as a .glb of version 2")
        chunks, at = {}, 12
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<I4s", data, at)
            if at + 8 + length > len(data):
                raise ValueError("it ends within a chunk")
            chunks.setdefault(kind, data[at + 8 : at + 8 + length])
            at += 8 + length
        return cls(json.loads(chunks[b"JSON"].decode("utf-8")), chunks.get(b"BIN\0", b""), path.parent)

    def placed(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """Yield the scene's primitives of Gaussians, each with its matrix [4, 4] to the scene."""
        nodes, scenes = self._content.get("nodes", []), self._content.get("scenes", [])
        below = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in below]
        chosen = scenes[self._content.get("scene", 0)]["nodes"] if scenes else roots
        seen: set[int] = set()
        waiting = [(number, np.eye(4), 0) for number in reversed(list(chosen))]
        while waiting:
            number, above, depth = waiting.pop()
            if number in seen:
                raise ValueError(f"its node {number} is below two others, or below itself")
            seen.add(number)
            node = nodes[number]
            matrix = above @ _matrix(node)
            if depth > _DEEPEST:
                raise ValueError("its nodes are nested too deeply")
            waiting += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                for primitive in self._content["meshes"][node["mesh"]]["primitives"]:
                    if EXTENSION in primitive.get("extensions", {}):
                        yield primitive, matrix

    def gaussians(self, primitive: dict[str, Any]) -> tuple[Gaussians, bool]:
        """Return the Gaussians of a primitive, in its frame, and whether its scales are logs."""
        packed = primitive["extensions"][EXTENSION].get("extensions", {})
        if packed:
            raise ValueError(f"it is packed by {', '.join(packed)}: save it without")
        attributes = primitive["attributes"]

        def values(name: str) -> np.ndarray:
            return self._accessor(attributes[name if name == "POSITION" else f"{EXTENSION}:{name}"])

        bands: list[np.ndarray] = []
        for degree in range(1, 4):
            if f"{EXTENSION}:SH_DEGREE_{degree}_COEF_0" not in attributes:
                break
            bands += [values(f"SH_DEGREE_{degree}_COEF_{index}") for index in range(2 * degree + 1)]
        means, scales = values("POSITION"), values("SCALE")
        logs = bool((scales < 0).any())
        log_scales = scales if logs else log_lengths(scales)
        rest = np.stack(bands, axis=1) if bands else np.zeros((len(means), 0, 3))
        quats, dc = values("ROTATION")[:, [3, 0, 1, 2]], values("SH_DEGREE_0_COEF_0")
        return gaussians_of(means, quats, log_scales, values("OPACITY")[:, 0], dc, rest), logs

    def _accessor(self, number: int) -> np.ndarray:
        """Return the values of an accessor, [N, width] float64."""
        accessor = self._content["accessors"][number]
        if "sparse" in accessor:
            raise ValueError("it has sparse accessors, which are not read")
        dtype, count = np.dtype(_COMPONENTS[accessor["componentType"]]), accessor["count"]
        width = _WIDTHS[accessor["type"]]
        view = self._content["bufferViews"][accessor["bufferView"]]
        content = self._buffer(view["buffer"])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", dtype.itemsize * width)
        size = dtype.itemsize * width
        if count < 1 or start < 0 or stride < size or start + stride * (count - 1) + size > len(content):
            raise ValueError(f"accessor {number} does not fit into its buffer")
        values = np.ndarray((count, width), dtype, content, start, (stride, dtype.itemsize)).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _buffer(self, number: int) -> bytes:
        uri = self._content["buffers"][number].get("uri")
        if uri is None:
            return self._binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        name = unquote(uri)
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ValueError(f"it names the file {name!r}")
        return (self._folder / name).read_bytes()


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] from a node to its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", [0.0, 0.0, 0.0, 1.0])
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(rows) * np.array(node.get("scale", [1.0] * 3), np.float64)
    matrix[:3, 3] = node.get("translation", [0.0] * 3)
    return matrix
