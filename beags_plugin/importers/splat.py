"""Importer of .splat files of antimatter15's viewer, with 32 bytes for each Gaussian.

These are three floats of position, three of scales (lengths), red, green, blue and opacity as bytes, and a quaternion
wxyz as bytes, (b - 128) / 128.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from beags_plugin.core.sh import SH_C0
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import gaussians_of, log_lengths, reading
from beags_plugin.system.reading.stand_ins import stand_in, starts_as

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


class SplatImporter(Importer):
    """A .splat, in the world of the input poses; its Gaussians have one colour from all sides."""

    marks: ClassVar[str] = "a .splat"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() == ".splat"

    def read(self, path: Path) -> ImportedScene:
        with reading(path, ".splat"):
            content = path.read_bytes()
            if (cause := stand_in(path) or starts_as(path)) is not None:  # the format has no mark of its own
                raise ValueError(cause)
            if len(content) % _ROW.itemsize:
                raise ValueError(f"it has {len(content)} bytes, which are no whole rows of {_ROW.itemsize}")
            rows = np.frombuffer(content, _ROW)
            color = rows["color"] / 255.0
            gaussians = gaussians_of(
                rows["mean"],
                (rows["quat"].astype(np.float64) - 128.0) / 128.0,
                log_lengths(rows["scale"]),
                color[:, 3],
                (color[:, :3] - 0.5) / SH_C0,
                np.zeros((len(rows), 0, 3)),
            )
        lost = "Its colours, opacities and rotations are bytes, and each Gaussian has one colour from all sides."
        return ImportedScene(".splat", gaussians, remarks=(lost,))
