"""Read splat .ply files of any program, with flat or 3D Gaussians; they are checked before memory is allocated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.sh import MAX_DEGREE, SH_C0, num_sh_bases
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.colors import range_of
from beags_plugin.system.reading.ply import read_vertices
from beags_plugin.system.reading.text import reason


@dataclass(frozen=True)
class SplatFile:
    """Content of a .ply: N Gaussians with two or three scales, in float32, and class_ids [N] int32 if it has them.

    remarks: sentences for the user, such as what the file lacks.
    """

    gaussians: Gaussians
    class_ids: Tensor | None
    remarks: tuple[str, ...] = ()


def read_splat_file(path: str | Path) -> SplatFile:
    """Read the vertices of a splat .ply in the layout of 3DGS, 2DGS or ns-export, binary or text.

    Columns: x y z, f_dc_0..2 (or red green blue), f_rest_* channel-major (whole bands; those above degree 3 are left
    out), opacity (logit), scale_0..1 or 0..2 (logs), rot_0..3 (wxyz), class_id if present. Values need not be finite.
    Raises ``UserError`` if the file cannot be read, is no splat .ply, or is shorter than its header says.
    """
    path = Path(path)
    try:
        vertex = read_vertices(path)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name an existing .ply file.") from error
    except (ValueError, MemoryError) as error:
        raise UserError(f"{path} is not a splat .ply file ({reason(error)}): name one.") from error
    present = set(vertex.dtype.names or ())
    rest_count = sum(name.startswith("f_rest_") for name in present)
    degree = math.isqrt(1 + rest_count // 3) - 1
    if rest_count != 3 * (num_sh_bases(degree) - 1):
        raise UserError(
            f"{path} has {rest_count} f_rest columns, but 0, 9, 24, 45 or 72 make whole colour bands: export it again."
        )
    colors = numbered("f_dc", 3)
    as_rgb = colors[0] not in present and "red" in present
    if as_rgb:
        colors = ("red", "green", "blue")
    as_rgb = as_rgb or (colors[0] in present and _whole(vertex, colors[0]))  # Bytes are shares of 1.
    blocks = [("x", "y", "z"), colors, ("opacity",), numbered("scale", 3 if "scale_2" in present else 2)]
    blocks += [numbered("rot", 4), numbered("f_rest", rest_count)]
    if missing := sorted({name for block in blocks for name in block} - present):
        raise UserError(f"{path} is not a splat .ply file (it has no column {missing[0]!r}): name one.")

    def take(names: tuple[str, ...]) -> Tensor:
        table = np.empty((len(vertex), len(names)), np.float32)
        for column, name in enumerate(names):
            table[:, column] = vertex[name]
        return torch.from_numpy(table)

    means, dc, opacity, scales, quats, rest = (take(block) for block in blocks)
    if _whole(vertex, "opacity"):
        opacity = torch.logit(shares(vertex["opacity"][:, None]))
    if vertex.dtype["rot_0"] == np.uint8:
        quats = (quats - 128.0) / 128.0
    rest = rest.reshape(len(dc), 3, rest_count // 3).transpose(1, 2)
    remarks = []
    if as_rgb:
        dc = (shares(np.stack([vertex[name] for name in colors], axis=1)) - 0.5) / SH_C0
        if not rest_count:
            remarks.append("It has colours as red, green and blue: each Gaussian has one colour from all sides.")
    if degree > MAX_DEGREE:
        remarks.append(f"Its colours have bands up to degree {degree}, of which those above {MAX_DEGREE} are left out.")
    rest = rest[:, : num_sh_bases(MAX_DEGREE) - 1].contiguous()
    ids = torch.from_numpy(np.array(vertex["class_id"], dtype=np.int32)) if "class_id" in present else None
    return SplatFile(Gaussians(means, quats, scales, opacity[:, 0], dc, rest), ids, tuple(remarks))


def _whole(vertex: np.ndarray, name: str) -> bool:
    return vertex.dtype[name].kind in "ui"


def shares(values: np.ndarray) -> Tensor:
    """Return values [N, C] of any type as shares of 1, float32; the range decides, as for colours of seed points."""
    values, most = range_of(values)
    return torch.from_numpy((values / (most or 1.0)).astype(np.float32))


def numbered(prefix: str, count: int) -> tuple[str, ...]:
    """Return the names prefix_0, prefix_1, .."""
    return tuple(f"{prefix}_{i}" for i in range(count))
