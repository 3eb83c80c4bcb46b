"""Parsers of photos and masks."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from beags_plugin.system.errors import UserError
from parser_targets.target import SIDE, Target


def _mask(path: Path) -> None:
    from beags_plugin.labels.classes import read_id_mask, read_object_mask

    try:
        read_id_mask(path, (255,))
    except UserError:
        read_object_mask(path)


def _png_files() -> list[bytes]:
    found = []
    for array, form in ((np.eye(SIDE), "PNG"), (300 * np.eye(SIDE), "PNG"), (np.ones((SIDE, SIDE, 3)), "BMP")):
        file = io.BytesIO()
        Image.fromarray(array.astype(np.uint16 if array.max() > 255 else np.uint8)).save(file, form)
        found.append(file.getvalue())
    for form in ("TIFF", "JPEG", "WEBP"):
        file = io.BytesIO()
        Image.fromarray(np.eye(SIDE, dtype=np.uint8)).save(file, form)
        found.append(file.getvalue())
    return found


def _as_png(content: bytes) -> bytes:
    """Return a PNG of the header in the first 13 bytes and the rows in the rest, with correct sums."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header, rows = content[:13].ljust(13, b"\0"), zlib.compress(content[13:])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _png_rows() -> list[bytes]:
    return [struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0) + bytes(SIDE * (SIDE + 1))]


TARGETS = {
    "mask": Target("a.png", _mask, _png_files),
    "mask rows": Target("a.png", _mask, _png_rows, _as_png),
}
