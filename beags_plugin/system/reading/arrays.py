"""Reader of .npy files: nothing is unpickled, and no array is larger than the file can fill."""

from __future__ import annotations

import math
import os
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
            _check_header(file, os.fstat(file.fileno()).st_size)
        except ValueError as error:
            raise ValueError(stand_in(path) or str(error)) from None
        file.seek(0)
        return npy.read_array(file, allow_pickle=False)


def _check_header(file: BinaryIO | Any, size: int) -> None:
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
