"""Files in a world far from 0, such as map coordinates, where single precision would tear Gaussians apart.

Files are written relative to a local origin. Formats with double precision are moved to the world's coordinates
afterwards; ``ORIGIN_FILE`` beside the others holds their origin.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.splat_io.files import whole_file
from beags_plugin.splat_io.ply import DISC_COMMENT
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices, write_vertices
from beags_plugin.system.reading.text import load_json, reason

FAR = 16.0
"""Distance of a run's middle from 0, over the reach of its cameras, above which single precision is too coarse."""
_HEADER = 4096  # bytes at the start of our .ply files that hold their comments
ORIGIN_FILE = "origin.json"
"""{"origin": [x, y, z], "files": [names]}: the point of the input's world that is 0 in the named files beside it."""


def local_origin(transform: Tensor, scale: float) -> Tensor | None:
    """Return a round point [3] float64 of the input's world near the middle of a run; None for a world near 0.

    transform, scale: x' = scale (R x + t) with R | t [3, 4]; the cameras' x' reach to about 1.
    """
    matrix = transform.detach().double().cpu()
    middle = -matrix[:, :3].T @ matrix[:, 3]
    reach = 1.0 / scale
    if not float(middle.abs().max()) > FAR * reach:
        return None
    step = 10.0 ** math.floor(math.log10(reach))
    return (middle / step).round() * step


def about(transform: Tensor, origin: Tensor) -> Tensor:
    """Return R | t [3, 4] float64 of the same world with ``origin`` [3] as 0."""
    matrix = transform.detach().double().cpu()
    return torch.cat([matrix[:, :3], (matrix[:, 3] + matrix[:, :3] @ origin)[:, None]], dim=1)


def to_world(path: Path, origin: Tensor) -> bool:
    """Move a .ply of points or Gaussians, or an .obj, from ``origin`` to the world, in double precision.

    Returns False, and changes nothing, for a file that cannot hold double precision.
    """
    name = path.name.lower()
    if name.endswith(".obj"):
        _move_obj(path, origin.tolist())
        return True
    if not name.endswith(".ply"):
        return False
    table = read_vertices(path)
    with path.open("rb") as file:
        comment = DISC_COMMENT if DISC_COMMENT.encode() in file.read(_HEADER) else ""
    names = table.dtype.names or ()
    if not all(axis in names for axis in "xyz"):
        return False
    kinds = [(name, "<f8" if name in ("x", "y", "z") else table.dtype[name].newbyteorder("<")) for name in names]
    moved = np.empty(len(table), kinds)
    for name in names:
        moved[name] = table[name]
    for axis, value in zip("xyz", origin.tolist(), strict=True):
        moved[axis] += value
    del table  # The table may map the file, which is replaced below.
    with whole_file(path) as part, open(part, "wb") as file:
        write_vertices(file, moved, comment)
    return True


def _move_obj(path: Path, origin: list[float]) -> None:
    lines = []
    for line in path.read_text("utf8").splitlines(keepends=True):
        if line.startswith("v "):
            words = line.split()
            places = [repr(float(word) + value) for word, value in zip(words[1:4], origin, strict=True)]
            line = " ".join(["v", *places, *words[4:]]) + "\n"
        lines.append(line)
    with whole_file(path) as part:
        part.write_text("".join(lines), "utf8")


def write_origin(folder: Path, origin: Tensor, files: list[str]) -> Path:
    """Write the origin of ``files`` into ``ORIGIN_FILE`` in ``folder``; it keeps other files of the same origin."""
    path = folder / ORIGIN_FILE
    former = _read(path) if path.is_file() else {}
    others = former.get("files", []) if former.get("origin") == origin.tolist() else []
    content = {"origin": origin.tolist(), "files": sorted({*others, *files})}
    with whole_file(path) as part:
        part.write_text(json.dumps(content, indent=1), "utf8")
    return path


def unlist(folder: Path, names: Collection[str]) -> None:
    """Remove rewritten files from ``ORIGIN_FILE``, and remove it with the last one."""
    path = folder / ORIGIN_FILE
    if not path.is_file():
        return
    content = _read(path)
    left = [name for name in content["files"] if name not in names]
    if not left:
        path.unlink()
    elif len(left) < len(content["files"]):
        with whole_file(path) as part:
            part.write_text(json.dumps({"origin": list(content["origin"]), "files": left}, indent=1), "utf8")


def origin_of(path: Path) -> Tensor | None:
    """Return the origin [3] float64 of a file by ``ORIGIN_FILE`` beside it; None if the file is not named there."""
    beside = path.parent / ORIGIN_FILE
    content = _read(beside) if beside.is_file() else {}
    return torch.tensor(content["origin"], dtype=torch.float64) if path.name in content.get("files", []) else None


def _read(path: Path) -> Mapping:
    try:
        content = load_json(path)
        if len(content["origin"]) != 3 or not all(math.isfinite(value) for value in content["origin"]):
            raise ValueError("its origin is no point")
        if not isinstance(content["files"], list) or not all(isinstance(name, str) for name in content["files"]):
            raise ValueError("its files are no list of names")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): restore it, or remove it.") from error
    return content


def double_means(path: Path, count: int) -> Tensor | None:
    """Return the positions [count, 3] float64 of a .ply whose x, y, z are in double precision; None for other files."""
    if path.suffix.lower() != ".ply":
        return None
    try:
        table = read_vertices(path)
    except (OSError, ValueError):
        return None
    names = table.dtype.names or ()
    if len(table) != count or not all(axis in names and table.dtype[axis].itemsize == 8 for axis in "xyz"):
        return None
    return torch.from_numpy(np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64))


def far_world_note(origin: Tensor, in_world: bool, others: bool) -> str:
    """Return a sentence on how files of a world far from 0 were written.

    in_world: some files are in the world's coordinates. others: some are relative to ``origin``.
    """
    at = ", ".join(f"{value:g}" if abs(value) < 1e6 else f"{value:.0f}" for value in origin.tolist())
    parts = []
    if in_world:
        parts.append("positions in .ply, .obj, .glb and splats of USD are in double precision")
    if not in_world and not others:
        parts.append(f"the files' origin is its point {at}")
    if others:
        which = "the other" if in_world else "the"
        parts.append(f"{which} files are relative to {at}, as {ORIGIN_FILE} beside them says")
    return (
        f"The world lies far from 0, where single precision is too coarse: {' and '.join(parts)} (for a viewer: "
        "--frame object)."
    )
