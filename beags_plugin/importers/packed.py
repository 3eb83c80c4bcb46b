"""What readers of compressed splat files share."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.sh import MAX_DEGREE, num_sh_bases
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import reason

_DAMAGED = (ValueError, LookupError, TypeError, OverflowError, EOFError, MemoryError, struct.error, zlib.error)
MOST_ZIPPED = 1032  # bytes that one byte of deflate can stand for


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn what a missing or damaged file of a ``kind``, such as ".spz", makes the block raise into a ``UserError``."""
    try:
        yield
    except (*_DAMAGED, OSError, zipfile.BadZipFile, NotImplementedError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # bare ones of libraries are of the content
            raise UserError(f"{path} cannot be read ({reason(error)}): name an existing {kind} file.") from error
        raise UserError(f"{path} is no {kind} file, or damaged ({reason(error)}): get it again.") from error


def tensor(values: np.ndarray) -> Tensor:
    """Return an array as float32."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def gaussians_of(
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, alphas: np.ndarray, dc: np.ndarray, rest: np.ndarray
) -> Gaussians:
    """Return N Gaussians from arrays as in ``core.flattening.Gaussians``, but opacities 0..1; bands above 3 are cut."""
    rest = rest[:, : num_sh_bases(MAX_DEGREE) - 1]
    logits = torch.logit(torch.from_numpy(np.ascontiguousarray(alphas, dtype=np.float64))).float()
    return Gaussians(tensor(means), tensor(quats), tensor(log_scales), logits, tensor(dc), tensor(rest))


def with_largest(three: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] from three components [N, 3] and the place [N] of the fourth, made positive."""
    fourth = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(axis=1)))
    quats = np.empty((len(three), 4))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[place]
    np.put_along_axis(quats, others, three, axis=1)
    np.put_along_axis(quats, place[:, None], fourth[:, None], axis=1)
    return quats


def sh_degree(coefficients: int) -> int:
    """Return the degree of so many coefficients of the higher bands, a colour."""
    return round((1 + coefficients) ** 0.5) - 1


def cut_bands(degree: int) -> tuple[str, ...]:
    """Return a sentence where a file has bands above the highest degree that is held."""
    if degree <= MAX_DEGREE:
        return ()
    return (f"Its colours have bands up to degree {degree}, of which those above {MAX_DEGREE} are left out.",)
