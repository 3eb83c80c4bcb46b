"""nerfstudio's transforms.json, checked before nerfstudio reads it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

_FOCAL = ("fl_x", "fl_y")
_SIZE = ("w", "h")
_NEEDED = (*_FOCAL, *_SIZE, "cx", "cy")
_NUMBERS = (*_NEEDED, "k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(file: Path) -> dict[str, Any]:
    """Read a transforms.json; raise ``UserError`` for the first frame without a file, a pose or a finite camera."""
    try:
        meta = load_json(file)
        if not isinstance(meta, dict) or not isinstance(meta["frames"], list):
            raise ValueError('it has no list "frames"')
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{file} is not a nerfstudio transforms file ({reason(error)}): export the poses again."
        ) from error
    frames = meta["frames"]
    if len(frames) < 2:
        named = "only one frame" if frames else "no frames"
        raise UserError(f"{file} names {named}: give poses for at least two images.")
    _check_numbers(file, "it", meta)
    seen: set[str] = set()
    for index, frame in enumerate(frames):
        name = _checked_name(file, index, frame)
        if name in seen:
            raise UserError(f"{file} gives {name} two poses: keep one of its frames.")
        seen.add(name)
        _check_numbers(file, f"the frame of {name}", frame)
        _check_matrix(file, name, frame.get("transform_matrix"))
        for key in _NEEDED:
            given = {*meta, *frame}
            if key not in given and not (key in _FOCAL and given & {"camera_angle_x", "camera_angle_y"}):
                raise UserError(f"{file} has no {key}, neither for all frames nor for that of {name}: add it.")
    return meta


def _checked_name(file: Path, index: int, frame: Any) -> str:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not name or "\0" in name:
        raise UserError(f"frame {index + 1} of {file} has no file_path: give it the path of its image.")
    return name


def _check_numbers(file: Path, whose: str, entries: dict[str, Any]) -> None:
    for key in _NUMBERS:
        if key not in entries:
            continue
        value = entries[key]
        if not _finite(value):
            raise UserError(f"{file}: {whose} has {key} = {value!r:.40}, which is no finite number: correct it.")
        if (key in _FOCAL and not value > 0) or (key in _SIZE and not 1 <= value <= 1e6):
            least = "above 0" if key in _FOCAL else "a number of pixels"
            raise UserError(f"{file}: {whose} has {key} = {value!r:.40}, which must be {least}: correct it.")


def _check_matrix(file: Path, name: str, matrix: Any) -> None:
    rows = (
        isinstance(matrix, list) and len(matrix) in (3, 4) and all(isinstance(r, list) and len(r) == 4 for r in matrix)
    )
    if not rows:
        raise UserError(f"the frame of {name} in {file} has no transform_matrix of 4 x 4 numbers: give it one.")
    if not all(_finite(value) for row in matrix for value in row):
        raise UserError(f"the transform_matrix of {name} in {file} holds what is no finite number: correct it.")


def _finite(value: Any) -> bool:
    """Return whether a value from JSON is a number that fits into a float."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False
