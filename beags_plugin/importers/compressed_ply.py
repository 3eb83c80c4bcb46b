"""Importer of PlayCanvas' compressed .ply (documentation of the PlayCanvas engine).

Its elements are "chunk", the least and greatest values of 256 Gaussians each; "vertex", values relative to these,
packed into four 32-bit words; and "sh", one byte for each coefficient of the higher bands. Older files have no ranges
of colours.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from beags_plugin.core.sh import SH_C0
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import cut_bands, gaussians_of, reading, sh_degree, with_largest
from beags_plugin.splat_io.ply import DISC_COMMENT
from beags_plugin.system.reading.ply import read_element

_CHUNK = 256
_SH_RANGE = 8.0
_HEADER_BYTES = 1 << 14


def is_compressed(path: Path) -> bool:
    """Return whether a file is a .ply whose header has the packed columns."""
    if not (path.is_file() and path.suffix.lower() == ".ply"):
        return False
    return b"packed_position" in _header(path)


def _header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEADER_BYTES).partition(b"end_header")[0]


class CompressedPlyImporter(Importer):
    """Compressed .ply files, in the world of the input poses like other .ply files."""

    marks: ClassVar[str] = "a compressed .ply"

    def recognises(self, path: Path) -> bool:
        return is_compressed(path)

    def read(self, path: Path) -> ImportedScene:
        with reading(path, "compressed .ply"):
            chunk, vertex, sh = (read_element(path, name) for name in ("chunk", "vertex", "sh"))
            if chunk is None or vertex is None or len(chunk) * _CHUNK < len(vertex):
                raise ValueError("it lacks ranges for its Gaussians")
            of = np.arange(len(vertex)) // _CHUNK
            color = _parts(vertex["packed_color"], (8, 8, 8, 8))
            rgb = color[:, :3]
            if "min_r" in (chunk.dtype.names or ()):
                rgb = _between(chunk, of, rgb, ("r", "g", "b"))
            three = (_parts(vertex["packed_rotation"], (10, 10, 10)) - 0.5) * math.sqrt(2)
            rest = np.zeros((len(vertex), 0, 3))
            if sh is not None:
                names = [f"f_rest_{index}" for index in range(len(sh.dtype.names or ()))]
                if len(sh) != len(vertex) or len(names) not in (9, 24, 45, 72):
                    raise ValueError(f"it has {len(sh)} rows of {len(names)} colour bands for {len(vertex)} Gaussians")
                steps = np.stack([sh[name] for name in names], axis=1).astype(np.float64)
                steps = steps.reshape(len(vertex), 3, -1).transpose(0, 2, 1)
                rest = _SH_RANGE * ((steps + 0.5) / 256.0 - 0.5)
            gaussians = gaussians_of(
                _between(chunk, of, _parts(vertex["packed_position"], (11, 10, 11)), ("x", "y", "z")),
                with_largest(three, (vertex["packed_rotation"] >> 30).astype(np.int64)),
                _between(
                    chunk, of, _parts(vertex["packed_scale"], (11, 10, 11)), ("scale_x", "scale_y", "scale_z")
                ),
                color[:, 3],
                (rgb - 0.5) / SH_C0,
                rest,
            )  # fmt: skip
        if DISC_COMMENT.encode() in _header(path):
            gaussians = replace(gaussians, log_scales=gaussians.log_scales[:, :2].contiguous())
        lost = "It is compressed: places, scales and rotations have 10 or 11 bits, colours and opacities 8."
        return ImportedScene("compressed .ply", gaussians, remarks=(lost, *cut_bands(sh_degree(rest.shape[1]))))


def _parts(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the values 0..1 [N, parts] packed into words [N]; bits: widths of the parts, from the highest."""
    shift, parts = sum(bits), []
    for width in bits:
        shift -= width
        parts.append((words.astype(np.int64) >> shift & 2**width - 1) / (2**width - 1))
    return np.stack(parts, axis=1)


def _between(chunk: np.ndarray, of: np.ndarray, places: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return values [N, 3] at ``places`` in 0..1 between the ends of the Gaussians' chunks ``of`` [N]."""
    low, high = (
        np.stack([chunk[f"{end}_{name}"].astype(np.float64) for name in names], axis=1)[of] for end in ("min", "max")
    )
    return low + places * (high - low)
