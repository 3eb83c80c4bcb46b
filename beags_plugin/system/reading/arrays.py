"""Readers of .npy and .npz files: nothing is unpickled, and no array may be larger than the file can fill."""

from __future__ import annotations

import math
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from beags_plugin.system.reading.stand_ins import stand_in


def load_array(path: Path) -> np.ndarray:
    """Read the array of numbers (or plain values) in a .npy file.

    Raises ``OSError`` if the file cannot be read, ``ValueError`` with the reason if it holds no array, or objects, or
    is shorter than its header says.
    """
    with open(path, "rb") as file:
        try:
            check_header(file, os.fstat(file.fileno()).st_size)
        except ValueError as error:
            raise ValueError(stand_in(path) or str(error)) from None
        file.seek(0)
        return npy.read_array(file, allow_pickle=False)


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays in a .npz file by name; raises as ``load_array``."""
    try:
        with zipfile.ZipFile(path) as archive:
            check_members(archive, path.stat().st_size)
            members = archive.infolist()
            return {member.filename.removesuffix(".npy"): read_member(archive, member) for member in members}
    # zipfile and zlib raise these for archives that are damaged, have passwords or need what Python lacks
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OverflowError, zlib.error) as error:
        raise ValueError(stand_in(path) or str(error) or type(error).__name__) from None


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read an array of an archive, if the member can hold it; raises like zipfile and ``load_array``."""
    with archive.open(member) as file:
        check_header(file, member.file_size)
    with archive.open(member) as file:
        return npy.read_array(file, allow_pickle=False)


def check_header(file: BinaryIO | Any, size: int) -> None:
    """Raise ``ValueError`` unless ``file`` begins with the header of an array that fits into its ``size`` bytes.

    file: read from its start to the end of the header.
    """
    try:
        version = npy.read_magic(file)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"its format {version} is unknown")
        shape, _, dtype = header(file)
    except Exception as error:  # the header is a Python literal, for which numpy raises many kinds of errors
        raise ValueError(f"its header is damaged ({type(error).__name__})") from None
    if dtype.hasobject:
        raise ValueError("it holds objects, which are not loaded, since they may run code")
    if not all(0 <= length < 1 << 62 for length in shape):
        raise ValueError(f"its shape is {list(shape)}")
    promised = math.prod(shape) * max(dtype.itemsize, 1)  # Python's integers do not overflow
    if promised > size - file.tell():
        raise ValueError(f"it is cut off: its header promises {promised} bytes, but {size - file.tell()} follow")


def check_members(archive: zipfile.ZipFile, size: int) -> None:
    """Raise ``ValueError`` if the stored members of an archive are longer than its file of ``size`` bytes."""
    stored = sum(m.file_size for m in archive.infolist() if m.compress_type == zipfile.ZIP_STORED)
    if stored > size:
        raise ValueError("its members are longer than the file")
