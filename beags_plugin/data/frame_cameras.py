"""Cameras of transforms.json in the dialects of instant-ngp, Blender, nerfstudio and similar programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_plugin.system.errors import UserError

LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
_ALIASES = {"fx": "fl_x", "fy": "fl_y", "width": "w", "height": "h"}
# The first entry takes precedence.
_FOCAL = {"x": ("fl_x", "camera_angle_x", "x_fov"), "y": ("fl_y", "camera_angle_y", "y_fov")}
_SIZE = ("w", "h")
_MODELS = {"PERSPECTIVE": "PINHOLE", "FISHEYE": "OPENCV_FISHEYE"}  # other programs' names
_ANGLES = ("camera_angle_x", "camera_angle_y")  # radians
_DEGREES = ("x_fov", "y_fov")
NUMBERS = ("fl_x", "fl_y", *_ANGLES, *_DEGREES, *_SIZE, "cx", "cy", *LENS)
"""Entries of a camera that are numbers."""


@dataclass(frozen=True)
class FrameCamera:
    """A camera in pixels of its ``width`` x ``height``. lens: k1, k2, k3, k4, p1, p2. model: nerfstudio's name."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    lens: tuple[float, ...] = (0.0,) * 6
    model: str = "OPENCV"


def check_numbers(file: Path, whose: str, entries: dict[str, Any]) -> None:
    """Raise ``UserError`` for the first entry of a camera that is no usable number.

    It changes the entries in place: text becomes numbers, null is removed, and other usual names become ours.
    """
    for alias, name in _ALIASES.items():
        if alias in entries and name not in entries:
            entries[name] = entries.pop(alias)
    for key in [key for key in NUMBERS if key in entries and entries[key] is None]:
        del entries[key]
    for key in NUMBERS:
        if key not in entries:
            continue
        value = entries[key] = number(entries[key])
        if not finite(value):
            raise UserError(f"{file}: {whose} has {key} = {value!r:.40}, which is no finite number: correct it.")
        if (key in ("fl_x", "fl_y") and not value > 0) or (key in _SIZE and not 1 <= value <= 1e6):
            least = "a number of pixels" if key in _SIZE else "above 0"
            raise UserError(f"{file}: {whose} has {key} = {value!r:.40}, which must be {least}: correct it.")
        if key in (*_ANGLES, *_DEGREES) and not 0 < value < (math.pi if key in _ANGLES else 180.0):
            unit = "radians between 0 and pi" if key in _ANGLES else "degrees between 0 and 180"
            raise UserError(f"{file}: {whose} has {key} = {value!r:.40}, which must be {unit}: correct it.")


def frame_camera(
    file: Path, name: str, meta: Mapping[str, Any], frame: Mapping[str, Any], photo_size: Callable[[], tuple[int, int]]
) -> FrameCamera:
    """Return the camera of a frame, from its own entries and, where these are missing, from those of the whole file.

    The focal length comes from fl_x and fl_y, or from the angles camera_angle_x (radians) or x_fov (degrees); one of
    them sets both axes. The size defaults to ``photo_size``, the principal point to the middle. Raises ``UserError``
    without a focal length, and for lenses that are not supported.
    """
    width, height = _size(meta, frame, photo_size)
    fx, fy = _focal(meta, frame, width, height)
    if fx is None or fy is None:
        raise UserError(f"{file} has no fl_x, neither for all frames nor for that of {name}: add it.")
    entries = {**meta, **frame}
    if any(key.startswith("ftheta") for key in entries):
        raise UserError(f"the frame of {name} in {file} has an f-theta lens: undistort the images to a pinhole first.")
    lens = tuple(float(entries.get(key, 0.0)) for key in LENS)
    if isinstance(given := entries.get("distortion_params"), list) and not any(key in frame for key in LENS):
        if len(given) != len(LENS) or not all(finite(value) for value in given):
            raise UserError(
                f"{file} has distortion_params that are not the {len(LENS)} numbers k1, k2, k3, k4, p1, p2: correct it."
            )
        lens = tuple(map(float, given))
    model = entries.get("camera_model") or ("OPENCV_FISHEYE" if entries.get("is_fisheye") is True else "OPENCV")
    model = _MODELS.get(str(model).upper(), str(model).upper())
    return FrameCamera(
        fx, fy, float(entries.get("cx", width / 2)), float(entries.get("cy", height / 2)), width, height, lens,
        model,
    )  # fmt: skip


def _size(
    meta: Mapping[str, Any], frame: Mapping[str, Any], photo_size: Callable[[], tuple[int, int]]
) -> tuple[int, int]:
    width, height = (frame.get(key, meta.get(key)) for key in _SIZE)
    if width is None or height is None:
        photo_width, photo_height = photo_size()
        if width is None:
            width = photo_width if height is None else max(1, round(height * photo_width / photo_height))
        if height is None:
            height = max(1, round(width * photo_height / photo_width))
    return int(width), int(height)


def _focal(
    meta: Mapping[str, Any], frame: Mapping[str, Any], width: int, height: int
) -> tuple[float | None, float | None]:
    """Return the focal lengths of both axes; a single one of the frame sets both, in the file's ratio."""
    fx, fy = _along(frame, "x", width), _along(frame, "y", height)
    common_x, common_y = _along(meta, "x", width), _along(meta, "y", height)
    common_x, common_y = common_x or common_y, common_y or common_x
    ratio = common_y / common_x if common_x and common_y else 1.0
    if fx is None and fy is None:
        return common_x, common_y
    if fx is None or fy is None:
        fx, fy = (fx, fx * ratio) if fx is not None else (fy / ratio if fy else None, fy)
    return fx, fy


def _along(entries: Mapping[str, Any], axis: str, pixels: int) -> float | None:
    for key in _FOCAL[axis]:
        if key in entries:
            value = float(entries[key])
            if key.startswith("fl"):
                return value
            return 0.5 * pixels / math.tan(0.5 * (value if key in _ANGLES else math.radians(value)))
    return None


def number(value: Any) -> Any:
    """Convert text to a number if it is one; return anything else unchanged."""
    if isinstance(value, str):
        try:
            return float(value) if math.isfinite(float(value)) else value
        except ValueError:
            return value
    return value


def finite(value: Any) -> bool:
    """Return whether a value from JSON is a number that fits into a float."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False
