"""Poses, cameras and seed points that cannot be used."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from data_folders import HEIGHT, WIDTH, noise, ring, write_colmap, write_image

from mistakes.table import Place, beags_after, mistakes, train_after

NAN = float("nan")


def frames(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], Any]:
    """Return a mistake in the first frame of transforms.json."""
    return train_after(lambda at: at.edit_poses(lambda meta: change(meta["frames"][0])))


def entries(**values: Any) -> Callable[[Place], Any]:
    """Return a mistake in transforms.json itself; None takes an entry out."""

    def change(meta):
        meta.update(values)
        for key in [key for key, value in values.items() if value is None]:
            del meta[key]

    return train_after(lambda at: at.edit_poses(change))


def to_one_place(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        for row in frame["transform_matrix"]:
            row[3] = float(row[3] == 1.0 and row[:3] == [0.0, 0.0, 0.0])


def transforms(text: bytes) -> Callable[[Place], Any]:
    return train_after(lambda at: (at.data / "transforms.json").write_bytes(text))


def seed_points(content: bytes) -> Callable[[Place], Any]:
    def change(at: Place):
        (at.data / "points.ply").write_bytes(content)
        at.edit_poses(lambda meta: meta.update(ply_file_path="points.ply"))

    return train_after(change)


def colmap(damage: Callable[[Path], Any]) -> Callable[[Place], Any]:
    def make(at: Place):
        write_colmap(at.root / "colmap", points=np.zeros((20, 3)))
        damage(at.root / "colmap/sparse/0")
        return at.train(data=at.root / "colmap")

    return make


def giant(name: str) -> Callable[[Path], Any]:
    """Return a damage: the count that the file begins with is 2^60."""
    return lambda model: (model / name).write_bytes(struct.pack("<Q", 1 << 60) + (model / name).read_bytes()[8:])


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n"
HEADER = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    b"property float x\nproperty float y\nproperty float z\nend_header\n"
)
mistakes(
    "poses",
    {
        "not a number in a pose": frames(lambda frame: frame["transform_matrix"].__setitem__(1, [0, 1, 0, NAN])),
        "singular": frames(lambda frame: frame.update(transform_matrix=[[0.0] * 4] * 3 + [[0, 0, 0, 1]])),
        "all of one place": train_after(lambda at: at.edit_poses(to_one_place)),
        "a matrix of 2 x 2": frames(lambda frame: frame.update(transform_matrix=[[1, 0], [0, 1]])),
        "a frame without a file": frames(lambda frame: frame.pop("file_path")),
        "no frames": entries(frames=[]),
        "focal length 0": entries(fl_x=0.0),
        "focal length negative": entries(fl_y=-16.0),
        "focal length not a number": entries(fl_x=NAN),
        "focal length a word": entries(fl_x="wide"),
        "focal length missing": entries(fl_x=None, fl_y=None),
        "width 0": entries(w=0),
        "an angle in degrees": entries(fl_x=None, fl_y=None, camera_angle_x=69.0),
        "principal point not a number": entries(cx=NAN),
        "distortion not a number": entries(k1=NAN),
        "distortion k4 a word": entries(k4="much"),
        "an unknown kind of camera": entries(camera_model="MAGIC"),
        "a panorama": entries(camera_model="EQUIRECTANGULAR"),
        "splits without held-out views": entries(train_filenames=["images/v01.png"]),
        "splits without held-out views, met by a check": beags_after(
            lambda at: at.edit_poses(lambda meta: meta.update(train_filenames=["images/v01.png"])),
            "masks check --data {data}",
        ),
        "splits that name an absent photo": entries(
            train_filenames=["images/v01.png"], val_filenames=["images/v77.png"]
        ),
        "seed points missing": entries(ply_file_path="points.ply"),
        "seed points are no path": entries(ply_file_path=7),
        "transforms.json broken": transforms(b'{"frames": ['),
        "transforms.json nested 100,000 deep": transforms(b"[" * 100_000),
        "a layout that the folder is not": lambda at: at.train("beags-data", "--layout", "llff"),
        "an unknown layout": lambda at: at.train("beags-data", "--layout", "polycam"),
        "seed points are text": seed_points(b"hello"),
        "seed points not numbers": seed_points(HEADER + struct.pack("<6f", NAN, 0, 0, NAN, 0, 0)),
        "COLMAP's cameras.bin cut off": colmap(lambda model: cut(model / "cameras.bin")),
        "COLMAP's images.bin promises 2^60": colmap(giant("images.bin")),
        "COLMAP's points3D.bin promises 2^60": colmap(giant("points3D.bin")),
        "COLMAP's images.bin beside transforms.json cut off, met by a check": beags_after(
            lambda at: (write_colmap(at.data, folder="colmap/sparse/0"), cut(at.data / "colmap/sparse/0/images.bin")),
            "masks check --data {data}",
        ),
        "COLMAP's cameras.bin is a pointer": colmap(lambda model: (model / "cameras.bin").write_bytes(POINTER)),
        "transforms.json is a web page": transforms(b"<!DOCTYPE html><html><body>Sign in</body></html>"),
        "seed points without a byte": seed_points(b""),
        "COLMAP's images.bin missing": colmap(lambda model: (model / "images.bin").unlink()),
    },
)


def llff(rows: np.ndarray | bytes) -> Callable[[Place], Any]:
    """Return a mistake in poses_bounds.npy of a folder with nine photos."""

    def make(at: Place):
        folder = at.root / "scene"
        for index in range(9):
            write_image(folder / f"images/v{index}.png", noise(index))
        if isinstance(rows, bytes):
            (folder / "poses_bounds.npy").write_bytes(rows)
        else:
            np.save(folder / "poses_bounds.npy", rows)
        return at.train(data=folder, preset="beags-base")

    return make


def llff_rows() -> np.ndarray:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # turn from OpenGL's axes to LLFF's
    poses = [np.c_[pose[:3, :3] @ turn, pose[:3, 3], [HEIGHT, WIDTH, 17.0]] for pose in ring(9)]
    return np.array([np.r_[pose.ravel(), 1.0, 5.0] for pose in poses])


def changed(column: int, value: float) -> np.ndarray:
    rows = llff_rows()
    rows[2, column] = value
    return rows


ENDLESS = str({"descr": "<f8", "fortran_order": False, "shape": (10**15, 17)}).ljust(117).encode()
mistakes(
    "poses",
    {
        "poses_bounds.npy of wrong shape": llff(np.ones((9, 15))),
        "poses_bounds.npy of another number of rows": llff(llff_rows()[:7]),
        "poses_bounds.npy with focal length 0": llff(changed(14, 0.0)),
        "poses_bounds.npy with a depth of 0": llff(changed(15, 0.0)),
        "poses_bounds.npy is text": llff(b"no array"),
        "poses_bounds.npy promises 10^15 rows": llff(b"\x93NUMPY\x01\x00v\x00" + ENDLESS + b"\n"),
    },
)
