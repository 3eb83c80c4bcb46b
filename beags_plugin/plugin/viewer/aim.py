"""Cameras of a viewer's page: the first one, and those that look at an object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.pictures.orbit import OrbitFrame, orbit_frame
from beags_plugin.surfaces.frames import bounding_box

if TYPE_CHECKING:
    from viser import ClientHandle

WORLD = 10.0  # Viser's units in one of nerfstudio's: VISER_NERFSTUDIO_SCALE_RATIO, whose module is slow to import.
_MARGIN = 1.1  # Gaussians reach beyond the box of their centres.


def frame_of(surfels: Surfels, members: Membership, class_ids: Sequence[int], cameras: Sequence[Camera]) -> OrbitFrame:
    """Return the frame of the box around the Gaussians of these classes; each must have some."""
    boxes = [bounding_box(surfels[members.of(class_id)]) for class_id in class_ids]
    low, high = torch.stack([box[0] for box in boxes]), torch.stack([box[1] for box in boxes])
    return orbit_frame(low.amin(dim=0), high.amax(dim=0), cameras)


def side_of_photos(frame: OrbitFrame, cameras: Sequence[Camera]) -> Tensor:
    """Return [3] from the frame's centre to the training camera that looks at it most directly."""
    aways = torch.stack([camera.center.double() for camera in cameras]) - frame.center
    forwards = torch.stack([camera.rotation[2].double() for camera in cameras])
    return aways[int((-forwards * torch.nn.functional.normalize(aways, dim=1)).sum(dim=1).argmax())]


def place(frame: OrbitFrame, away: Tensor, fov: float, aspect: float) -> Tensor:
    """Return [3], the position in direction ``away`` from which a camera sees all of the frame's box.

    fov: vertical, radians. aspect: width over height.
    """
    half = math.atan(math.tan(fov / 2) * min(1.0, aspect))
    distance = _MARGIN * frame.reach / math.sin(half)
    return frame.center + distance * torch.nn.functional.normalize(away.double(), dim=0)


def look(client: ClientHandle, frame: OrbitFrame, away: Tensor | None = None) -> None:
    """Turn a page's camera to the frame; away: direction [3] of the new position, the present one if None."""
    camera = client.camera
    if away is None:
        away = torch.from_numpy(camera.position / WORLD).double() - frame.center
    with client.atomic():
        camera.up_direction = frame.up.numpy()
        camera.position = WORLD * place(frame, away, camera.fov, camera.aspect).numpy()
        camera.look_at = WORLD * frame.center.numpy()


def look_as(client: ClientHandle, cameras: Sequence[Camera]) -> None:
    """Turn a page's camera to what the training cameras look at, from where the first of them stands."""
    centers = torch.stack([camera.center.double() for camera in cameras])
    forwards = torch.stack([camera.rotation[2].double() for camera in cameras])
    # Projections [V, 3, 3] onto the planes at right angles to the views.
    aside = torch.eye(3, dtype=torch.float64) - forwards[:, :, None] * forwards[:, None, :]
    middle = torch.linalg.lstsq(aside.reshape(-1, 3), (aside @ centers[:, :, None]).reshape(-1, 1)).solution[:, 0]
    distance = float((middle - centers[0]) @ forwards[0])
    if not distance > 0 or not bool(middle.isfinite().all()):  # The views diverge, as from the middle of a room.
        distance = 1.0
    with client.atomic():
        client.camera.up_direction = -cameras[0].rotation[1].double().numpy()
        client.camera.position = WORLD * centers[0].numpy()
        client.camera.look_at = WORLD * (centers[0] + distance * forwards[0]).numpy()
