"""Parsers of splats and points: .ply."""

from __future__ import annotations

from pathlib import Path

import torch

from beags_plugin.core.surfels import Surfels
from parser_targets.target import Target, folder


def _splats(path: Path) -> None:
    from beags_plugin.core.flattening import flatten
    from beags_plugin.splat_io.splat_file import read_splat_file

    gaussians = read_splat_file(path).gaussians
    usable = gaussians.usable()
    if bool(usable.any()):
        flatten(gaussians[usable])


def _points(path: Path) -> None:
    from beags_plugin.system.reading.ply import read_ply_points

    read_ply_points(path)


def _ply_files() -> list[bytes]:
    from beags_plugin.splat_io.ply import write_ply

    surfels = Surfels(
        torch.zeros(2, 3), torch.ones(2, 4), torch.zeros(2, 2), torch.zeros(2), torch.zeros(2, 3), torch.zeros(2, 3, 3)
    )
    write_ply(folder() / "seed.ply", surfels, torch.tensor([0, 1], dtype=torch.int32))
    binary = (folder() / "seed.ply").read_bytes()
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2"]
    columns = "".join(f"property float {name}\n" for name in [*names, "rot_3"])
    text = f"ply\nformat ascii 1.0\nelement vertex 1\n{columns}end_header\n" + "1 " * 13 + "\n"
    faces = b"ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty double x\nproperty double y\n"
    faces += b"property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
    faces += b"property list uchar int vertex_indices\nend_header\n" + bytes(27) + b"\3" + bytes(12)
    return [binary, text.encode(), faces]


TARGETS = {
    "ply": Target("a.ply", _splats, _ply_files),
    "seed points": Target("a.ply", _points, _ply_files),
}
