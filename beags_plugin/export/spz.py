"""Gaussians as .spz, version 2: several times smaller than a .ply.

Written from the format's public description (nianticlabs/spz, README): gzip of a header of 16 bytes, then, each for all
Gaussians: positions (24-bit fixed point), alphas, colours, scales, rotations and spherical harmonics (8 bits each).
"""

from __future__ import annotations

import gzip
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import Exporter, ExportItem
from beags_plugin.export.splat_values import finite_surfels
from beags_plugin.extraction.files import whole_file
from beags_plugin.extraction.frames import to_input_frame
from beags_plugin.extraction.ply import THICKNESS
from beags_plugin.system.errors import UserError

MAGIC = 0x5053474E
VERSION = 2
_MOST = 2**23 - 1  # a signed 24-bit number
_COLOR_SCALE = 0.15  # the format's: bytes hold 0.5 + 0.15 dc, so that colours a little out of range survive


@dataclass(frozen=True)
class SpzExporter(Exporter):
    """Niantic's .spz: Scaniverse, SuperSplat, Babylon.js. It has no place for class ids.

    Like the tools that make .spz of .ply, it turns the axes of splat .ply files (y down, z forward) to the format's own
    (y up, z backward), half a turn about x; readers turn them back.

    first_band_bits, other_bands_bits: of the SH degrees; fewer compress better.
    """

    suffix: ClassVar[str] = "spz"
    first_band_bits: int = 5
    other_bands_bits: int = 4

    def __post_init__(self) -> None:
        for name in ("first_band_bits", "other_bands_bits"):
            if not 1 <= getattr(self, name) <= 8:
                raise UserError(f"{name} is {getattr(self, name)}: it must lie in 1..8.")

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        content, facts = self._content(item.surfels)
        with whole_file(path) as part:
            part.write_bytes(gzip.compress(content, mtime=0))  # the same bytes at any time
        return facts

    def _content(self, surfels: Surfels) -> tuple[bytes, dict[str, Any]]:
        half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 0.0], dtype=torch.float64))[:3]
        # Of a disc's own axes two are turned too, which leaves it as it is: so do those tools, and the .ply comes back.
        quats = surfels.quats.detach() * surfels.quats.new_tensor([1.0, 1.0, -1.0, -1.0])
        turned = replace(to_input_frame(surfels, half_turn, 1.0), quats=quats)
        turned = finite_surfels(turned)
        means = turned.means.double().cpu().numpy()
        bits = fractional_bits(float(np.abs(means).max(initial=0.0)))
        fixed = np.round(means * 2.0**bits).astype("<i4")
        log_scales = turned.log_scales.double()
        thin = log_scales.amin(dim=1, keepdim=True) + math.log(THICKNESS)
        degree = turned.sh_degree
        parts = (
            struct.pack("<IIIBBBB", MAGIC, VERSION, len(turned), degree, bits, 0, 0),
            np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
            # 0 and 255 would be read as infinite logits; renderers skip what 1 shows, and cap alphas at 0.99
            _bytes(255.0 * opacities(turned.opacity_logits.double()), 1, 254),
            _bytes(255.0 * (0.5 + _COLOR_SCALE * turned.sh_dc.double())),
            _bytes(16.0 * (torch.cat([log_scales, thin], dim=1) + 10.0)),
            _rotation_bytes(turned.quats.double()),
            self._sh_bytes(turned.sh_rest.double()),
        )
        return b"".join(parts), {"version": VERSION, "fractional_bits": bits, "sh_degree": degree}

    def _sh_bytes(self, rest: torch.Tensor) -> bytes:
        """Encode coefficients -1..1 as 0..255 with 0 at 128, rounded to the bits wanted; colour is the inner axis."""
        bits = torch.full((rest.shape[1], 1), float(self.other_bands_bits), dtype=rest.dtype)
        bits[:3] = self.first_band_bits
        step = 2.0 ** (8.0 - bits)
        return _bytes(128.0 + step * torch.round(128.0 * rest / step))


def fractional_bits(reach: float) -> int:
    """Return the most bits after the point, 0..23, for coordinates up to ``reach``; raise ``UserError`` if none fit."""
    if reach > _MOST:
        raise UserError(f"the scene reaches {reach:.3g} units from the origin, but .spz holds {_MOST}: scale it down.")
    bits = 23
    while reach * 2.0**bits > _MOST:
        bits -= 1
    return bits


def _rotation_bytes(quats: torch.Tensor) -> bytes:
    """Encode x, y, z of unit quaternions with w >= 0, each -1..1 as 0..255."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    unit = torch.where(unit[:, :1] < 0, -unit, unit)
    return _bytes(127.5 + 127.5 * unit[:, 1:])


def _bytes(values: torch.Tensor, least: int = 0, most: int = 255) -> bytes:
    return values.round().clamp(least, most).to(torch.uint8).cpu().numpy().tobytes()
