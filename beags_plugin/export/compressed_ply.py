"""Gaussians as a compressed .ply: 16 bytes each, and one more for each coefficient of the higher bands.

Written from descriptions of PlayCanvas' format. A binary little-endian .ply of three elements: "chunk" holds the
smallest and largest values of 256 Gaussians each; "vertex" their positions between these, packed into four 32-bit
words; "sh", which files of degree 0 lack, a byte per coefficient, channel-major as in other splat .ply files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.core.sh import SH_C0
from beags_plugin.export.base import Exporter
from beags_plugin.export.splat_values import SplatValues, smallest_three, splat_values
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.splat_io.ply import DISC_COMMENT
from beags_plugin.surfaces.item import ExportItem

CHUNK = 256  # Gaussians
_SH_RANGE = 8.0  # coefficients of the higher bands lie in -4..4


@dataclass(frozen=True)
class CompressedPlyExporter(Exporter):
    """PlayCanvas' compressed .ply: SuperSplat, the PlayCanvas engine, three.js' viewers. It cannot hold class ids."""

    suffix: ClassVar[str] = "compressed.ply"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        write_bytes(path, compressed_ply(splat_values(item.surfels, item.name)))
        return {}


def compressed_ply(values: SplatValues) -> bytes:
    """Return the content of the file."""
    count = len(values)
    starts = np.arange(0, count, CHUNK)
    of = np.arange(count) // CHUNK
    columns, words = [], {}
    colors = values.sh_dc * SH_C0 + 0.5
    for name, block in (("position", values.means), ("scale", values.log_scales), ("color", colors)):
        # Rounding to the file's float32 comes first, so that packed values lie between the bounds that readers get.
        low, high = (ends.reduceat(block, starts).astype("<f4") for ends in (np.minimum, np.maximum))
        extent = high.astype(np.float64) - low
        places = (block - low[of]) / np.where(extent > 0, extent, 1.0)[of]
        columns += [low, high]
        words[name] = _packed(places, (11, 10, 11)) if name != "color" else _packed(places, (8, 8, 8)) << np.uint32(8)
    words["color"] |= np.rint(255.0 * values.opacities).clip(1, 254).astype(np.uint32)  # 0 and 255: infinite logits
    largest, others = smallest_three(values.quats)
    words["rotation"] = largest.astype(np.uint32) << np.uint32(30) | _packed(others / 2 + 0.5, (10, 10, 10))
    vertices = np.stack([words[name] for name in ("position", "rotation", "scale", "color")], axis=1)
    rest = values.sh_rest.transpose(0, 2, 1).reshape(count, -1)
    # A byte stands for the middle of its 256th of the range.
    steps = np.floor(256.0 * (rest / _SH_RANGE + 0.5)).clip(0, 255).astype(np.uint8)
    header = _header(len(starts), count, rest.shape[1])
    return b"".join(
        [header, np.concatenate(columns, axis=1).tobytes(), vertices.astype("<u4").tobytes(), steps.tobytes()]
    )


def _packed(places: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
    """Return [N] uint32: the numbers of [N, 3] in 0..1 with ``bits`` each, the first in the highest bits."""
    word = np.zeros(len(places), np.uint32)
    for axis, width in enumerate(bits):
        most = 2**width - 1
        word = word << np.uint32(width) | np.rint(places[:, axis] * most).clip(0, most).astype(np.uint32)
    return word


def _header(chunks: int, count: int, coefficients: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment beags", f"comment {DISC_COMMENT}"]
    lines.append(f"element chunk {chunks}")
    for of, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb")):
        lines += [f"property float {end}_{of}{axis}" for end in ("min", "max") for axis in axes]
    lines.append(f"element vertex {count}")
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if coefficients:
        lines.append(f"element sh {count}")
        lines += [f"property uchar f_rest_{index}" for index in range(coefficients)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()
