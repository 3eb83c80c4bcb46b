"""Poses in nerfstudio's normalised world: turned, centred and scaled, in double precision if they lie far from 0."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.system.errors import UserError
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.orientation import oriented

FAR = 16.0
"""Distance of the cameras' middle from 0, over their greatest distance from it, above which single precision is
avoided, as its error would be a millionth of the scene."""
TOO_FAR = 1000.0
"""The same if the world is not to be centred (``center_method`` none)."""


@dataclass(frozen=True)
class Placing:
    """The map x' = scale (R x + t) from the world of the poses' file to that of the cameras.

    transform: [3, 4] float64, R | t. original: the same from the world before the file's own ``applied_transform``.
    original_scale: with its ``applied_scale``. origin: [3] float64, a point of the original world amid the cameras if
    that lies too far from 0 for single precision, else None.
    """

    transform: Tensor
    scale: float
    original: Tensor
    original_scale: float
    origin: Tensor | None

    def points(self, points: np.ndarray, original: bool = False) -> Tensor:
        """Return points [P, 3] of the file's world, or the original one, in the cameras' world, [P, 3] float32."""
        transform = self.original if original else self.transform
        scale = self.original_scale if original else self.scale
        return (scale * (torch.from_numpy(points).double() @ transform[:, :3].T + transform[:, 3])).float()


def place(
    camera_to_world: np.ndarray,
    options: DataOptions,
    file: Path,
    orientation: str | None = None,
    applied: np.ndarray | None = None,
    applied_scale: float = 1.0,
) -> tuple[Tensor, Placing]:
    """Normalise poses as nerfstudio's parsers do; return them, [V, 3, 4] float32, and the map that moved them.

    camera_to_world: [V, 3, 4] float64, OpenGL axes. file: of the poses, for messages. orientation: the file's own
    method. applied, applied_scale: [3, 4] and the factor with which the file's world was made from the original one.
    Raises ``UserError`` for poses that all share one place, and for an unknown orientation.
    """
    given = torch.eye(4, dtype=torch.float64).repeat(len(camera_to_world), 1, 1)
    given[:, :3] = torch.from_numpy(camera_to_world)
    centers = given[:, :3, 3]
    middle = centers.mean(0)
    spread = float((centers - middle).abs().max()) or 1.0
    keep = options.center_method == "none"
    far = float(middle.abs().max()) > (TOO_FAR if keep else FAR) * spread
    origin = middle if far else torch.zeros(3, dtype=torch.float64)
    near = given.clone()
    near[:, :3, 3] -= origin
    try:
        method = orientation or options.orientation_method
        poses, transform = oriented(near.float(), method, centred=not keep)
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
    if options.auto_scale_poses:
        reach = float(poses[:, :3, 3].abs().max())
        if reach == 0.0:
            raise UserError(f"the poses in {file} all share one place: give photos from several places.")
        scale /= reach
    scale *= options.scale_factor
    poses = poses[:, :3].contiguous()
    poses[:, :, 3] *= scale
    original = matrix
    if applied_matrix is not None:
        below = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
        original = matrix @ torch.cat([applied_matrix, below])
        if not (far or shifted):
            original = original.float().double()  # nerfstudio saves it in single precision
    amid = None
    if far:
        amid = origin
        if applied_matrix is not None:
            amid = torch.linalg.lstsq(applied_matrix[:, :3], (origin - applied_matrix[:, 3])[:, None]).solution[:, 0]
    return poses, Placing(matrix, scale, original, scale * applied_scale, amid)


def _rigid(matrix: Tensor) -> Tensor:
    """Return R | t with the nearest exact rotation R: in map coordinates an error of 1e-7 is half a metre."""
    left, _, right = torch.linalg.svd(matrix[:, :3])
    rotation = left @ right
    return torch.cat([rotation, (rotation @ matrix[:, :3].T @ matrix[:, 3])[:, None]], dim=1)


def far_note(placing: Placing, kept: bool) -> str | None:
    """Return a sentence on a world far from 0, else None. kept: whether the user asked for no centring."""
    if placing.origin is None:
        return None
    place_ = ", ".join(f"{value:.0f}" for value in placing.origin.tolist())
    return (
        f"The cameras are about {place_}, as map coordinates are, where single precision is too coarse: the scene is "
        f"moved to a local origin{', although center_method is none' if kept else ''}, and exports go back in double "
        "precision."
    )
