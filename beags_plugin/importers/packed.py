"""Functions that the readers of compressed splat files share."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.sh import MAX_DEGREE, num_sh_bases
from beags_plugin.importers.activation import THINNEST
from beags_plugin.importers.base import ImportedScene
from beags_plugin.splat_io.far_worlds import FAR
from beags_plugin.splat_io.frames import turned_gaussians
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.stand_ins import stand_in, starts_as
from beags_plugin.system.reading.text import reason

_DAMAGED = (
    ValueError, LookupError, TypeError, AttributeError, OverflowError, EOFError, MemoryError, RuntimeError,
    struct.error, zlib.error, zipfile.BadZipFile, Image.DecompressionBombError,
)  # fmt: skip
"""Errors that damaged files raise, for example by JSON of other types, too deep nesting, or encryption."""
_UNEVEN = 1e-3  # largest deviation of a matrix's axes from equal lengths and right angles
MOST_ZIPPED = 1032  # largest expansion by deflate
Z_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""Rotation from y up to z up."""


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn the errors of a missing or damaged file in the block into a ``UserError``; kind: such as ".spz"."""
    try:
        yield
    except (*_DAMAGED, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # libraries raise others for bad content
            raise UserError(f"{path} cannot be read ({reason(error)}): name an existing {kind} file.") from error
        if (cause := stand_in(path)) is not None:
            raise UserError(f"{path} is no {kind} file ({cause}).") from error
        # A file that starts as its suffix promises is damaged, not misnamed.
        if (cause := starts_as(path)) is not None and path.suffix.lower() not in cause.partition(":")[0]:
            raise UserError(f"{path} is no {kind} file ({cause}).") from error
        raise UserError(f"{path} is no {kind} file, or damaged ({reason(error)}): get it again.") from error


def log_lengths(scales: np.ndarray) -> np.ndarray:
    """Return the logs of scales that are lengths, of which some may be 0."""
    return np.log(np.maximum(scales, THINNEST))


def gaussians_of(
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, alphas: np.ndarray, dc: np.ndarray, rest: np.ndarray
) -> Gaussians:
    """Return N Gaussians from the arrays of ``core.flattening.Gaussians``, with opacities 0..1; bands above 3 are cut.

    Raises ``ValueError`` for arrays of different lengths.
    """

    def single(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

    if len({len(each) for each in (means, quats, log_scales, alphas, dc, rest)}) > 1:
        raise ValueError("its Gaussians have not as many places as rotations, scales, opacities or colours")
    rest = rest[:, : num_sh_bases(MAX_DEGREE) - 1]
    logits = torch.logit(torch.from_numpy(np.ascontiguousarray(alphas, dtype=np.float64))).float()
    return Gaussians(single(means), single(quats), single(log_scales), logits, single(dc), single(rest))


def with_largest(three: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] from three components [N, 3] and the index [N] of the fourth, positive one."""
    fourth = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(axis=1)))
    quats = np.empty((len(three), 4))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[place]
    np.put_along_axis(quats, others, three, axis=1)
    np.put_along_axis(quats, place[:, None], fourth[:, None], axis=1)
    return quats


def sh_degree(coefficients: int) -> int:
    """Return the SH degree of a number of coefficients of the higher bands, for each colour."""
    return round((1 + coefficients) ** 0.5) - 1


def cut_bands(degree: int) -> tuple[str, ...]:
    """Return a sentence for a file with bands above ``MAX_DEGREE``; none for others."""
    if degree <= MAX_DEGREE:
        return ()
    return (f"Its colours have bands up to degree {degree}, of which those above {MAX_DEGREE} are left out.",)


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate parts; bands that a part lacks are 0."""
    width = max(part.sh_rest.shape[1] for part in parts)

    def values(part: Gaussians, name: str) -> Tensor:
        tensor = getattr(part, name)
        if name == "sh_rest":
            return torch.cat([tensor, tensor.new_zeros(len(tensor), width - tensor.shape[1], 3)], dim=1)
        return tensor

    return Gaussians(**{name: torch.cat([values(part, name) for part in parts]) for name in vars(parts[0])})


def moved_by(gaussians: Gaussians, matrix: np.ndarray) -> tuple[Gaussians, Tensor]:
    """Return Gaussians moved by a matrix [4, 4], and their means [N, 3] in float64.

    Raises ``ValueError`` unless the matrix is a rotation, a shift and a uniform scale.
    """
    linear = matrix[:3, :3]
    factor = float(np.cbrt(np.linalg.det(linear)))
    if not factor > 0 or np.abs(linear @ linear.T / factor**2 - np.eye(3)).max() > _UNEVEN:
        raise ValueError("a node stretches or mirrors its Gaussians: apply its transform where the file was made")
    u, _, vt = np.linalg.svd(linear)
    turned = turned_gaussians(gaussians, torch.from_numpy(u @ vt), factor)
    means = factor * (gaussians.means.double() @ torch.from_numpy(u @ vt).T) + torch.from_numpy(matrix[:3, 3].copy())
    return replace(turned, means=means.float()), means


def in_world(
    kind: str, parts: Sequence[tuple[Gaussians, Tensor]], turn: Tensor | None, remarks: tuple[str, ...]
) -> ImportedScene:
    """Return the scene of all parts, results of ``moved_by``, turned by ``turn`` [3, 3] float64."""
    gaussians, means = joined([part for part, _ in parts]), torch.cat([exact for _, exact in parts])
    if turn is not None:
        gaussians, means = turned_gaussians(gaussians, turn), means @ turn.T
    return ImportedScene(kind, gaussians, remarks=remarks, exact_means=_far(means), doubtful_axes=True)


def _far(means: Tensor) -> Tensor | None:
    """Return means [N, 3] float64 if they lie far from 0 relative to their extent; else None."""
    finite = means[means.isfinite().all(dim=1)]
    if not len(finite):
        return None
    middle = finite.median(dim=0).values
    spread = (finite - middle).abs().median()
    return means if float(middle.abs().max()) > FAR * float(spread) else None
