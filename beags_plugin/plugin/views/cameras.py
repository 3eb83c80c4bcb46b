"""nerfstudio's cameras: checked, joined, resized with fixed pixel centres, and converted to the method's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.system.errors import UserError


def camera_from_nerfstudio(cameras: Cameras, index: int = 0) -> Camera:
    """Return the method's camera for one of nerfstudio's (any batch shape, ``index`` into the flattened batch).

    Float32, on the device of ``cameras``, differentiable in the pose; without lens distortion.
    """
    pose = cameras.camera_to_worlds.reshape(-1, 3, 4)[index].float()
    fx, fy, cx, cy = (getattr(cameras, name).reshape(-1)[index].float() for name in ("fx", "fy", "cx", "cy"))
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(3, 3)
    width, height = (int(getattr(cameras, name).reshape(-1)[index]) for name in ("width", "height"))
    return Camera(viewmat_from_opengl(pose), K, width, height)


def resize_cameras(cameras: Cameras, widths: Tensor, heights: Tensor) -> None:
    """Set the cameras' sizes to ``widths`` x ``heights`` ([N, 1] integer pixels) in place and scale K to match.

    An image resized from W to W' pixels maps x to x W' / W in coordinates whose pixel centres are at + 0.5, so focal
    length and principal point take exactly that factor, each axis its own. (nerfstudio's one factor shifts the image
    by up to a pixel at its far edge.)
    """
    x_factor, y_factor = widths / cameras.width, heights / cameras.height
    cameras.fx, cameras.cx = cameras.fx * x_factor, cameras.cx * x_factor
    cameras.fy, cameras.cy = cameras.fy * y_factor, cameras.cy * y_factor
    cameras.width, cameras.height = widths.to(torch.int64), heights.to(torch.int64)


def take_intrinsics(cameras: Cameras, own: Camera) -> None:
    """Give one camera of nerfstudio's, [1], the K and size of one of the method's, in place."""
    K = own.host.K
    for name, value in {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}.items():
        setattr(cameras, name, torch.full_like(getattr(cameras, name), float(value)))
    cameras.width = torch.full_like(cameras.width, own.width)
    cameras.height = torch.full_like(cameras.height, own.height)


def downscaled_size(sizes: Tensor, factor: float) -> Tensor:
    """Divide ``sizes``, pixels, by ``factor``: rounded, at least 1."""
    return torch.floor(sizes / factor + 0.5).clamp(min=1).to(torch.int64)


def check_cameras(cameras: Cameras, images: Sequence[Path]) -> None:
    """Raise ``UserError`` for a lens that cannot be undistorted and for a pose that is no rotation and translation."""
    supported = (CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value)
    rotations = cameras.camera_to_worlds[:, :3, :3].double()
    # Poses are float32 and often printed with 6 digits; a mirrored or scaled one misses by 1 or more.
    error = (rotations @ rotations.transpose(1, 2) - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2))
    rigid = (error < 1e-2) & (torch.linalg.det(rotations) > 0) & cameras.camera_to_worlds.isfinite().all(2).all(1)
    for i, path in enumerate(images):
        if int(cameras.camera_type[i]) not in supported:
            kind = CameraType(int(cameras.camera_type[i])).name
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
    fisheye = cameras.camera_type[:, 0] == CameraType.FISHEYE.value
    parameters = cameras.distortion_params
    assert parameters is not None  # both of nerfstudio's parsers give them, zeros for no distortion
    if not bool(parameters.isfinite().all()):
        index = int((~parameters.isfinite()).any(1).nonzero()[0])
        raise UserError(f"the lens distortion of {images[index]} is no number: correct the poses.")
    if (parameters[~fisheye, 3] != 0).any():
        raise UserError(f"the cameras have k4 != 0, which cannot be undone: undistort {images[0].parent} first.")
    # nerfstudio takes all-zero parameters for "no distortion", which is wrong for an equidistant fisheye: it has to be
    # undistorted too, so a coefficient too small to matter marks it.
    parameters[fisheye & (parameters == 0).all(1), 0] = 1e-12
