"""One picture of a run: held-out photos beside renders, and every object alone before and after refinement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.records import EvalView
from beags_plugin.labels.class_ids import IGNORE, resize_nearest
from beags_plugin.pictures.cells import GAP, as_bytes, below, beside, cell
from beags_plugin.pictures.masks import overlay
from beags_plugin.pictures.object_cells import COLUMNS, Drawing, cell_size, filling, object_shots
from beags_plugin.rasterizers.rendering import surfel_inputs

_WIDTH = 1920  # pixels of a sheet without objects
_TALLEST = 2.0  # most height of a photo's cell over its width
_Part = TypeVar("_Part")


def contact_sheet(
    views: Sequence[EvalView],
    cameras: Sequence[Camera],
    scene: Surfels,
    objects: Mapping[int, Mapping[str, Surfels]],
    classes: Mapping[int, str],
    drawing: Drawing,
    *,
    background: Tensor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """Return [H, W, 3] uint8: photo, mask and render of some views, then the cells of each object (``object_shots``).

    Every line is full: one with fewer cells has larger ones.

    views: held-out views. cameras: cameras of the training photos. scene: all Gaussians. objects: id to stage (such as
    "before") to the object's Gaussians; objects without any are left out. classes: id to name. background: [3], behind
    the scene; black if None. progress: receives (done, total) parts. Raises ``ValueError`` if there is nothing to show.
    """
    views = list(views)
    objects = {each: stages for each, stages in sorted(objects.items()) if any(len(s) for s in stages.values())}
    masked = any(view.visible is not None for view in views)
    count = COLUMNS // (3 if masked else 2)  # groups of photo, mask (if any) and render that fill a line
    chosen = views[:: max(1, len(views) // count)][:count]
    if not (chosen or objects):
        raise ValueError("a contact sheet needs a view or an object")
    parts = 0

    def finished(part: _Part) -> _Part:
        nonlocal parts
        parts += 1
        if progress is not None:
            progress(parts, len(objects) + len(chosen))
        return part

    shots = [
        object_shots(class_id, classes.get(class_id, f"object {class_id}"), stages, views, cameras, drawing)
        for class_id, stages in objects.items()
    ]
    side = cell_size(shots)
    blocks = [finished(each.cells(side, drawing)) for each in shots]
    pictures = [each for view in chosen for each in finished(_scene_pictures(view, scene, drawing, background))]
    size = filling(len(pictures), COLUMNS * (side + GAP) if shots else _WIDTH)
    cells = [cell(picture, _within(picture, size), caption) for picture, caption in pictures]
    return below([*([beside(cells)] if cells else []), *blocks])


def _within(picture: np.ndarray, width: int) -> tuple[int, int]:
    """Return width and height of a cell of at most ``width`` pixels with the proportions of the picture."""
    high, wide = picture.shape[:2]
    scale = min(width / wide, _TALLEST * width / high)
    return max(1, round(scale * wide)), max(1, round(scale * high))


def _scene_pictures(
    view: EvalView, scene: Surfels, drawing: Drawing, background: Tensor | None
) -> list[tuple[np.ndarray, str]]:
    """Return the pictures of one view of the scene, with captions: photo and mask, if there are any, and render."""
    settings = replace(drawing.settings, geometry=False, distortion=False)
    with torch.no_grad():
        behind = scene.means.new_zeros(3) if background is None else background
        inputs = surfel_inputs(scene.detach(), view.camera)
        render = as_bytes(drawing.rasterizer.rasterize(inputs, view.camera, settings, behind).color)
    pictures = []
    if view.image is not None:
        photo = as_bytes(view.image)
        pictures.append((photo, view.name))
        if view.visible is not None:
            labels = resize_nearest(view.visible.cpu().numpy(), *photo.shape[:2])
            pictures.append((overlay(photo, np.where(labels == IGNORE, 0, labels)), "mask"))
    pictures.append((render, "render" if pictures else f"{view.name}: render"))
    return pictures
