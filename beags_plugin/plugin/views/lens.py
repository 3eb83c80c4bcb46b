"""Where points of the world lie in a photograph as its file has it, lens distortion included."""

from __future__ import annotations

import cv2
import numpy as np
from nerfstudio.cameras.cameras import Cameras, CameraType

from beags_plugin.plugin.views.cameras import camera_from_nerfstudio

_MARGIN = 0.5  # of the image on each side: farther out, a lens model may fold back into the image


def project_through_lens(points: np.ndarray, cameras: Cameras, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [P, 2] (centres at + 0.5) and depths [P] of world points [P, 3] float64 in a distorted view.

    cameras: as read, before nerfstudio undistorts. A point that is not near the image has the depth 0.
    """
    camera = camera_from_nerfstudio(cameras, index)
    rotation, translation = (part.double().numpy() for part in (camera.rotation, camera.translation))
    K = camera.K.double().numpy()
    local = points @ rotation.T + translation
    z = local[:, 2].copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = (local @ K.T)[:, :2] / z[:, None]
        outside = np.abs(xy / [camera.width, camera.height] - 0.5).max(1) > 0.5 + _MARGIN
    parameters = cameras.distortion_params
    if parameters is None or not parameters[index].any():
        return xy, z
    z[(z <= 0) | outside] = 0.0
    kept = np.flatnonzero(z > 0)
    if len(kept):
        lens = parameters[index].double().numpy()
        at_one = np.ascontiguousarray(local[kept, None])
        none = np.zeros(3)
        if int(cameras.camera_type[index]) == CameraType.FISHEYE.value:
            found = cv2.fisheye.projectPoints(at_one, none, none, K, lens[:4])[0]
        else:
            k1, k2, k3, _, p1, p2 = lens  # nerfstudio's order; OpenCV wants k1, k2, p1, p2, k3
            found = cv2.projectPoints(at_one, none, none, K, np.array([k1, k2, p1, p2, k3]))[0]
        xy[kept] = found[:, 0]
    return xy, z
