"""Cameras on a circle around an object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project
from beags_plugin.rasterizers.interface import RasterSettings

_FIELD_OF_VIEW = math.radians(35.0)
_MARGIN = 1.06  # factor on the box in the widest picture of the turn, as discs reach beyond the box
_STEP = 5  # degrees between candidate sides
_FACING = 60.0  # most degrees about the up axis between a side and a photo that shows it
_STEEP = 0.34  # share of its way that a camera is beside the object, below which it is 70 degrees above or below
_NEAR, _FAR = 0.02, 100.0  # depth range, in distances to the centre


@dataclass(frozen=True)
class OrbitFrame:
    """The place of an object, in the frame of its Gaussians.

    center: [3] float64, at which every camera looks. up: [3] float64, unit. front: [3] float64, direction towards the
    photos' cameras, any length. corners: [8, 3] float64, corners of the box that the pictures hold.
    """

    center: Tensor
    up: Tensor
    front: Tensor
    corners: Tensor

    @property
    def reach(self) -> float:
        """Return the radius of the ball around the box; 1 for an empty one."""
        return float((self.corners - self.center).norm(dim=1).max()) or 1.0

    @property
    def distance(self) -> float:
        """Return the distance of cameras from the centre at which that ball fills the field of view."""
        return self.reach / math.sin(_FIELD_OF_VIEW / 2)


def orbit_frame(low: Tensor, high: Tensor, cameras: Sequence[Camera] = ()) -> OrbitFrame:
    """Return the place of a box; up is the mean of the cameras' up axes, front their mean direction.

    low, high: [3] corners. cameras: the photos' cameras. Without any, z is up and -y the front, as in nerfstudio's
    frame.
    """
    center = (low + high).double() / 2
    front = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    upwards = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if cameras:
        ups = -torch.stack([camera.rotation[1] for camera in cameras]).double().mean(dim=0)  # y of a camera is down
        if float(ups.norm()) > 1e-3:  # cameras upside down and upright cancel out
            upwards = ups
        front = torch.stack([camera.center for camera in cameras]).double().mean(dim=0) - center

    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1).double())
    return OrbitFrame(center, upwards / upwards.norm(), front, corners)


def orbit(stand: OrbitFrame, count: int, pixels: int, elevation: float = 20.0, turn: float = 360.0) -> list[Camera]:
    """Return cameras at even angles on a circle about the up axis; the box fills the widest picture.

    count: number of cameras; the first looks from the front. pixels: side of the square pictures. elevation: degrees
    above the horizon. turn: degrees; 360 is a whole turn, less swings to and fro about the front. The cameras are
    float32.
    """
    cameras = []
    for index in range(count):
        share = index / count
        azimuth = turn * share if turn >= 360.0 else 0.5 * turn * math.sin(2 * math.pi * share)
        cameras.append(_look_at(stand.center + stand.distance * side(stand, azimuth, elevation), stand, pixels))
    reach = max(_reach(camera, stand.corners) for camera in cameras)
    return [_zoomed(camera, 1.0 / (_MARGIN * max(reach, 1e-3))) for camera in cameras]


def side(stand: OrbitFrame, azimuth: float, elevation: float) -> Tensor:
    """Return the direction from the centre to a side of the object, [3] float64, unit.

    azimuth: degrees about the up axis, 0 at the front. elevation: degrees above the horizon.
    """
    right, forward = _horizon(stand)
    angle, height = math.radians(azimuth), math.radians(elevation)
    level = math.sin(angle) * right - math.cos(angle) * forward
    return math.cos(height) * level + math.sin(height) * stand.up


def least_shown(stand: OrbitFrame, cameras: Sequence[Camera], elevation: float) -> float:
    """Return the azimuth, whole degrees, of the side that is farthest from all cameras that see the centre.

    cameras: the photos' cameras. Without any that has the centre in its picture, the azimuth is 180.
    """
    showing = [camera for camera in cameras if shows(camera, stand.center)]
    if not showing:
        return 180.0
    aways = torch.stack([camera.center for camera in showing]).double() - stand.center
    sides = torch.stack([side(stand, azimuth, elevation) for azimuth in range(0, 360, _STEP)])
    nearest = (sides @ torch.nn.functional.normalize(aways, dim=1).T).amax(dim=1)
    return float(_STEP * int(nearest.argmin()))


def unshown(stand: OrbitFrame, cameras: Sequence[Camera]) -> int:
    """Return how many of the 360 degrees about the up axis are farther than 60 degrees from all photos.

    cameras: the photos' cameras. One that looks steeply down or up shows all sides. 0 if none has the centre in its
    picture, as then no side is better known than another.
    """
    showing = [camera for camera in cameras if shows(camera, stand.center)]
    if not showing:
        return 0
    aways = torch.stack([camera.center for camera in showing]).double() - stand.center
    level = aways - (aways @ stand.up)[:, None] * stand.up
    if bool((level.norm(dim=1) < _STEEP * aways.norm(dim=1)).any()):
        return 0
    sides = torch.stack([side(stand, azimuth, 0.0) for azimuth in range(0, 360, _STEP)])
    nearest = (sides @ torch.nn.functional.normalize(level, dim=1).T).amax(dim=1)
    return _STEP * int((nearest < math.cos(math.radians(_FACING))).sum())


def view_from(stand: OrbitFrame, away: Tensor, pixels: int, room: float = 1.0) -> Camera:
    """Return a square view of the centre from the side ``away`` [3]; the box fills ``1 / room`` of it."""
    camera = _look_at(stand.center + stand.distance * away, stand, pixels)
    return _zoomed(camera, 1.0 / (room * _MARGIN * max(_reach(camera, stand.corners), 1e-3)))


def orbit_settings(stand: OrbitFrame) -> RasterSettings:
    """Return settings for the orbit's cameras: their depth range, colours only."""
    return RasterSettings(_NEAR * stand.distance, _FAR * stand.distance, geometry=False, distortion=False)


