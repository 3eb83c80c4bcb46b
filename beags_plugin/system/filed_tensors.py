"""Tensors that lie in a file and are read back one at a time, so that any number of them fits into memory."""

from __future__ import annotations

import errno
import tempfile
import weakref
from collections.abc import Iterable, Sequence
from contextlib import suppress
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from beags_plugin.system.errors import UserError


class FiledTensors(Sequence[Tensor]):
    """Tensors in an open file, which is closed with this object; each access reads the file.

    starts: the place of each tensor in the file, as ``write_tensors`` returns them. device: where they are put.
    """

    def __init__(self, file: BinaryIO, starts: Sequence[int], device: torch.device | str = "cpu") -> None:
        weakref.finalize(self, file.close)
        self._file, self._starts, self._lock = file, starts, Lock()
        self.device = torch.device(device)

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, index: int | slice) -> Any:
        """Read one tensor, or for a slice a list."""
        chosen = self._starts[index]
        return self._read(chosen) if isinstance(chosen, int) else [self._read(each) for each in chosen]

    def _read(self, start: int) -> Tensor:
        with self._lock:
            self._file.seek(start)
            array = np.lib.format.read_array(self._file, allow_pickle=False)
        return torch.from_numpy(array).to(self.device)


def write_tensors(file: BinaryIO, tensors: Iterable[Tensor]) -> list[int]:
    """Write tensors one by one, as they come; return where each begins."""
    starts = []
    for values in tensors:
        starts.append(file.tell())
        np.lib.format.write_array(file, values.detach().cpu().contiguous().numpy(), allow_pickle=False)
    return starts


def filed(tensors: Iterable[Tensor], device: torch.device | str = "cpu") -> FiledTensors:
    """Move tensors to a temporary file as they come; it is deleted with the last reference to the result.

    Raises ``UserError`` if the folder of temporary files is full.
    """
    file = tempfile.TemporaryFile(prefix="beags-")  # noqa: SIM115  (closed with the result)
    try:
        starts = write_tensors(file, tensors)
        file.flush()
    except OSError as error:
        with suppress(OSError):  # closing writes the rest of the buffer, which fails again
            file.close()
        if error.errno != errno.ENOSPC:
            raise
        folder = tempfile.gettempdir()
        raise UserError(f"{folder} is full: free some space there, or name another folder with TMPDIR.") from None
    return FiledTensors(file, starts, device)
