"""Poses in nerfstudio's normalised world: turned, centred and scaled; far from 0 all of it in double precision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beags_plugin.system.errors import UserError
from beags_plugin.views.orientation import oriented

FAR = 16.0
"""Distance of the cameras' middle from 0, in their greatest distance from it, above which single precision is avoided:
it would lose a millionth of the scene."""
TOO_FAR = 1000.0
"""The same where the world is to stay as it is (``center_method`` none)."""


@dataclass(frozen=True)
class Normalization:
    """Options that turn, centre and scale the world: the data parser's, of these names."""

    orientation_method: Literal["pca", "up", "vertical", "none"]
    center_method: Literal["poses", "focus", "none"]
    auto_scale_poses: bool
    scale_factor: float
    scene_scale: float


@dataclass(frozen=True)
class Placing:
    """x' = scale (R x + t) from the world of the poses' file to the cameras'.

    transform: [3, 4] float64, R | t. original: the same from the world before the file's own ``applied_transform``;
    original_scale: with its ``applied_scale``. origin: [3] float64, a point of the original world amid the cameras,
    if that lies so far from 0 that single precision does not do; else None.
    """

    transform: Tensor
    scale: float
    original: Tensor
    original_scale: float
    origin: Tensor | None

    def points(self, points: np.ndarray, original: bool = False) -> Tensor:
        """Return points [P, 3] float32 of the file's world, or the original one, in the cameras', by way of float64."""
        transform = self.original if original else self.transform
        scale = self.original_scale if original else self.scale
        return (scale * (torch.from_numpy(points).double() @ transform[:, :3].T + transform[:, 3])).float()


def place(
    camera_to_world: np.ndarray,
    normalization: Normalization,
    file: Path,
    orientation: str | None = None,
    applied: np.ndarray | None = None,
    applied_scale: float = 1.0,
) -> tuple[Tensor, Placing]:
    """Normalise poses as nerfstudio's parsers do, and return them, [V, 3, 4] float32, with how they were moved.

    camera_to_world: [V, 3, 4] float64, OpenGL axes. file: of the poses, for messages. orientation: the file's own
    method. applied, applied_scale: [3, 4] and a factor by which the file's world was made of the original one.
    Raises ``UserError`` for poses that are all of one place, or turned to no side.
    """
    given = torch.eye(4, dtype=torch.float64).repeat(len(camera_to_world), 1, 1)
    given[:, :3] = torch.from_numpy(camera_to_world)
    centers = given[:, :3, 3]
    middle = centers.mean(0)
    spread = float((centers - middle).abs().max()) or 1.0
    keep = normalization.center_method == "none"
    far = float(middle.abs().max()) > (TOO_FAR if keep else FAR) * spread
    origin = middle if far else torch.zeros(3, dtype=torch.float64)
    near = given.clone()
    near[:, :3, 3] -= origin
    try:
        method = orientation or normalization.orientation_method
        poses, transform = oriented(near.float(), method, normalization.center_method)
    except ValueError as error:
        raise UserError(
            f"{file} asks for the orientation {orientation!r}, which is none of pca, up, vertical and none: correct "
            "its orientation_override."
        ) from error
    matrix = transform.double()
    applied_matrix = None if applied is None else torch.from_numpy(np.asarray(applied, np.float64)[:3])
    shifted = applied_matrix is not None and float(applied_matrix[:, 3].abs().max()) > FAR * spread
    if far or shifted:
        matrix = _rigid(matrix)
        poses = (matrix @ near).float()
        if far:
            matrix = torch.cat([matrix[:, :3], (matrix[:, 3] - matrix[:, :3] @ origin)[:, None]], dim=1)
    scale = 1.0
    if normalization.auto_scale_poses:
        reach = float(poses[:, :3, 3].abs().max())
        if reach == 0.0:
            raise UserError(f"the poses in {file} are all of one place: give photos from several places.")
        scale /= reach
    scale *= normalization.scale_factor
    poses = poses[:, :3].contiguous()
    poses[:, :, 3] *= scale
    original = matrix
    if applied_matrix is not None:
        below = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
        original = matrix @ torch.cat([applied_matrix, below])
        if not (far or shifted):
            original = original.float().double()  # nerfstudio saves it so
    amid = None
    if far:
        amid = origin
        if applied_matrix is not None:
            amid = torch.linalg.lstsq(applied_matrix[:, :3], (origin - applied_matrix[:, 3])[:, None]).solution[:, 0]
    return poses, Placing(matrix, scale, original, scale * applied_scale, amid)


def _rigid(matrix: Tensor) -> Tensor:
    """Return R | t with R the nearest exact rotation: in map coordinates an error of 1e-7 is half a metre."""
    left, _, right = torch.linalg.svd(matrix[:, :3])
    rotation = left @ right
    return torch.cat([rotation, (rotation @ matrix[:, :3].T @ matrix[:, 3])[:, None]], dim=1)


def far_note(placing: Placing, kept: bool) -> str | None:
    """Return a sentence about a world far from 0; None for another. kept: the user asked for no centring."""
    if placing.origin is None:
        return None
    place_ = ", ".join(f"{value:.0f}" for value in placing.origin.tolist())
    return (
        f"The cameras are about {place_}, as map coordinates are, where single precision is too coarse: the scene is "
        f"moved to a local origin{', although center_method is none' if kept else ''}, and exports go back in double "
        "precision."
    )
