"""Reading splat .ply files of anyone: flat Gaussians or with volume, checked before anything of their size is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import reason

_HEADER_BYTES = 1 << 20  # a header is longer than this in no file that is one
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


@dataclass(frozen=True)
class SplatFile:
    """What a .ply holds: N Gaussians with two or three scales, in float32, and class_ids [N] int32 if it has them."""

    gaussians: Gaussians
    class_ids: Tensor | None


def read_splat_file(path: str | Path) -> SplatFile:
    """Read the vertices of a splat .ply in the layout of 3DGS or 2DGS, binary or text.

    Columns: x y z, f_dc_0..2, f_rest_* channel-major, opacity (logit), scale_0..1 or 0..2 (logs), rot_0..3 (wxyz),
    class_id if there. Values are as they are, finite or not. Raises ``UserError`` if the file cannot be read, is no
    splat .ply, or is shorter than its header says.
    """
    from plyfile import PlyData, PlyParseError

    path = Path(path)
    try:
        check_ply_size(path)
        vertex = PlyData.read(str(path))["vertex"]
        lists = [prop.name for prop in vertex.properties if hasattr(prop, "len_dtype")]
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name an existing .ply file.") from error
    except (PlyParseError, KeyError, ValueError, TypeError, MemoryError, OverflowError, RecursionError) as error:
        raise UserError(f"{path} is not a splat .ply file ({reason(error)}): name one.") from error
    present = {prop.name for prop in vertex.properties} - set(lists)
    rest_count = sum(name.startswith("f_rest_") for name in present)
    scale_count = 3 if "scale_2" in present else 2
    if rest_count not in (0, 9, 24, 45):
        raise UserError(
            f"{path} has {rest_count} f_rest columns, but 0, 9, 24 or 45 make whole colour bands: export it again."
        )
    blocks = [("x", "y", "z"), _numbered("f_dc", 3), ("opacity",), _numbered("scale", scale_count)]
    blocks += [_numbered("rot", 4), _numbered("f_rest", rest_count)]
    if missing := sorted({name for block in blocks for name in block} - present):
        raise UserError(f"{path} is not a splat .ply file (it has no column {missing[0]!r}): name one.")

    def take(names: tuple[str, ...]) -> Tensor:
        table = np.empty((vertex.count, len(names)), np.float32)
        for column, name in enumerate(names):
            table[:, column] = vertex[name]
        return torch.from_numpy(table)

    means, dc, opacity, scales, quats, rest = (take(block) for block in blocks)
    rest = rest.reshape(len(dc), 3, rest_count // 3).transpose(1, 2).contiguous()
    ids = torch.from_numpy(np.array(vertex["class_id"], dtype=np.int32)) if "class_id" in present else None
    return SplatFile(Gaussians(means, quats, scales, opacity[:, 0], dc, rest), ids)


def check_ply_size(path: Path) -> None:
    """Raise ``UserError`` if what the header promises does not fit into the file; a wrong header is a ValueError."""
    with open(path, "rb") as file:
        head = file.read(_HEADER_BYTES)
    header, mark, _ = head.partition(b"end_header")
    if not head.startswith(b"ply") or not mark:
        raise ValueError("it does not start with a .ply header")
    binary, promised, count = True, 0, 0
    for line in header.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            binary = "ascii" not in words
        elif words[:1] == ["element"] and len(words) == 3:
            count = int(words[2])
            if count < 0:
                raise ValueError(f"it promises {count} {words[1]} elements")
        elif words[:1] == ["property"] and len(words) >= 3:
            # of a list at least its length is there; in text, a digit and what parts it from the next
            kind = words[2] if words[1] == "list" else words[1]
            promised += count * (_SIZES.get(kind, 1) if binary else 2)
    rest = path.stat().st_size - len(header) - len(mark) - 1  # the line feed after the header
    if promised > rest + (0 if binary else 1):  # text may end without a line feed
        raise UserError(
            f"{path} is cut off or damaged: its header promises {promised} bytes, but {rest} follow: get it again."
        )


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{i}" for i in range(count))
