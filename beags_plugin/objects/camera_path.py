"""Camera paths that nerfstudio's viewer saves."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

_MOST_PIXELS, _MOST_CAMERAS = 8192, 100_000


def read_camera_path(path: Path) -> tuple[list[Camera], int]:
    """Read cameras, in the run's frame, and frames per second; raises ``UserError`` for another file or lens."""
    try:
        content = load_json(path)
        width, height, fps = (content[name] for name in ("render_width", "render_height", "fps"))
        if (lens := str(content.get("camera_type", "perspective")).lower()) != "perspective":
            raise ValueError(f"its camera is {lens}, not perspective")
        if not (min(width, height) >= 2 and max(width, height) <= _MOST_PIXELS and 1 <= fps <= 240):
            raise ValueError(f"it asks for {width} x {height} pixels, {fps} times a second")
        if not 1 <= len(content["camera_path"]) <= _MOST_CAMERAS:
            raise ValueError(f"it has {len(content['camera_path'])} cameras")
        poses = [torch.tensor(each["camera_to_world"]).view(4, 4)[:3].float() for each in content["camera_path"]]
        focals = [height / 2.0 / math.tan(each["fov"] * (math.pi / 180.0) / 2.0) for each in content["camera_path"]]
        if not (all(bool(pose.isfinite().all()) for pose in poses) and 0 < min(focals) < math.inf):
            raise ValueError("a pose or a field of view is no number")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError) as error:
        raise UserError(
            f"the camera path {path} cannot be read ({reason(error)}): save one in the tab Render of ns-viewer."
        ) from error
    return [_camera(pose, focal, width, height) for pose, focal in zip(poses, focals, strict=True)], round(fps)


def _camera(pose: torch.Tensor, focal: float, width: int, height: int) -> Camera:
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat_from_opengl(pose), K, int(width / 2 * 2), int(height / 2 * 2))
