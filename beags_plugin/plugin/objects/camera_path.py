"""Camera paths that nerfstudio's viewer saves."""

from __future__ import annotations

from pathlib import Path

from nerfstudio.cameras.camera_paths import get_path_from_json

from beags_plugin.core.cameras import Camera
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
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
        cameras = get_path_from_json(content)
        if not (bool(cameras.camera_to_worlds.isfinite().all()) and 0 < float(cameras.fx.min()) < float("inf")):
            raise ValueError("a pose or a field of view is no number")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError) as error:
        raise UserError(
            f"the camera path {path} cannot be read ({reason(error)}): save one in the tab Render of ns-viewer."
        ) from error
    return [camera_from_nerfstudio(cameras, index) for index in range(len(cameras))], round(fps)
