"""Poses, cameras and seed points that cannot be used."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from data_folders import HEIGHT, WIDTH, noise, ring, write_colmap, write_image

from mistakes.table import Place, mistake

NAN = float("nan")


def frames(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], Any]:
    """A mistake in the first frame of transforms.json."""

    def make(at: Place):
        at.edit_poses(lambda meta: change(meta["frames"][0]))
        return at.train()

    return make


def entries(**values: Any) -> Callable[[Place], Any]:
    """A mistake in transforms.json itself."""

    def make(at: Place):
        at.edit_poses(lambda meta: meta.update(values))
        return at.train()

    return make


def without(key: str) -> Callable[[Place], Any]:
    def make(at: Place):
        at.edit_poses(lambda meta: meta.pop(key))
        return at.train()

    return make


def set_row(row: int, values: list[Any]) -> Callable[[dict[str, Any]], None]:
    return lambda frame: frame["transform_matrix"].__setitem__(row, values)


mistake("poses", "not a number in a pose")(frames(set_row(1, [0, 1, 0, NAN])))
mistake("poses", "singular")(frames(lambda frame: frame.update(transform_matrix=[[0.0] * 4] * 3 + [[0, 0, 0, 1]])))


@mistake("poses", "all of one place")
def _(at: Place):
    def move(meta):
        for frame in meta["frames"]:
            for row in frame["transform_matrix"]:
                row[3] = float(row[3] == 1.0 and row[:3] == [0.0, 0.0, 0.0])

    at.edit_poses(move)
    return at.train()


mistake("poses", "a matrix of 2 x 2")(frames(lambda frame: frame.update(transform_matrix=[[1, 0], [0, 1]])))
mistake("poses", "a frame without a file")(frames(lambda frame: frame.pop("file_path")))
mistake("poses", "no frames")(entries(frames=[]))
mistake("poses", "focal length 0")(entries(fl_x=0.0))
mistake("poses", "focal length negative")(entries(fl_y=-16.0))
mistake("poses", "focal length not a number")(entries(fl_x=NAN))
mistake("poses", "focal length a word")(entries(fl_x="wide"))
mistake("poses", "focal length missing")(without("fl_x"))
mistake("poses", "width 0")(entries(w=0))
mistake("poses", "height missing")(without("h"))
mistake("poses", "principal point not a number")(entries(cx=NAN))
mistake("poses", "distortion not a number")(entries(k1=NAN))
mistake("poses", "distortion k4 a word")(entries(k4="much"))
mistake("poses", "an unknown kind of camera")(entries(camera_model="MAGIC"))
mistake("poses", "a panorama")(entries(camera_model="EQUIRECTANGULAR"))
mistake("poses", "splits without held-out views")(entries(train_filenames=["images/v01.png"]))
mistake("poses", "splits that name an absent photo")(
    entries(train_filenames=["images/v01.png"], val_filenames=["images/v77.png"])
)
mistake("poses", "seed points missing")(entries(ply_file_path="points.ply"))
mistake("poses", "seed points are no path")(entries(ply_file_path=7))


def transforms(text: bytes) -> Callable[[Place], Any]:
    def make(at: Place):
        (at.data / "transforms.json").write_bytes(text)
        return at.train()

    return make


mistake("poses", "transforms.json broken")(transforms(b'{"frames": ['))
mistake("poses", "transforms.json nested 100,000 deep")(transforms(b"[" * 100_000))


@mistake("poses", "a layout that the folder is not")
def _(at: Place):
    return at.train("beags-data", "--layout", "llff")


@mistake("poses", "an unknown layout")
def _(at: Place):
    return at.train("beags-data", "--layout", "polycam")


def seed_points(content: bytes) -> Callable[[Place], Any]:
    def make(at: Place):
        (at.data / "points.ply").write_bytes(content)
        at.edit_poses(lambda meta: meta.update(ply_file_path="points.ply"))
        return at.train()

    return make


HEADER = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
)
mistake("poses", "seed points are text")(seed_points(b"hello"))
mistake("poses", "seed points not numbers")(
    seed_points(HEADER % 2 + b"end_header\n" + struct.pack("<6f", 0, 0, 0, NAN, 0, 0))
)


def colmap(damage: Callable[[Path], Any], text: bool = False) -> Callable[[Place], Any]:
    def make(at: Place):
        write_colmap(at.root / "colmap", points=np.zeros((20, 3)), text=text)
        damage(at.root / "colmap/sparse/0")
        return at.train(data=at.root / "colmap")

    return make


def cut(name: str) -> Callable[[Path], Any]:
    return lambda model: (model / name).write_bytes((model / name).read_bytes()[:-40])


def giant(name: str) -> Callable[[Path], Any]:
    """The count that the file begins with is 2^60."""
    return lambda model: (model / name).write_bytes(struct.pack("<Q", 1 << 60) + (model / name).read_bytes()[8:])


mistake("poses", "COLMAP's cameras.bin cut off")(colmap(cut("cameras.bin")))
mistake("poses", "COLMAP's images.bin promises 2^60")(colmap(giant("images.bin")))
mistake("poses", "COLMAP's points3D.bin promises 2^60")(colmap(giant("points3D.bin")))
mistake("poses", "COLMAP's images.bin missing")(colmap(lambda model: (model / "images.bin").unlink()))


def llff(rows: np.ndarray | bytes) -> Callable[[Place], Any]:
    def make(at: Place):
        folder = at.root / "llff"
        for index in range(9):
            write_image(folder / f"images/v{index}.png", noise(index))
        if isinstance(rows, bytes):
            (folder / "poses_bounds.npy").write_bytes(rows)
        else:
            np.save(folder / "poses_bounds.npy", rows)
        return at.train(data=folder, preset="beags-base")

    return make


def llff_rows() -> np.ndarray:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # from OpenGL's axes to LLFF's
    poses = [np.c_[pose[:3, :3] @ turn, pose[:3, 3], [HEIGHT, WIDTH, 17.0]] for pose in ring(9)]
    return np.array([np.r_[pose.ravel(), 1.0, 5.0] for pose in poses])


def changed(column: int, value: float) -> np.ndarray:
    rows = llff_rows()
    rows[2, column] = value
    return rows


mistake("poses", "poses_bounds.npy of wrong shape")(llff(np.ones((9, 15))))
mistake("poses", "poses_bounds.npy of another number of rows")(llff(llff_rows()[:7]))
mistake("poses", "poses_bounds.npy with focal length 0")(llff(changed(14, 0.0)))
mistake("poses", "poses_bounds.npy with a depth of 0")(llff(changed(15, 0.0)))
mistake("poses", "poses_bounds.npy is text")(llff(b"no array"))
mistake("poses", "poses_bounds.npy promises 10^15 rows")(
    llff(
        b"\x93NUMPY\x01\x00v\x00"
        + str({"descr": "<f8", "fortran_order": False, "shape": (10**15, 17)}).ljust(117).encode()
        + b"\n"
    )
)


def dtu(content: dict[str, Any] | bytes) -> Callable[[Place], Any]:
    def make(at: Place):
        folder = at.root / "dtu"
        for index in range(9):
            write_image(folder / f"image/{index:06d}.png", noise(index))
        if isinstance(content, bytes):
            (folder / "cameras_sphere.npz").write_bytes(content)
        else:
            np.savez(folder / "cameras_sphere.npz", **content)
        return at.train(data=folder)

    return make


def dtu_cameras() -> dict[str, Any]:
    K = np.array([[17.0, 0, 10, 0], [0, 16, 6, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    flip = np.diag([1.0, -1, -1, 1])
    return {f"world_mat_{index}": K @ np.linalg.inv(pose @ flip) for index, pose in enumerate(ring(9))}


mistake("poses", "cameras_sphere.npz lacks a key")(dtu({**dtu_cameras(), "world_mat_3": [1.0]}))
mistake("poses", "cameras_sphere.npz of fewer cameras")(
    dtu({name: value for name, value in dtu_cameras().items() if name != "world_mat_8"})
)
mistake("poses", "cameras_sphere.npz singular")(dtu({**dtu_cameras(), "world_mat_3": np.zeros((4, 4))}))
mistake("poses", "cameras_sphere.npz with words")(dtu({**dtu_cameras(), "world_mat_3": np.array(["a"])}))
