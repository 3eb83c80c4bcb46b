"""Prompts: a small JSON file of the places of objects in some views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_plugin.core.regions import Ball, Block, HalfSpace, Region
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

EXAMPLE = '{"objects": [{"name": "cup", "prompts": [{"view": "IMG_1", "points": [[40, 60]]}]}]}'
STROKE_SPACING = 4.0  # pixels between the points that stand for a stroke


@dataclass(frozen=True)
class Prompt:
    """The place of an object in one view.

    box: left, top, right and bottom, pixels of the image file, or None. points: (x, y) pixels, also those along
    strokes. inside: for each point, whether it lies on the object.
    """

    box: tuple[float, float, float, float] | None = None
    points: tuple[tuple[float, float], ...] = ()
    inside: tuple[bool, ...] = ()


@dataclass(frozen=True)
class PromptedObject:
    """An object with prompts.

    prompts: by view (``matching.PhotoNames``). text: for a detector, or None. space: regions in the frame of the input
    poses; the object lies in all of them.
    """

    class_id: int
    name: str
    prompts: Mapping[str, Prompt]
    text: str | None = None
    space: tuple[Region, ...] = ()


def read_prompts(path: Path, beside_alone: bool = False) -> list[PromptedObject]:
    """Read the objects of a prompts JSON; raise ``UserError`` that names file and object.

    beside_alone: whether a view may have only points beside the object, if another view has one on it.

    {"objects": [{"name": ..., "id": optional, "text": optional, "prompts": [{"view": name, "box": [left, top, right,
    bottom], "points": [[x, y], ...], "outside": [[x, y], ...], "strokes": [[[x, y], ...], ...],
    "outside_strokes": [[[x, y], ...], ...]}, ...], "space": [{"box": [[x, y, z], [x, y, z]]},
    {"sphere": [x, y, z, radius]}, {"plane": [x, y, z, d]}]}, ...]}
    """
    try:
        content = load_json(path)
    except OSError as error:
        raise UserError(f"the prompts {path} cannot be read ({error.strerror}): give options prompts=FILE.") from error
    except ValueError as error:
        raise UserError(f"the prompts {path} are no JSON ({reason(error)}): write e.g. {EXAMPLE}.") from error
    entries = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(f'the prompts {path} have no list "objects": write e.g. {EXAMPLE}.')
    objects: list[PromptedObject] = []
    for index, entry in enumerate(entries, 1):
        try:
            objects.append(_object(entry, index, beside_alone))
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise UserError(
                f"object {index} of the prompts {path} is wrong ({reason(error)}): write e.g. {EXAMPLE}."
            ) from error
    for what, values in (("id", [o.class_id for o in objects]), ("name", [o.name for o in objects])):
        if len(set(values)) < len(values):
            raise UserError(f"two objects of the prompts {path} have the same {what}: change one of them.")
    return objects


def _object(entry: Any, index: int, beside_alone: bool) -> PromptedObject:
    name, text = str(entry["name"]), entry.get("text")
    class_id = int(entry.get("id", index))
    if not 1 <= class_id < 65535:
        raise ValueError(f"id {class_id} is not in 1..65534")
    prompts: dict[str, Prompt] = {}
    for one in entry.get("prompts", []):
        if str(one["view"]) in prompts:
            raise ValueError(f"view {one['view']} has two prompts")
        prompts[str(one["view"])] = _prompt(one, beside_alone)
    if not prompts and not text:
        raise ValueError("it has neither prompts nor a text")
    space = tuple(_region(one) for one in entry.get("space", []))
    return PromptedObject(class_id, name, prompts, None if text is None else str(text), space)


def _region(entry: Mapping[str, Any]) -> Region:
    if len(entry) != 1 or not entry.keys() <= {"box", "sphere", "plane"}:
        raise ValueError(f"{dict(entry)} is none of box, sphere and plane")
    if "box" in entry:
        low, high = (tuple(float(value) for value in corner) for corner in entry["box"])
        return Block(low, high)
    ((kind, numbers),) = entry.items()
    x, y, z, last = (float(value) for value in numbers)
    return Ball((x, y, z), last) if kind == "sphere" else HalfSpace((x, y, z), last)


def _prompt(entry: Mapping[str, Any], beside_alone: bool) -> Prompt:
    inside, outside = (
        _points(entry.get(points, [])) + tuple(point for line in entry.get(strokes, []) for point in _along(line))
        for points, strokes in (("points", "strokes"), ("outside", "outside_strokes"))
    )
    box = None
    if (given := entry.get("box")) is not None:
        left, top, right, bottom = (float(value) for value in given)
        if not (left < right and top < bottom and all(map(math.isfinite, (left, top, right, bottom)))):
            raise ValueError(f"the box {given} is not [left, top, right, bottom]")
        box = (left, top, right, bottom)
    if box is None and not inside and not (beside_alone and outside):
        raise ValueError("a prompt needs a box or points on the object")
    return Prompt(box, inside + outside, (True,) * len(inside) + (False,) * len(outside))


def _points(given: Sequence[Any]) -> tuple[tuple[float, float], ...]:
    points = tuple((float(x), float(y)) for x, y in given)
    if not all(math.isfinite(value) for point in points for value in point):
        raise ValueError(f"the points {given} are not [[x, y], ...]")
    return points


def _along(line: Sequence[Any]) -> tuple[tuple[float, float], ...]:
    """Return points along a stroke's corners, at most ``STROKE_SPACING`` apart."""
    corners = _points(line)
    points = corners[:1]
    for (x, y), (next_x, next_y) in zip(corners, corners[1:], strict=False):
        steps = max(1, math.ceil(math.hypot(next_x - x, next_y - y) / STROKE_SPACING))
        points += tuple(
            (x + (next_x - x) * step / steps, y + (next_y - y) * step / steps) for step in range(1, steps + 1)
        )
    return points
