"""Small pictures of the picked object from sides that were not clicked."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.pictures.orbit import shows
from beags_plugin.plugin.viewer.choice import Visible
from beags_plugin.plugin.viewer.viewing import Paint, Viewing, plain_outputs

SIDES = 4
_PIXELS = 150  # Pixels on each side of a picture.
_MARGIN = 1.6  # Size of a picture in units of the object, so that it shows what the cut has missed.
_GAP = 4  # Pixels between two pictures.
_TRIED = 10  # Views to try, as some see the object behind other things.
_WHITE, _LEAST_SHARE = 0.9, 0.03  # Least brightness of the object painted white, and least share of the picture.


def other_sides(cameras: Sequence[Camera], center: Tensor, clicked: Sequence[Tensor], count: int = SIDES) -> list[int]:
    """Return at most ``count`` cameras that see a place from sides far from ``clicked`` and from one another.

    center: [3], of the object. clicked: camera centres [3] of all clicks.
    """
    center = center.double()
    seeing = [index for index, camera in enumerate(cameras) if shows(camera, center)]
    towards = {index: _direction(cameras[index].center, center) for index in seeing}
    near = [_direction(each, center) for each in clicked]
    chosen: list[int] = []
    while len(chosen) < count and (others := [index for index in seeing if index not in chosen]):
        best = min(others, key=lambda index: max((float(towards[index] @ each) for each in near), default=0.0))
        chosen.append(best)
        near.append(towards[best])
    return chosen


def _direction(place: Tensor, center: Tensor) -> Tensor:
    return torch.nn.functional.normalize(place.double().cpu() - center, dim=0)


def close_camera(camera: Camera, points: Tensor) -> Camera | None:
    """Return a camera at the same place whose square picture shows ``points`` [P, 3]; None if it sees none."""
    local = points.double().cpu() @ camera.rotation.double().cpu().T + camera.translation.double().cpu()
    local = local[local[:, 2] > 0]
    if len(local) == 0:
        return None
    plane = local[:, :2] / local[:, 2:]
    low, high = plane.quantile(0.01, dim=0), plane.quantile(0.99, dim=0)
    half = max(_MARGIN * float((high - low).max()) / 2, 4.0 / float(camera.K[0, 0]))
    focal, middle = _PIXELS / (2 * half), (low + high) / 2
    K = torch.tensor(
        [
            [focal, 0.0, _PIXELS / 2 - focal * float(middle[0])],
            [0.0, focal, _PIXELS / 2 - focal * float(middle[1])],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera(camera.viewmat.cpu(), K, _PIXELS, _PIXELS)


@torch.no_grad()
def sides_picture(viewing: Viewing, members: Tensor, clicked: Sequence[Tensor], paint: Paint) -> str | None:
    """Return Markdown of a picture of the chosen object from ``SIDES`` other sides; None if no camera sees it.

    members: [N] bool. clicked: see ``other_sides``. paint: of the picks.
    """
    run, model = viewing.run, viewing.model
    surfels = model.surfels().detach()
    points = surfels.means[members.to(surfels.means.device)].cpu()
    if run is None or len(points) == 0:
        return None
    if len(points) > 20_000:  # torch.quantile accepts 16 million values at most.
        points = points[:: math.ceil(len(points) / 20_000)]
    scene = Visible(surfels, model.class_ids, None)
    alone = Paint(torch.ones_like(paint.colors), members.float().to(model.device))
    pictures: dict[str, np.ndarray] = {}
    for index in other_sides(run.cameras, points.double().median(dim=0).values, clicked, _TRIED):
        camera = close_camera(run.cameras[index], points)
        if camera is None or len(pictures) == SIDES:
            continue
        camera = camera.to(model.device)
        black = model.background_color.new_zeros(3)
        bright, painted = (plain_outputs(model, scene, camera, black, each)["rgb"] for each in (alone, paint))
        if float((bright.amin(dim=2) > _WHITE).float().mean()) > _LEAST_SHARE:
            pictures[run.names[index]] = (255 * painted).round().to(torch.uint8).cpu().numpy()
    return picture_text(_grid(list(pictures.values())), ", ".join(pictures)) if pictures else None


def _grid(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Return pictures [H, W, 3] in rows of two."""
    rows = -(-len(pictures) // 2)
    sheet = np.full((rows * (_PIXELS + _GAP) - _GAP, 2 * _PIXELS + _GAP, 3), 30, np.uint8)
    for place, picture in enumerate(pictures):
        top, left = (place // 2) * (_PIXELS + _GAP), (place % 2) * (_PIXELS + _GAP)
        sheet[top : top + _PIXELS, left : left + _PIXELS] = picture
    return sheet


def picture_text(picture: np.ndarray, title: str) -> str:
    """Return a picture [H, W, 3] uint8 as Markdown that is as wide as the panel. title: appears under the mouse."""
    _, content = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    url = f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode()}"
    words = "".join(letter if letter.isalnum() or letter in " .,_-" else "?" for letter in title)
    return f'<img src="{url}" title="{words}" alt="{words}" style={{{{width: "100%"}}}} />'
