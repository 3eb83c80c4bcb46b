"""The camera as the method sees it: OpenCV axes, full K, pixel centres at + 0.5 (method, section 0)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

EXTENT_MARGIN = 1.1  # the scene's extent is 1.1 x the largest distance of a camera from their mean (method, section 1)


@dataclass(frozen=True)
class Camera:
    """One pinhole view.

    viewmat: [4, 4] float, rigid transform from world to camera; x right, y down, z forward (OpenCV).
    K: [3, 3] float, intrinsics in pixels, with any cx, cy. Pixel (i, j), column and row, has its centre at
        (i + 0.5, j + 0.5).
    width, height: pixels.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @property
    def rotation(self) -> Tensor:
        """Return the [3, 3] world-to-camera rotation W."""
        return self.viewmat[:3, :3]

    @property
    def translation(self) -> Tensor:
        """Return the [3] world-to-camera translation t."""
        return self.viewmat[:3, 3]

    @property
    def focal(self) -> float:
        """Return the geometric mean of both focal lengths, pixels; a pixel at depth z covers (z / focal)^2 of area."""
        K = self.host.K
        return (float(K[0, 0]) * float(K[1, 1])) ** 0.5

    @property
    def center(self) -> Tensor:
        """Return the camera's position in the world, [3]."""
        if self.viewmat.requires_grad or not self.viewmat.is_cpu:
            return -self.rotation.T @ self.translation
        # Plain Python arithmetic takes half the time of seven torch operations.
        rows = self.viewmat.tolist()
        return self.viewmat.new_tensor([-sum(rows[k][axis] * rows[k][3] for k in range(3)) for axis in range(3)])

    @property
    def host(self) -> Camera:
        """Return the camera on the CPU that ``to`` made this one from, else this one.

        Its numbers can be read without waiting for a GPU. Cameras are never changed in place.
        """
        return self.__dict__.get("_host", self)

    def to(self, *args) -> Camera:
        """Return the camera with both matrices moved or cast as ``Tensor.to`` does."""
        moved = Camera(self.viewmat.to(*args), self.K.to(*args), self.width, self.height)
        if not moved.viewmat.is_cpu and self.host.viewmat.is_cpu:
            moved.__dict__["_host"] = self.host
        return moved


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera that sees a region of this camera's image: its principal point is shifted.

    left, top: the region's first column and row, pixels. width, height: its size, pixels.
    """
    host = camera.host
    shift = host.K.new_tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    return Camera(host.viewmat, host.K - shift, width, height).to(camera.viewmat.device)


def viewmat_from_opengl(camera_to_world: Tensor) -> Tensor:
    """Convert nerfstudio's camera-to-world matrices (OpenGL axes) to world-to-camera matrices (OpenCV axes).

    This is the only place where the two conventions meet.

    camera_to_world: [..., 3 or 4, 4] float; x right, y up, z backward. Returns [..., 4, 4] of the same dtype; x right,
    y down, z forward.
    """
    rotation = camera_to_world[..., :3, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])
    world_to_camera = rotation.transpose(-1, -2)
    viewmat = torch.zeros(*camera_to_world.shape[:-2], 4, 4, dtype=camera_to_world.dtype, device=camera_to_world.device)
    viewmat[..., :3, :3] = world_to_camera
    viewmat[..., :3, 3:] = -world_to_camera @ camera_to_world[..., :3, 3:]
    viewmat[..., 3, 3] = 1.0
    return viewmat


def camera_extent(camera_to_worlds: Tensor) -> Tensor:
    """Return the scene's extent, [] float32, world units: 1.1 x the largest distance of a camera from their mean.

    camera_to_worlds: [V, 3, 4] float. One camera alone has the extent 1.
    """
    centers = camera_to_worlds[..., :3, 3].float()
    extent = EXTENT_MARGIN * (centers - centers.mean(dim=0)).norm(dim=-1).max()
    return extent if float(extent) > 0 else torch.ones(())
