"""Cameras of many views in nerfstudio's terms: checks, resizing, and conversion to the method's cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.system.errors import UserError

PERSPECTIVE, FISHEYE = 1, 2  # nerfstudio's numbers of the two lenses that can be undistorted
CAMERA_TYPES = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), PERSPECTIVE),
    "OPENCV_FISHEYE": FISHEYE, "EQUIRECTANGULAR": 3, "OMNIDIRECTIONALSTEREO_L": 4, "OMNIDIRECTIONALSTEREO_R": 5,
    "VR180_L": 6, "VR180_R": 7, "ORTHOPHOTO": 8, "FISHEYE624": 9,
}  # fmt: skip
"""nerfstudio's number of each camera model that transforms.json may name."""


class AnyCameras(Protocol):
    """Cameras with the fields of ``SceneCameras``: its own or nerfstudio's."""

    camera_to_worlds: Any
    fx: Any
    fy: Any
    cx: Any
    cy: Any
    width: Any
    height: Any
    distortion_params: Any
    camera_type: Any

    def __len__(self) -> int: ...


@dataclass
class SceneCameras:
    """V cameras with the fields of nerfstudio's ``Cameras``, for commands that do not import it.

    camera_to_worlds: [V, 3, 4] float32, OpenGL axes. fx, fy, cx, cy: [V, 1] float32, pixels. width, height: [V, 1]
    int64. distortion_params: [V, 6] float32, k1 k2 k3 k4 p1 p2. camera_type: [V, 1] int64.
    """

    camera_to_worlds: Tensor
    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    width: Tensor
    height: Tensor
    distortion_params: Tensor
    camera_type: Tensor

    def __len__(self) -> int:
        return len(self.camera_to_worlds)

    def chosen(self, index: Tensor) -> SceneCameras:
        """Return copies of the cameras ``index`` [M] int64."""
        parts = {each.name: getattr(self, each.name) for each in fields(self)}
        return SceneCameras(**{name: part[index] for name, part in parts.items()})


def camera_from_nerfstudio(cameras: AnyCameras, index: int = 0) -> Camera:
    """Return the method's camera for one of many, without lens distortion.

    The cameras have any batch shape; ``index`` is into the flattened batch. Float32, on the device of ``cameras``,
    differentiable in the pose.
    """
    pose = cameras.camera_to_worlds.reshape(-1, 3, 4)[index].float()
    fx, fy, cx, cy = (getattr(cameras, name).reshape(-1)[index].float() for name in ("fx", "fy", "cx", "cy"))
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(3, 3)
    width, height = (int(getattr(cameras, name).reshape(-1)[index]) for name in ("width", "height"))
    return Camera(viewmat_from_opengl(pose), K, width, height)


def resize_cameras(cameras: AnyCameras, widths: Tensor, heights: Tensor) -> None:
    """Set the cameras' sizes to ``widths`` x ``heights`` ([N, 1] integer pixels) in place, and scale K to match.

    With pixel centres at + 0.5, resizing from W to W' pixels maps x to x W' / W, so each axis scales its focal length
    and principal point by that factor. nerfstudio's single factor for both axes shifts the image by up to a pixel at
    its far edge.
    """
    x_factor, y_factor = widths / cameras.width, heights / cameras.height
    cameras.fx, cameras.cx = cameras.fx * x_factor, cameras.cx * x_factor
    cameras.fy, cameras.cy = cameras.fy * y_factor, cameras.cy * y_factor
    cameras.width, cameras.height = widths.to(torch.int64), heights.to(torch.int64)


def small_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return a camera whose image of ``size`` (width, height) covers that of ``camera`` from edge to edge.

    K is scaled as in ``resize_cameras``.
    """
    width, height = size
    host = camera.host
    factors = host.K.new_tensor([[width / host.width], [height / host.height], [1.0]])
    return Camera(host.viewmat, host.K * factors, width, height).to(camera.viewmat.device)


def take_intrinsics(cameras: AnyCameras, own: Camera) -> None:
    """Set K and size of a camera of nerfstudio's, [1], in place to those of the method's camera ``own``."""
    K = own.host.K
    for name, value in {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}.items():
        setattr(cameras, name, torch.full_like(getattr(cameras, name), float(value)))
    cameras.width = torch.full_like(cameras.width, own.width)
    cameras.height = torch.full_like(cameras.height, own.height)


def downscaled_size(sizes: Tensor, factor: float) -> Tensor:
    """Return ``sizes``, pixels, divided by ``factor`` and rounded, at least 1."""
    return torch.floor(sizes / factor + 0.5).clamp(min=1).to(torch.int64)


def check_cameras(cameras: SceneCameras, images: Sequence[Path]) -> None:
    """Raise ``UserError`` for a lens that cannot be undistorted and for a pose that is no rotation and translation."""
    rotations = cameras.camera_to_worlds[:, :3, :3].double()
    # Poses are float32 and often printed with 6 digits; a mirrored or scaled one misses by 1 or more.
    error = (rotations @ rotations.transpose(1, 2) - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2))
    rigid = (error < 1e-2) & (torch.linalg.det(rotations) > 0) & cameras.camera_to_worlds.isfinite().all(2).all(1)
    for i, path in enumerate(images):
        if (number := int(cameras.camera_type[i])) not in (PERSPECTIVE, FISHEYE):
            kind = next(name for name, other in CAMERA_TYPES.items() if other == number)
            raise UserError(f"the camera of {path} is of type {kind}: undistort the images to a pinhole camera first.")
        if not rigid[i]:
            raise UserError(f"the pose of {path} is not a rotation and a translation: correct its pose.")
        K = [float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy")]
        if not all(map(math.isfinite, K)) or not min(K[:2]) > 0:
            raise UserError(
                f"the camera of {path} has the focal length {K[0]:g}, {K[1]:g} and the principal point {K[2]:g}, "
                f"{K[3]:g}: correct its poses."
            )
        if min(int(cameras.width[i]), int(cameras.height[i])) < 1:
            raise UserError(f"the camera of {path} has no pixels: correct its width and height.")
    fisheye = cameras.camera_type[:, 0] == FISHEYE
    parameters = cameras.distortion_params
    if not bool(parameters.isfinite().all()):
        index = int((~parameters.isfinite()).any(1).nonzero()[0])
        raise UserError(f"the lens distortion of {images[index]} is no number: correct the poses.")
    if (parameters[~fisheye, 3] != 0).any():
        raise UserError(f"the cameras have k4 != 0, which cannot be undone: undistort {images[0].parent} first.")
    # nerfstudio reads all-zero parameters as "no distortion", but an equidistant fisheye must be undistorted too. A
    # coefficient too small to matter marks it.
    parameters[fisheye & (parameters == 0).all(1), 0] = 1e-12
