"""Gaussians as .spz, version 3 or 4: several times smaller than a .ply.

Written from the format's public description (nianticlabs/spz, README). Its parts, each for all Gaussians: positions
(24-bit fixed point), alphas, colours, scales, rotations (32 bits) and spherical harmonics (the others 8 bits each).
Version 3 is gzip of a header of 16 bytes and the parts; version 4 a header of 32 bytes, a table, and zstd of each part.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import Exporter
from beags_plugin.export.splat_values import finite_mask, smallest_three
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.splat_io.frames import to_input_frame
from beags_plugin.splat_io.ply import thin_log_scales
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.system.errors import UserError
from beags_plugin.system.zstd import zstandard

MAGIC = 0x5053474E
VERSIONS = (3, 4)
_HEADER = 32  # bytes of the header of version 4
_EFFORT = 12  # zstd's level, of 22; higher ones take much longer for one percent
_MOST = 2**23 - 1  # a signed 24-bit number
_COLOR_SCALE = 0.15  # the format's factor: bytes hold 0.5 + 0.15 dc, so that colours slightly out of range survive


@dataclass(frozen=True)
class SpzExporter(Exporter):
    """Niantic's .spz: Scaniverse, SuperSplat, Babylon.js. It cannot hold class ids.

    Like the tools that make .spz of .ply, it turns the axes of splat .ply files (y down, z forward) to the format's own
    (y up, z backward), half a turn about x; readers turn them back.

    version: 3, which most readers support, or 4, which is slightly smaller and needs zstandard. first_band_bits,
    other_bands_bits: bits of the coefficients of degree 1 and above; fewer compress better.
    """

    suffix: ClassVar[str] = "spz"
    version: int = 3
    first_band_bits: int = 5
    other_bands_bits: int = 4

    def __post_init__(self) -> None:
        if self.version not in VERSIONS:
            raise UserError(f"the version of .spz is {self.version}: it must be 3 or 4.")
        for name in ("first_band_bits", "other_bands_bits"):
            if not 1 <= getattr(self, name) <= 8:
                raise UserError(f"{name} is {getattr(self, name)}: it must lie in 1..8.")

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        count, bits, degree, parts = self._parts(item.surfels)
        if self.version == 4:
            content = _streams(count, degree, bits, [part for part in parts if part or not count])
        else:
            header = struct.pack("<IIIBBBB", MAGIC, self.version, count, degree, bits, 0, 0)
            content = gzip.compress(b"".join([header, *parts]), mtime=0)  # The time would change the bytes.
        write_bytes(path, content)
        return {"version": self.version, "fractional_bits": bits, "sh_degree": degree}

    def _parts(self, surfels: Surfels) -> tuple[int, int, int, list[bytes]]:
        """Return the number of Gaussians, the bits after the point, the degree, and the six parts."""
        half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 0.0], dtype=torch.float64))[:3]
        # Like those tools, reverse two axes of each disc too, which does not change it, so that the .ply comes back.
        quats = surfels.quats.detach() * surfels.quats.new_tensor([1.0, 1.0, -1.0, -1.0])
        turned = replace(to_input_frame(surfels, half_turn, 1.0), quats=quats)
        turned = turned[finite_mask(turned)]
        means = turned.means.double().cpu().numpy()
        bits = fractional_bits(float(np.abs(means).max(initial=0.0)))
        fixed = np.round(means * 2.0**bits).astype("<i4")
        degree = turned.sh_degree
        parts = [
            np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
            # Readers would take 0 and 255 as infinite logits; renderers skip alphas of 1/255 and cap those above 0.99.
            _bytes(255.0 * opacities(turned.opacity_logits.double()), 1, 254),
            _bytes(255.0 * (0.5 + _COLOR_SCALE * turned.sh_dc.double())),
            _bytes(16.0 * (thin_log_scales(turned.log_scales.double()) + 10.0)),
            _rotation_bytes(turned.quats.double()),
            self._sh_bytes(turned.sh_rest.double()),
        ]
        return len(turned), bits, degree, parts

    def _sh_bytes(self, rest: torch.Tensor) -> bytes:
        """Encode coefficients -1..1 as 0..255 with 0 at 128, rounded to the bits of their band; colours innermost."""
        bits = torch.full((rest.shape[1], 1), float(self.other_bands_bits), dtype=rest.dtype)
        bits[:3] = self.first_band_bits
        step = 2.0 ** (8.0 - bits)
        return _bytes(128.0 + step * torch.round(128.0 * rest / step))


def fractional_bits(reach: float) -> int:
    """Return the most fractional bits, 0..23, for coordinates up to ``reach``; raise ``UserError`` if none fit."""
    if reach > _MOST:
        raise UserError(f"the scene reaches {reach:.3g} units from the origin, but .spz holds {_MOST}: scale it down.")
    bits = 23
    while reach * 2.0**bits > _MOST:
        bits -= 1
    return bits


def _rotation_bytes(quats: torch.Tensor) -> bytes:
    """Encode unit quaternions as 32 bits: the index of the largest component, then sign and 9 bits of each other.

    The order is xyzw, the first in the highest bits. The largest is made positive and follows from the length, and the
    others are at most sqrt(1/2).
    """
    unit = torch.nn.functional.normalize(quats, dim=1).cpu().numpy()[:, [1, 2, 3, 0]]
    largest, others = smallest_three(unit)
    words = largest.astype(np.uint32)
    for value in others.T:
        size = np.rint(511.0 * np.abs(value)).clip(0, 511).astype(np.uint32)
        words = words << np.uint32(10) | (value < 0).astype(np.uint32) << np.uint32(9) | size
    return words.astype("<u4").tobytes()


def _streams(count: int, degree: int, bits: int, parts: Sequence[bytes]) -> bytes:
    """Return the content of version 4: a header, a table of sizes, and each part compressed by itself."""
    packer = zstandard().ZstdCompressor(level=_EFFORT)
    packed = [packer.compress(part) for part in parts]
    header = struct.pack("<IIIBBBBI12x", MAGIC, 4, count, degree, bits, 0, len(parts), _HEADER)
    table = b"".join(struct.pack("<QQ", len(one), len(part)) for one, part in zip(packed, parts, strict=True))
    return b"".join([header, table, *packed])


def _bytes(values: torch.Tensor, least: int = 0, most: int = 255) -> bytes:
    return values.round().clamp(least, most).to(torch.uint8).cpu().numpy().tobytes()
