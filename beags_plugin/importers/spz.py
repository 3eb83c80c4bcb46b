"""Importer of Niantic's .spz, versions 2 to 4 (README of nianticlabs/spz).

Versions 2 and 3 are one gzip stream: a header of 16 bytes, then positions (24-bit fixed point), alphas, colours,
scales, rotations and bands, each for all Gaussians. Version 4 has an uncompressed header of 32 bytes and a zstd stream
for each of the six. Rotations have 8 bits for each of x, y and z in version 2. Since version 3 the two highest of 32
bits are the index of the largest component; the other three have a sign and 9 bits each, the last one lowest.
"""

from __future__ import annotations

import gzip
import io
import math
import struct
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.core.sh import num_sh_bases
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import MOST_ZIPPED, cut_bands, gaussians_of, reading, with_largest
from beags_plugin.system.zstd import zstandard

_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15
_MOST_ZSTD = 40_000  # largest expansion by zstd, with a margin
_HEADER = 32  # bytes of the header of version 4
_STREAMS = 6
_AXES, _RIGHT_UP_BACK = 0xADBE0003, 4  # extension for the axes, and the value of the format's own axes
_HIGHEST_DEGREE = 4
# Signs by which the basis functions of bands 1 to 3 change when y and z change sign.
HALF_TURN_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])


class SpzImporter(Importer):
    """An .spz, turned back to the axes of .ply files: the tools that write .spz turn scenes half a turn about x."""

    marks: ClassVar[str] = "an .spz"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() == ".spz"

    def read(self, path: Path) -> ImportedScene:
        with reading(path, ".spz"):
            content = path.read_bytes()
            zipped = content[:2] == b"\x1f\x8b"
            version, count, degree, bits, parts = _unzipped(content) if zipped else _streams(content)
            positions, alphas, colors, scales, rotations, rest = parts
            quats = _three_bytes(rotations) if version == 2 else _smallest_three(rotations)
            rest = (rest.reshape(count, num_sh_bases(degree) - 1, 3)[:, : len(HALF_TURN_SIGNS)] - 128.0) / 128.0
            gaussians = gaussians_of(
                _fixed_points(positions, bits) * [1.0, -1.0, -1.0],
                quats * [1.0, 1.0, -1.0, -1.0],
                scales.reshape(count, 3) / 16.0 - 10.0,
                alphas / 255.0,
                (colors.reshape(count, 3) / 255.0 - 0.5) / _COLOR_SCALE,
                rest * HALF_TURN_SIGNS[: rest.shape[1], None],
            )
        lost = "Scales, colours, opacities and bands have 8 bits or fewer"
        lost += ", and rotations 8 bits, so that thin discs are tilted." if version == 2 else "."
        remarks = (lost, *cut_bands(degree))
        return ImportedScene(f".spz version {version}", gaussians, remarks=remarks, doubtful_axes=True)


def _sizes(version: int, count: int, degree: int) -> list[int]:
    """Return the bytes of each part."""
    if not 2 <= version <= 4:
        raise ValueError(f"its version is {version}, but 2 to 4 are read")
    if degree > _HIGHEST_DEGREE:
        raise ValueError(f"its degree is {degree}")
    rotation = 3 if version == 2 else 4
    return [9 * count, count, 3 * count, 3 * count, rotation * count, 3 * (num_sh_bases(degree) - 1) * count]


def _unzipped(content: bytes) -> tuple[int, int, int, int, list[np.ndarray]]:
    """Return the version, the count, the degree, the fractional bits and the parts of versions 2 and 3."""
    stream = gzip.GzipFile(fileobj=io.BytesIO(content))
    magic, version, count, degree, bits, _, _ = struct.unpack("<IIIBBBB", stream.read(16))
    if magic != _MAGIC or version == 4:
        raise ValueError("its header is that of something else")
    sizes = _sizes(version, count, degree)
    if sum(sizes) > MOST_ZIPPED * len(content):
        raise ValueError(f"it promises {count} Gaussians, which do not fit into it")
    parts = []
    for size in sizes:
        part = stream.read(size)
        if len(part) < size:
            raise ValueError("it ends too early")
        parts.append(np.frombuffer(part, np.uint8))
    return version, count, degree, bits, parts


def _streams(content: bytes) -> tuple[int, int, int, int, list[np.ndarray]]:
    """Return the same as ``_unzipped`` for version 4."""
    magic, version, count, degree, bits, _, streams, place = struct.unpack_from("<IIIBBBBI", content)
    if magic != _MAGIC or version != 4:
        raise ValueError("it starts with another format's bytes")
    sizes = _sizes(version, count, degree)
    if streams < _STREAMS and not (streams == _STREAMS - 1 and not sizes[-1]):
        raise ValueError(f"it has {streams} streams")
    if sum(sizes) > _MOST_ZSTD * len(content):
        raise ValueError(f"it promises {count} Gaussians, which do not fit into it")
    _check_axes(content[_HEADER:place])
    table = [struct.unpack_from("<QQ", content, place + 16 * number) for number in range(streams)]
    at, parts, unpack = place + 16 * streams, [], zstandard().ZstdDecompressor()
    for number, size in enumerate(sizes):
        packed, promised = table[number] if number < streams else (0, 0)
        if promised != size or at + packed > len(content):
            raise ValueError(f"its stream {number} has {promised} bytes instead of {size}")
        part = _unpacked(unpack, content[at : at + packed], size) if size else b""
        parts.append(np.frombuffer(part, np.uint8))
        at += packed
    return version, count, degree, bits, parts


def _check_axes(records: bytes) -> None:
    """Raise ``ValueError`` if an extension of version 4 states other axes than right, up and backward.

    records: each has 32 bits of kind, 32 of length, and the content; those of other kinds are skipped.
    """
    at = 0
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        if kind == _AXES and int.from_bytes(records[at + 8 : at + 8 + length], "little") not in (0, _RIGHT_UP_BACK):
            raise ValueError("its axes are not right, up and backward: save it with these")
        at += 8 + length


def _unpacked(unpack: Any, packed: bytes, size: int) -> bytes:
    try:
        part = unpack.stream_reader(packed).read(size + 1)  # the frame may state a larger size
    except zstandard().ZstdError as error:
        raise ValueError(str(error)) from None
    if len(part) != size:
        raise ValueError("a stream ends too early")
    return part


def _fixed_points(data: np.ndarray, bits: int) -> np.ndarray:
    """Return [N, 3] from signed 24-bit numbers with ``bits`` bits after the point."""
    wide = np.zeros((len(data) // 3, 4), np.uint8)
    wide[:, 1:] = data.reshape(-1, 3)
    return (wide.view("<i4")[:, 0] >> 8).reshape(-1, 3) / 2.0**bits


def _three_bytes(data: np.ndarray) -> np.ndarray:
    """Return the quaternions wxyz of version 2: x, y, z as bytes, and w positive."""
    three = data.reshape(-1, 3) / 127.5 - 1.0
    return with_largest(three, np.zeros(len(three), np.int64))


def _smallest_three(data: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz of versions 3 and 4; the file's order is xyzw."""
    words = np.ascontiguousarray(data).view("<u4").astype(np.int64)
    shifted = np.stack([words >> 20, words >> 10, words], axis=1)
    sizes = (shifted & 511) / 511.0 * math.sqrt(0.5)
    xyzw = with_largest(np.where(shifted & 512, -sizes, sizes), words >> 30)
    return xyzw[:, [3, 0, 1, 2]]