def shows(camera: Camera, point: Tensor) -> bool:
    """Return whether a point [3] lies in a camera's picture."""
    xy, z = project(point[None], camera)
    (x, y), inside = xy[0].tolist(), float(z[0]) > 0
    return inside and 0 <= x < camera.width and 0 <= y < camera.height


def _reach(camera: Camera, points: Tensor) -> float:
    """Return the largest distance of points [P, 3] from the middle of a square picture; 1 is the border."""
    xy, _ = project(points, camera)
    half = 0.5 * camera.width
    return float((xy - half).abs().max()) / half


def _zoomed(camera: Camera, factor: float) -> Camera:
    K = camera.K.clone()
    K[0, 0], K[1, 1] = factor * K[0, 0], factor * K[1, 1]
    return replace(camera, K=K)


def _horizon(stand: OrbitFrame) -> tuple[Tensor, Tensor]:
    """Return two horizontal unit vectors: to the right as seen from the front, and from the front to the object."""
    level = stand.front - (stand.front @ stand.up) * stand.up
    if float(level.norm()) < 1e-6 * max(float(stand.front.norm()), 1e-12):  # the front is straight above
        axis = torch.zeros(3, dtype=torch.float64)
        axis[int(stand.up.abs().argmin())] = 1.0
        level = axis - (axis @ stand.up) * stand.up
    forward = -level / level.norm()
    return torch.linalg.cross(forward, stand.up), forward


def _look_at(eye: Tensor, stand: OrbitFrame, pixels: int) -> Camera:
    """Return a square view of the centre from ``eye`` with the up axis upwards."""
    forward = (stand.center - eye) / (stand.center - eye).norm()
    right = torch.linalg.cross(forward, stand.up)
    if float(right.norm()) < 1e-9:  # the eye is straight above: any side may be up
        right = _horizon(stand)[0]
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])  # OpenCV: x right, y down, z forward
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    focal = 0.5 * pixels / math.tan(_FIELD_OF_VIEW / 2)
    K = torch.tensor([[focal, 0.0, 0.5 * pixels], [0.0, focal, 0.5 * pixels], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, pixels, pixels)
