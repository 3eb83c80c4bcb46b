"""Read and check transforms.json of nerfstudio and other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beags_plugin.data.frame_cameras import check_numbers, finite, number
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.stand_ins import stand_in
from beags_plugin.system.reading.text import load_json, reason


def read_transforms(file: Path) -> dict[str, Any]:
    """Read a transforms.json; raise ``UserError`` for the first frame without a file, a pose or a finite camera."""
    try:
        meta = load_json(file)
        if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
            raise ValueError('it has no list "frames"')
    except (OSError, ValueError, KeyError) as error:
        todo = "export the poses again" if stand_in(file) is None else "then try again"
        raise UserError(f"{file} is not a nerfstudio transforms file ({reason(error)}): {todo}.") from error
    frames = meta["frames"]
    if len(frames) < 2:
        named = "only one frame" if frames else "no frames"
        raise UserError(f"{file} names {named}: give poses for at least two images.")
    check_numbers(file, "it", meta)
    seen: set[str] = set()
    for index, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name or "\0" in name:
            raise UserError(f"frame {index + 1} of {file} has no file_path: give it the path of its image.")
        if name in seen:
            raise UserError(f"{file} gives {name} two poses: keep one of its frames.")
        seen.add(name)
        check_numbers(file, f"the frame of {name}", frame)
        frame["transform_matrix"] = _checked_matrix(file, name, frame.get("transform_matrix"))
    _check_rest(file, meta)
    return meta


def _checked_matrix(file: Path, name: str, matrix: Any) -> list[list[float]]:
    """Return the 3 or 4 rows of a pose, which may also be one list, and whose numbers may be text."""
    if isinstance(matrix, list) and len(matrix) in (12, 16) and not any(isinstance(each, list) for each in matrix):
        matrix = [matrix[at : at + 4] for at in range(0, len(matrix), 4)]
    if not _is_matrix(matrix):
        raise UserError(
            f"the frame of {name} in {file} has no transform_matrix of 4 x 4 numbers: give it one, or delete it."
        )
    matrix = [[number(value) for value in row] for row in matrix]
    if not all(finite(value) for row in matrix for value in row):
        raise UserError(f"the transform_matrix of {name} in {file} holds a value that is no finite number: correct it.")
    return matrix


def _is_matrix(matrix: Any) -> bool:
    """Return whether this is a list of 3 or 4 rows of 4 entries."""
    return (
        isinstance(matrix, list) and len(matrix) in (3, 4) and all(isinstance(r, list) and len(r) == 4 for r in matrix)
    )


def _check_rest(file: Path, meta: dict[str, Any]) -> None:
    """Raise ``UserError`` for wrong entries of the whole file: its transform, its points and its splits."""
    applied = meta.get("applied_transform")
    if applied is not None and not (_is_matrix(applied) and all(finite(value) for row in applied for value in row)):
        raise UserError(f"{file} has an applied_transform that is no matrix of 3 x 4 numbers: correct or remove it.")
    scale = meta.get("applied_scale")
    if scale is not None and not (finite(scale) and scale > 0):
        raise UserError(f"{file} has applied_scale = {scale!r:.40}, which must be above 0: correct or remove it.")
    points = meta.get("ply_file_path")
    if points is not None and not (isinstance(points, str) and points and "\0" not in points):
        raise UserError(f"{file} has ply_file_path = {points!r:.40}, which is no path: correct or remove it.")
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = meta.get(key)
        if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise UserError(f"{file} has {key} that are no list of paths: correct or remove them.")
