"""Photographs that cannot be used."""

from __future__ import annotations

import shutil
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
from data_folders import noise, write_colmap, write_image
from photographed_corner import film
from PIL import Image

from mistakes.table import Place, beags_after, mistake, mistakes, train_after


def huge_png(path: Path, side: int = 60_000) -> None:
    """Write a PNG of a few bytes that promises ``side`` x ``side`` pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    packed = zlib.compress(bytes(1000))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b""))


def name_one_twice(meta: dict) -> None:
    meta["frames"][1]["file_path"] = meta["frames"][0]["file_path"]


mistakes(
    "photos",
    {
        "cut off": train_after(lambda at: at.cut(at.photo)),
        "cut off, met by a check": beags_after(lambda at: at.cut(at.photo), "masks check --data {data}"),
        "not the size that the camera has": train_after(lambda at: write_image(at.photo, noise(0, 20, 20))),
        "16 bits per channel": train_after(lambda at: write_image(at.photo, np.zeros((12, 20), np.uint16))),
        "a bomb of 60,000 x 60,000 pixels": train_after(lambda at: huge_png(at.photo)),
        "more than half missing": train_after(
            lambda at: [(at.data / f"images/v{index:02d}.png").unlink() for index in range(5)]
        ),
        "one missing, and none may be": train_after(lambda at: at.photo.unlink(), "beags-data", "--strict", "True"),
        "only one": train_after(lambda at: at.edit_poses(lambda meta: meta.update(frames=meta["frames"][:1]))),
        "one file named by two poses": train_after(lambda at: at.edit_poses(name_one_twice)),
    },
)


PROCESS = "process --output-dir posed --data"


def photo_on_its_side(at: Place) -> None:
    for name in "abc":
        image = Image.fromarray(noise(0, 20, 20))
        exif = image.getexif()
        exif[274] = 6
        (at.root / "posed/images").mkdir(parents=True, exist_ok=True)
        image.save(at.root / f"posed/images/{name}.jpg", exif=exif)


def held(at: Place) -> None:
    import fcntl

    folder_of("a.png", "b.png", "c.png")(at)
    (at.root / "posed").mkdir()
    at.held = open(at.root / "posed/.lock", "ab")  # noqa: SIM115  (as another process holds it)
    fcntl.flock(at.held, fcntl.LOCK_EX)


def folder_of(*names: str):
    """Return what makes a folder of such photos, before ``beags process`` runs."""

    def change(at: Place) -> None:
        (at.root / "taken").mkdir()
        for name in names:
            write_image(at.root / "taken" / name, noise(0, 20, 20))

    return change


mistakes(
    "photos",
    {
        "none to find poses for": beags_after(lambda at: (at.root / "taken").mkdir(), f"{PROCESS} taken"),
        "two to find poses for": beags_after(folder_of("a.png", "b.png"), f"{PROCESS} taken"),
        "16 bits, to find poses for": beags_after(
            lambda at: (
                folder_of("a.png", "b.png")(at),
                write_image(at.root / "taken/c.png", np.zeros((9, 9), np.uint16)),
            ),
            f"{PROCESS} taken",
        ),
        "cut off, to find poses for": beags_after(
            lambda at: (folder_of("a.png", "b.png", "c.png")(at), at.cut(at.root / "taken/c.png")), f"{PROCESS} taken"
        ),
        "on their side, in place": beags_after(photo_on_its_side, f"{PROCESS} posed"),
        "others in the folder for poses": beags_after(
            lambda at: (
                folder_of("a.png", "b.png", "c.png")(at),
                shutil.copytree(at.root / "taken", at.root / "posed/images"),
            ),
            f"{PROCESS} taken",
        ),
        "a folder of other files": beags_after(
            lambda at: ((at.root / "taken").mkdir(), (at.root / "taken/a.txt").write_text("x")), f"{PROCESS} taken"
        ),
        "a video of one frame": beags_after(
            lambda at: film(at.root / "one.mp4", [noise(0, 32, 32)]), f"{PROCESS} one.mp4"
        ),
        "two processes find poses": beags_after(held, f"{PROCESS} taken"),
        "masks of other photos": beags_after(
            lambda at: (folder_of("a.png", "b.png", "c.png")(at), write_image(at.root / "of/d.png", noise(0, 20, 20))),
            f"{PROCESS} taken --masks of",
        ),
        "masks of another size": beags_after(
            lambda at: (folder_of("a.png", "b.png", "c.png")(at), write_image(at.root / "of/b.png", noise(0, 20, 9))),
            f"{PROCESS} taken --masks of",
        ),
        "no folder of masks for poses": beags_after(
            folder_of("a.png", "b.png", "c.png"), f"{PROCESS} taken --masks of"
        ),
        "on their side, with masks": beags_after(
            lambda at: (photo_on_its_side(at), write_image(at.root / "of/a.png", noise(0, 20, 20))),
            "process --data posed/images --output-dir upright --masks of",
        ),
        "no pycolmap": beags_after(
            lambda at: (folder_of("a.png", "b.png", "c.png")(at), at.patch.setitem(sys.modules, "pycolmap", None)),
            f"{PROCESS} taken",
        ),
        "HEIC": beags_after(
            lambda at: ((at.root / "taken").mkdir(), (at.root / "taken/a.heic").write_bytes(b"x")), f"{PROCESS} taken"
        ),
        "nothing alike in them": beags_after(folder_of("a.png", "b.png", "c.png"), f"{PROCESS} taken"),
        "a video that is none": beags_after(
            lambda at: (at.root / "walk.mp4").write_bytes(b"no video"), f"{PROCESS} walk.mp4"
        ),
        "a file that is no video": beags_after(
            lambda at: (at.root / "walk.txt").write_bytes(b""), f"{PROCESS} walk.txt"
        ),
        "poses of another program": beags_after(lambda at: at.data, "process --data {data} --output-dir {data}"),
    },
)


@mistake("photos", "none in the folder of a COLMAP scene")
def _(at: Place):
    write_colmap(at.root / "colmap")
    for path in (at.root / "colmap/images").iterdir():
        path.unlink()
    return at.train(data=at.root / "colmap")


@mistake("photos", "two of one name share a mask")
def _(at: Place):
    def move(meta):
        (at.data / "images/left").mkdir()
        (at.data / "images/v01.png").rename(at.data / "images/left/v02.png")
        frame = next(frame for frame in meta["frames"] if frame["file_path"].endswith("v01.png"))
        frame["file_path"] = "images/left/v02.png"

    at.edit_poses(move)
    return at.train()
