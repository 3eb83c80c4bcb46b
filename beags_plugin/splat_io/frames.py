"""Change between nerfstudio's normalised frame and the frame of the input data; read the transform of a run."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.rotations import quat_product
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

TRANSFORM_FILE = "dataparser_transforms.json"  # nerfstudio writes the normalisation of the poses here.
_ORTHONORMAL_TOLERANCE = 1e-4  # The matrices passed through JSON as float32.


def read_transform(run: Path) -> tuple[Tensor, float] | None:
    """Read the data parser's transform ([3, 4], scale) of a run; None if the run has no file of it.

    Raises ``UserError`` if the file is damaged.
    """
    path = run / TRANSFORM_FILE
    if not path.exists():
        return None
    try:
        content = load_json(path)
        transform, scale = torch.tensor(content["transform"], dtype=torch.float64), float(content["scale"])
        if transform.shape != (3, 4):
            raise ValueError(f"its transform is {list(transform.shape)}, not [3, 4]")
        if not (bool(transform.isfinite().all()) and 0 < scale < math.inf):
            raise ValueError("it holds NaN or infinity, or a scale that is not above 0")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): restore it.") from error
    return transform, scale


def to_input_frame(surfels: Surfels, transform: Tensor, scale: float) -> Surfels:
    """Undo x' = scale (R x + t): return the same Gaussians in the frame of the input poses.

    Positions become R^T (x' / scale - t), rotations R^T R', scales are divided by ``scale``; the spherical harmonics
    turn along, so that the Gaussians look the same.

    surfels: N Gaussians in the frame of x'. transform: [3, 4] float, R | t; R a rotation. scale: positive.
    Returns N Gaussians of the same dtype and device. Raises ``UserError`` if R is no rotation or scale is not positive.
    """
    rotation, translation = _checked(transform, scale, surfels.means)
    means = (surfels.means.detach().double() / scale - translation) @ rotation  # rows: R^T (x' / scale - t)
    return _turned(surfels, means, rotation.T, 1.0 / scale)


def from_input_frame(surfels: Surfels, transform: Tensor, scale: float) -> Surfels:
    """Return the same Gaussians in the frame of x' = scale (R x + t): undo ``to_input_frame``.

    surfels: N Gaussians in the frame of the input poses; the rest as of ``to_input_frame``.
    """
    rotation, translation = _checked(transform, scale, surfels.means)
    means = scale * (surfels.means.detach().double() @ rotation.T + translation)
    return _turned(surfels, means, rotation, scale)


def _checked(transform: Tensor, scale: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return R [3, 3] and t [3] in float64, on the device of ``like``."""
    matrix = transform.detach().to(device=like.device, dtype=torch.float64)
    if matrix.shape != (3, 4):
        raise ValueError(f"transform must be [3, 4], not {list(matrix.shape)}")
    rotation, translation = matrix[:, :3], matrix[:, 3]
    identity = torch.eye(3, dtype=torch.float64, device=matrix.device)
    if (rotation @ rotation.T - identity).abs().max() > _ORTHONORMAL_TOLERANCE or torch.linalg.det(rotation) < 0:
        raise UserError("the run's dataparser transform is not a rotation and a shift: export without a frame change.")
    if not scale > 0:
        raise UserError(
            f"the run's dataparser scale is {scale}, but it must be positive: export without a frame change."
        )
    return rotation, translation


def _turned(surfels: Surfels, means: Tensor, rotation: Tensor, factor: float) -> Surfels:
    """Return the Gaussians at ``means`` [N, 3] float64, turned by ``rotation`` [3, 3] and ``factor`` times as large."""
    dtype = surfels.means.dtype
    return Surfels.of(
        means=means.to(dtype),
        quats=quat_product(quat_from_rotation(rotation), surfels.quats.detach().double()).to(dtype),
        log_scales=surfels.log_scales.detach() + math.log(factor),
        opacity_logits=surfels.opacity_logits.detach(),
        sh=rotate_sh(surfels.sh.detach(), rotation, surfels.sh_degree),
    )


def turned_gaussians(gaussians: Gaussians, rotation: Tensor, factor: float = 1.0) -> Gaussians:
    """Return Gaussians as files hold them turned by ``rotation`` [3, 3] about the origin and ``factor`` times as large.

    Raises ``UserError`` if the matrix is no rotation.
    """
    transform = torch.cat([rotation.double(), torch.zeros(3, 1, dtype=torch.float64)], dim=1)
    rotation, _ = _checked(transform, factor, gaussians.means)
    means = factor * (gaussians.means.double() @ rotation.T)
    return Gaussians(**vars(_turned(Surfels(**vars(gaussians)), means, rotation, factor)))


def quat_from_rotation(rotation: Tensor) -> Tensor:
    """Return the unit quaternion [4] wxyz of a rotation matrix [3, 3].

    4 q q^T is linear in the matrix, and its column of largest diagonal, normalised, is q: no small divisor occurs.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    outer = rotation.new_tensor(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )  # 4 q q^T
    column = outer[:, int(outer.diagonal().argmax())]
    return column / column.norm()


def rotate_sh(sh: Tensor, rotation: Tensor, degree: int) -> Tensor:
    """Return coefficients of the turned colour function g(r d) = f(d), r = ``rotation``.

    Each band maps to itself linearly; its matrix is the least-squares solution over many directions (exact up to
    rounding, since the turned band lies in the span of the band).

    sh: [N, (degree + 1)^2, 3], band 0 first. rotation: [3, 3] float64. Returns the same shape and dtype.
    """
    turned = sh.clone()
    directions = _sphere(64).to(rotation)
    before = _basis(directions, degree)
    after = _basis(directions @ rotation.T, degree)
    for band in range(1, degree + 1):
        columns = slice(band**2, (band + 1) ** 2)
        # The matrix solves after @ matrix = before at every direction.
        matrix = torch.linalg.lstsq(after[:, columns], before[:, columns]).solution
        turned[:, columns] = torch.einsum("ij,njc->nic", matrix, sh[:, columns].double()).to(sh.dtype)
    return turned


def _sphere(count: int) -> Tensor:
    """Return [count, 3] float64 unit directions, spread evenly on a spiral, so that the fit is well conditioned."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * step / count
    angle = step * (torch.pi * (3 - 5**0.5))
    radius = torch.sqrt(1 - z * z)
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], dim=-1)


def _basis(directions: Tensor, degree: int) -> Tensor:
    """Return the basis functions at unit directions [D, 3], [D, (degree + 1)^2], from the renderer's own colours.

    ``sh_colors`` gives the renderer's order and signs. The factor 0.1 keeps the colour, 0.1 * basis + 0.5, above the
    clamp at 0.
    """
    count, bases = directions.shape[0], (degree + 1) ** 2
    sh = 0.1 * torch.eye(bases, dtype=directions.dtype, device=directions.device)[:, :, None].expand(-1, -1, 3)
    colors = sh_colors(
        sh[:, 0].repeat(count, 1), sh[:, 1:].repeat(count, 1, 1), directions.repeat_interleave(bases, 0),
        torch.zeros_like(directions[0]), degree,
    )  # fmt: skip
    return ((colors[:, 0] - 0.5) / 0.1).reshape(count, bases)
