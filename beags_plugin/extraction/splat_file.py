"""Reading splat .ply files of anyone: flat Gaussians or with volume, checked before anything of their size is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices
from beags_plugin.system.reading.text import reason


@dataclass(frozen=True)
class SplatFile:
    """Content of a .ply: N Gaussians with two or three scales, in float32, and class_ids [N] int32 if it has them."""

    gaussians: Gaussians
    class_ids: Tensor | None


def read_splat_file(path: str | Path) -> SplatFile:
    """Read the vertices of a splat .ply in the layout of 3DGS or 2DGS, binary or text.

    Columns: x y z, f_dc_0..2, f_rest_* channel-major, opacity (logit), scale_0..1 or 0..2 (logs), rot_0..3 (wxyz),
    class_id if there. Values are as they are, finite or not. Raises ``UserError`` if the file cannot be read, is no
    splat .ply, or is shorter than its header says.
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
    scale_count = 3 if "scale_2" in present else 2
    if rest_count not in (0, 9, 24, 45):
        raise UserError(
            f"{path} has {rest_count} f_rest columns, but 0, 9, 24 or 45 make whole colour bands: export it again."
        )
    blocks = [("x", "y", "z"), numbered("f_dc", 3), ("opacity",), numbered("scale", scale_count)]
    blocks += [numbered("rot", 4), numbered("f_rest", rest_count)]
    if missing := sorted({name for block in blocks for name in block} - present):
        raise UserError(f"{path} is not a splat .ply file (it has no column {missing[0]!r}): name one.")

    def take(names: tuple[str, ...]) -> Tensor:
        table = np.empty((len(vertex), len(names)), np.float32)
        for column, name in enumerate(names):
            table[:, column] = vertex[name]
        return torch.from_numpy(table)

    means, dc, opacity, scales, quats, rest = (take(block) for block in blocks)
    rest = rest.reshape(len(dc), 3, rest_count // 3).transpose(1, 2).contiguous()
    ids = torch.from_numpy(np.array(vertex["class_id"], dtype=np.int32)) if "class_id" in present else None
    return SplatFile(Gaussians(means, quats, scales, opacity[:, 0], dc, rest), ids)


def numbered(prefix: str, count: int) -> tuple[str, ...]:
    """Return the names prefix_0, prefix_1, .."""
    return tuple(f"{prefix}_{i}" for i in range(count))
