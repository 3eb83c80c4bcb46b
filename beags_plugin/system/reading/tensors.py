"""Reader of ``torch.save`` files: tensors and plain values only, none larger than the file."""

from __future__ import annotations

import zipfile
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.system.reading.stand_ins import stand_in


def load_tensors(path: Path, mmap: bool = False) -> Any:
    """Read a file of ``torch.save`` to the CPU.

    mmap: leave tensors in the file until they are used. Raises ``FileNotFoundError``, and ``ValueError`` with the
    reason if the file cannot be read, holds other objects, or holds tensors larger than itself.
    """
    try:
        size = path.stat().st_size
        _check_archive(path, size)
        with _numpy_scalars():
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
        _check_sizes(content, size)
        return content
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(error.strerror or "it is cut off") from error
    except Exception as error:  # torch raises many kinds of errors
        words = " ".join(str(error).split())
        message = "it holds more than tensors and plain values" if "Weights only load failed" in words else words[:120]
        raise ValueError(message or type(error).__name__) from error


def _numpy_scalars() -> AbstractContextManager[None]:
    """Let torch load numpy's float scalars too, which nerfstudio's schedulers leave in the state of optimizers."""
    safe = getattr(torch.serialization, "safe_globals", None)  # torch 2.5 and later have it
    scalar = np.float64(0).__reduce__()[0]  # its module differs between numpy 1.x and 2.x
    return nullcontext() if safe is None else safe([scalar, np.dtype, *(type(np.dtype(one)) for one in ("f4", "f8"))])


def _check_archive(path: Path, size: int) -> None:
    """Raise ``ValueError`` for a file that is no archive of ``torch.save``, whose members are never packed."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except zipfile.BadZipFile:
        raise ValueError(stand_in(path) or "it is cut off, or no file of torch.save") from None
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("its members are packed, which torch.save never does")
    if sum(member.file_size for member in members) > size:
        raise ValueError("its members are longer than the file")


def _check_sizes(content: Any, size: int) -> None:
    """Raise ``ValueError`` for tensors larger than the file, such as expanded ones, whose copies would fill memory."""
    waiting, seen = [content], set()
    while waiting:
        value = waiting.pop()
        if isinstance(value, Tensor):
            if value.layout != torch.strided or value.is_meta or value.is_quantized:
                raise ValueError("it holds tensors of an unusual kind")
            if value.numel() * value.element_size() > size:
                raise ValueError("it holds a tensor that is larger than the file")
        elif isinstance(value, (dict, list, tuple, set)) and id(value) not in seen:
            seen.add(id(value))
            waiting += [*value.keys(), *value.values()] if isinstance(value, dict) else value
