"""Tensors that lie in a file and are read back one at a time, so that any number of them fits into memory."""

from __future__ import annotations

import errno
import os
import tempfile
import weakref
import zipfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import check_members, read_member


class FiledTensors(Sequence[Tensor]):
    """The tensors of a file that ``write_tensors`` wrote, in their order; each access reads the file.

    source: its path, or the file open for reading, which is closed with this object.
    device: where the tensors are put.
    Raises ``OSError`` or ``ValueError`` for a file that is not there or not whole.
    """

    def __init__(self, source: Path | BinaryIO, device: torch.device | str = "cpu") -> None:
        if not isinstance(source, Path):
            weakref.finalize(self, source.close)
        try:
            self._archive = zipfile.ZipFile(source)  # reads the list of members only
            size = source.stat().st_size if isinstance(source, Path) else os.fstat(source.fileno()).st_size
            check_members(self._archive, size)
            self._count = len(self._archive.namelist())
        except (zipfile.BadZipFile, NotImplementedError) as error:
            raise ValueError(f"{source} holds no tensors: {error}") from None
        weakref.finalize(self, self._archive.close)
        self.device = torch.device(device)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int | slice) -> Any:
        """Read one tensor, or for a slice a list."""
        chosen = range(self._count)[index]
        return self._read(chosen) if isinstance(chosen, int) else [self._read(each) for each in chosen]

    def _read(self, index: int) -> Tensor:
        try:
            return torch.from_numpy(read_member(self._archive, self._archive.getinfo(f"{index}.npy"))).to(self.device)
        # zipfile raises these for damaged members, torch for types of numbers that it does not know
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, KeyError, TypeError, EOFError) as error:
            raise ValueError(f"tensor {index} cannot be read: {error}") from None


def write_tensors(file: BinaryIO, tensors: Iterable[Tensor]) -> None:
    """Write tensors one by one, as they come, as an uncompressed .npz whose arrays are named 0, 1, 2, .."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for index, values in enumerate(tensors):
            array = values.detach().cpu().contiguous().numpy()
            with archive.open(f"{index}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def filed(tensors: Iterable[Tensor], device: torch.device | str = "cpu") -> FiledTensors:
    """Move tensors to a temporary file as they come; it is deleted with the last reference to the result.

    Raises ``UserError`` if the folder of temporary files is full.
    """
    file = tempfile.TemporaryFile(prefix="beags-")  # noqa: SIM115  (closed with the result)
    try:
        write_tensors(file, tensors)
        file.flush()
    except OSError as error:
        with suppress(OSError):  # closing writes the rest of the buffer, which fails again
            file.close()
        if error.errno != errno.ENOSPC:
            raise
        folder = tempfile.gettempdir()
        raise UserError(f"{folder} is full: free some space there, or name another folder with TMPDIR.") from None
    file.seek(0)
    return FiledTensors(file, device)
