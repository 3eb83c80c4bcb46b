"""Photographs that cannot be used."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from data_folders import noise, write_image

from mistakes.table import Place, mistake


def huge_png(path: Path, side: int = 60_000) -> None:
    """A PNG of a few bytes that promises ``side`` x ``side`` pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    packed = zlib.compress(bytes(1000))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b""))


@mistake("photos", "cut off")
def _(at: Place):
    at.cut(at.data / "images/v02.png")
    return at.train()


@mistake("photos", "not the size that the camera has")
def _(at: Place):
    write_image(at.data / "images/v02.png", noise(0, 20, 20))
    return at.train()


@mistake("photos", "16 bits per channel")
def _(at: Place):
    write_image(at.data / "images/v02.png", np.zeros((12, 20), np.uint16))
    return at.train()


@mistake("photos", "a bomb of 60,000 x 60,000 pixels")
def _(at: Place):
    huge_png(at.data / "images/v02.png")
    return at.train()


@mistake("photos", "only one")
def _(at: Place):
    at.edit_poses(lambda meta: meta.update(frames=meta["frames"][:1]))
    return at.train()


@mistake("photos", "none in the folder of a COLMAP scene")
def _(at: Place):
    from data_folders import write_colmap

    write_colmap(at.root / "colmap")
    for path in (at.root / "colmap/images").iterdir():
        path.unlink()
    return at.train(data=at.root / "colmap")


@mistake("photos", "one file named by two poses")
def _(at: Place):
    at.edit_poses(lambda meta: meta["frames"][1].update(file_path=meta["frames"][0]["file_path"]))
    return at.train()


@mistake("photos", "two of one name share a mask")
def _(at: Place):
    def move(meta):
        (at.data / "images/left").mkdir()
        (at.data / "images/v01.png").rename(at.data / "images/left/v02.png")
        frame = next(frame for frame in meta["frames"] if frame["file_path"].endswith("v01.png"))
        frame["file_path"] = "images/left/v02.png"

    at.edit_poses(move)
    return at.train()
